"""Read frames and samples of an inertial sensor from files of events."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from envs.recordings import aedat3, aedat4
from envs.recordings.event_file import MAX_BYTES, Request, check_file
from envs.recordings.formats import recognised
from envs.recordings.hdf5_checks import ERRORS, check_plain, opened
from envs.recordings.ros import Values
from envs.recordings.ros_storage import Topic, is_bag_folder, messages, open_bags

# One sample: us, m/s^2, rad/s, on the axes of the sensor.
IMU = np.dtype([("t", "<i8"), ("acceleration", "<f4", 3), ("rotation", "<f4", 3)])
G = 9.80665  # m/s^2
BROKEN_FRAME = (*aedat4.BROKEN, KeyError)
CHANNELS = {0: 1, 16: 3, 24: 4}  # OpenCV's type, in which DV stores frames -> channels
ENCODINGS = {"mono8": ("u1", 1), "8UC1": ("u1", 1), "mono16": ("u2", 1), "rgb8": ("u1", 3), "bgr8": ("u1", 3)}
IMAGE, INERTIAL = "sensor_msgs/Image", "sensor_msgs/Imu"
# Groups of the cameras in MVSEC's HDF5 files, with images and their times [s].
HDF5_IMAGES = ("davis/left", "davis/right")


class Frame(NamedTuple):
    """A frame from the event sensor.

    Attributes:
        t_us: Middle of its exposure [us].
        exposure_us: Length of its exposure [us]; 0: not known.
        values: (H, W) of grey, or (H, W, 3) of R, G and B; uint8 or uint16.
    """

    t_us: int
    exposure_us: int
    values: np.ndarray


def read_frames(path: str | Path, **options: Any) -> Iterator[Frame]:
    """Yield the frames of a file in their order.

    Args:
        path: An AEDAT 3 or 4 file, a ROS bag, or an HDF5 file in MVSEC's layout.
        options: `topic`, `group` or `stream` of the frames, as in `read_events`.

    Raises:
        ValueError: The format has no frames, or the file is damaged.
    """
    return _reader(FRAMES, "frames", Path(path))(Request(Path(path), **options))


def read_imu(path: str | Path, **options: Any) -> np.ndarray:
    """Return the samples of the inertial sensor, an IMU array sorted by time.

    Args:
        path: An AEDAT 3 or 4 file, or a ROS bag.
        options: As in `read_frames`.

    Raises:
        ValueError: The format has no such samples, or the file is damaged.
    """
    rows = list(_reader(INERTIALS, "inertial samples", Path(path))(Request(Path(path), **options)))
    samples = np.array(rows, IMU)
    return samples[np.argsort(samples["t"], kind="stable")]


class NoFramesError(ValueError):
    """The format of a file supports frames, but the file has none."""


def has_frames(path: str | Path) -> bool:
    """Whether the format of a file supports frames in addition to events."""
    try:
        return _kind(Path(path)) in FRAMES
    except ValueError:
        return False


def _kind(path: Path) -> str:
    """Return the format of a file, or of the folder of a bag."""
    if is_bag_folder(path):
        return "ros"
    check_file(path, MAX_BYTES)
    return recognised(path)


def _reader(table: Mapping[str, Callable[[Request], Any]], what: str, path: Path) -> Callable[[Request], Any]:
    """Return the function for the format of a file."""
    kind = _kind(path)
    if kind not in table:
        raise ValueError(f"{path}: {kind} files have no {what}; {', '.join(table)} files have them")
    return table[kind]


def _packets4(request: Request, kind: bytes) -> Iterator[bytes]:
    """Yield the packets of one stream of an AEDAT 4 file."""
    layout = aedat4.read_layout(request)
    if not any(stream.kind == kind for stream in layout.streams):
        raise NoFramesError(f"{request.path}: has no stream of kind {kind.decode()}; give another file")
    stream = aedat4.choose(request, layout.streams, kind)
    for _, buffer in aedat4.packets(request, layout, {stream.number: kind}):
        yield buffer


def _frames4(request: Request) -> Iterator[Frame]:
    """Yield the frames of an AEDAT 4 file."""
    for buffer in _packets4(request, b"FRME"):
        with request.refusing(BROKEN_FRAME, "has a damaged frame ({}); copy or record it again"):
            table = aedat4.root(buffer)
            t_us, begin_us, end_us = (int(table.scalar(number, "q", 0)) for number in (0, 3, 4))
            channels = CHANNELS[int(table.scalar(5, "b", 0))]
            width, height = int(table.scalar(6, "h", 0)), int(table.scalar(7, "h", 0))
            start, count = table.vector(10, 1)
            if count != width * height * channels or not count:
                raise ValueError(f"a frame of {width}x{height} has {count} bytes")
        values = np.frombuffer(buffer, np.uint8, count, start).reshape(height, width, channels)
        is_exposed = 0 < begin_us <= end_us
        yield Frame(
            (begin_us + end_us) // 2 if is_exposed else t_us,
            end_us - begin_us if is_exposed else 0,
            values[..., 0] if channels == 1 else values[..., 2::-1],
        )


def _imu4(request: Request) -> Iterator[tuple[Any, ...]]:
    """Yield the inertial samples of an AEDAT 4 file, which stores g and degrees per second."""
    for buffer in _packets4(request, b"IMUS"):
        with request.refusing(aedat4.BROKEN, "has damaged samples ({}); copy or record it again"):
            for row in aedat4.root(buffer).tables(0):
                t_us = int(row.scalar(0, "q", 0))
                values = np.array([row.scalar(number, "f", 0.0) for number in range(2, 8)])
                yield t_us, values[:3] * G, np.deg2rad(values[3:])


def _frames3(request: Request) -> Iterator[Frame]:
    """Yield the frames of an AEDAT 3 file, whose pixels have 16 bits."""
    header = aedat3.read_header(request)
    for kind, _, turns, body in aedat3.packets(request, header):
        if kind != aedat3.FRAME or len(body) < 36:
            continue
        info, _, _, begin, end, width, height, _, _ = np.frombuffer(body, "<i4", 9).tolist()
        channels, size = info >> 1 & 7, 2 * width * height * (info >> 1 & 7)
        if not info & 1 or min(width, height, channels) < 1 or len(body) < 36 + size:
            continue
        values = np.frombuffer(body, "<u2", size // 2, 36).reshape(height, width, channels)
        values = values[::-1] if header.from_below else values
        begin_us, end_us = begin + (turns << 31), end + (turns << 31)
        values = values[..., 0] if channels == 1 else values[..., :3]
        yield Frame((begin_us + end_us) // 2, end_us - begin_us, values)


def _imu3(request: Request) -> Iterator[tuple[Any, ...]]:
    """Yield the inertial samples of an AEDAT 3 file, which stores g and degrees per second."""
    row = np.dtype([("info", "<u4"), ("t", "<i4"), ("values", "<f4", 7)])
    for kind, _, turns, body in aedat3.packets(request, aedat3.read_header(request)):
        if kind == aedat3.IMU6 and len(body) % row.itemsize == 0:
            for one in np.frombuffer(body, row):
                if one["info"] & 1:
                    values = one["values"].astype(np.float64)
                    yield int(one["t"]) + (turns << 31), values[:3] * G, np.deg2rad(values[3:6])


def _messages(request: Request, kind: str) -> Iterator[Values]:
    """Yield the messages of one type in a bag."""
    for bag in open_bags(request):
        found = [topic for topic in bag.topics if topic.kind == kind]
        name = _one(request, found, bag.topics, kind) if found or request.topic else None
        for message in messages(bag, {name} if name else set()):
            yield Values(message.raw, bag.is_ros1)


def _one(request: Request, found: list[Topic], topics: list[Topic], kind: str) -> str:
    """Return the topic to read: the one that the caller names, else the first."""
    names = [topic.name for topic in found]
    if request.topic is not None and request.topic not in names:
        listing = ", ".join(f"{topic.name} ({topic.kind})" for topic in topics)
        raise request.refusal(f"has no topic {request.topic!r} of {kind}; its topics are {listing}: give one")
    return request.topic or names[0]


def _frames_ros(request: Request) -> Iterator[Frame]:
    """Yield the images of a bag."""
    for values in _messages(request, IMAGE):
        t_us = values.header()
        height, width, encoding = values.number("I"), values.number("I"), values.text()
        is_big, step, raw = values.number("B"), values.number("I"), values.bytes()
        if encoding not in ENCODINGS:
            raise request.refusal(
                f"has images of the encoding {encoding!r}; {', '.join(ENCODINGS)} are read: convert them"
            )
        code, channels = ENCODINGS[encoding]
        rows = np.frombuffer(raw, np.uint8, step * height).reshape(height, step)
        rows = np.ascontiguousarray(rows[:, : width * channels * np.dtype(code).itemsize])
        picture = rows.view((">" if is_big else "<") + code).reshape(height, width, channels)
        picture = picture[..., 0] if channels == 1 else picture[..., :: 1 if encoding == "rgb8" else -1]
        yield Frame(t_us, 0, picture)


def _imu_ros(request: Request) -> Iterator[tuple[Any, ...]]:
    """Yield the inertial samples of a bag."""
    for values in _messages(request, INERTIAL):
        t_us = values.header()
        numbers = [values.real("d") for _ in range(37)]  # orientation, rotation, acceleration; covariances
        yield t_us, np.array(numbers[25:28]), np.array(numbers[13:16])


def _frames_hdf5(request: Request) -> Iterator[Frame]:
    """Yield the images of an HDF5 file in MVSEC's layout."""
    rule = "has no readable images ({}); give group, or another file"
    with request.refusing(ERRORS, rule), opened(request.path) as file:
        group = request.group or next((name for name in HDF5_IMAGES if f"{name}/image_raw" in file), "")
        if not group:
            raise NoFramesError(
                f"{request.path}: has no images at {' or '.join(HDF5_IMAGES)}/image_raw; give group"
            )
        check_plain(file, f"{group}/image_raw", 3)
        check_plain(file, f"{group}/image_raw_ts", 1)
        for t_s, values in zip(file[f"{group}/image_raw_ts"][:], file[f"{group}/image_raw"], strict=True):
            yield Frame(round(1e6 * float(t_s)), 0, np.asarray(values))


FRAMES = {"aedat3": _frames3, "aedat4": _frames4, "hdf5": _frames_hdf5, "ros": _frames_ros}
INERTIALS = {"aedat3": _imu3, "aedat4": _imu4, "ros": _imu_ros}
