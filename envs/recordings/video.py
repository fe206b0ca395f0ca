"""Events that an event camera would have seen while a video was taken.

Frames are decoded by the ffmpeg program that imageio-ffmpeg brings, in a process of its own:
a damaged video cannot take the interpreter with it, and only one frame is held at a time.
Times are the video's own presentation times. Between two frames the camera model takes
log luminance as linear, so what is faster than the frames is not in the events.
"""

import dataclasses
import queue
import re
import subprocess
import threading
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import IO, Literal

import imageio_ffmpeg
import numpy as np

from envs.config import CameraConfig
from envs.events import EVENT, EventCamera
from envs.recordings.event_file import MAX_BYTES, MAX_EVENTS, EventFile, Request, check_file

# Containers of one video; playlists are left out, because they can name other files.
CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,ogg,flv,nut,gif"
MAX_PIXELS = 1 << 26
FRAME_TIMEOUT_S = 60.0
LUMA = np.array([0.2126, 0.7152, 0.0722], np.float32)  # Rec. 709: luminance of linear R, G, B
FRAME_LINE = re.compile(r"\[Parsed_showinfo\S* @ \w+\] n:\s*\d+ pts:\s*(\S+) .*? s:(\d+)x(\d+) ")
TIME_BASE_LINE = re.compile(r"\[Parsed_showinfo\S* @ \w+\] config in time_base: (\d+)/(\d+)")
DAMAGE_LINE = re.compile(r"\[.*(error|corrupt|mismatch|invalid|ended prematurely)", re.IGNORECASE)


@dataclasses.dataclass(frozen=True)
class VideoStep:
    """What the camera saw from one frame of a video to the next.

    Attributes:
        t_us: Time of the later frame [us], by the video's clock.
        events: EVENT array, sorted by t, none later than `t_us`.
        dropped: Events lost to the camera's `max_events_per_pixel`.
        width, height: Pixels of the event camera.
    """

    t_us: int
    events: np.ndarray
    dropped: int
    width: int
    height: int


def video_to_events(
    path: str | Path,
    camera: CameraConfig | None = None,
    *,
    transfer: Literal["srgb", "linear"] = "srgb",
    max_events: int = MAX_EVENTS,
    max_bytes: int = MAX_BYTES,
) -> EventFile:
    """All events of a video at once; `video_steps` gives them frame by frame.

    Args:
        path: The video file.
        camera: The event camera; None: one with the video's own size and the default settings.
            A video of another size is averaged onto its pixels.
        transfer: As in `video_steps`.
        max_events: Most events that are kept.
        max_bytes: Largest file that is opened [bytes].

    Returns:
        Events from the second frame on, and how many the camera dropped.

    Raises:
        ValueError: As `video_steps`, or there are more than `max_events` events.
    """
    request = Request(Path(path), max_events=max_events)
    parts = [np.empty(0, EVENT)]
    count, dropped = 0, 0
    width = height = None
    for step in video_steps(path, camera, transfer=transfer, max_bytes=max_bytes):
        parts.append(step.events)
        count = request.check_count(count + len(step.events))
        dropped += step.dropped
        width, height = step.width, step.height
    return EventFile(np.concatenate(parts), width, height, "video", dropped=dropped)


def video_steps(
    path: str | Path,
    camera: CameraConfig | None = None,
    *,
    transfer: Literal["srgb", "linear"] = "srgb",
    max_bytes: int = MAX_BYTES,
) -> Iterator[VideoStep]:
    """Events of a video from frame to frame, in the memory of one frame.

    Args:
        path: The video file.
        camera: The event camera; None: one with the video's own size and the default settings.
            A video of another size is averaged onto its pixels, by area and in linear light;
            the whole picture is used, so another aspect ratio is stretched.
        transfer: How 8-bit values become light. "srgb": IEC 61966-2-1, right for most videos;
            "linear": value / 255.
        max_bytes: Largest file that is opened [bytes].

    Yields:
        One `VideoStep` for every frame but the first.

    Raises:
        ValueError: The file is no video, has fewer than two frames, frames of several sizes,
            frames above 2**26 pixels, or times that are missing or do not increase.
    """
    path = Path(path)
    if transfer not in ("srgb", "linear"):
        raise ValueError(f"transfer must be 'srgb' or 'linear', got {transfer!r}")
    check_file(path, max_bytes)
    light = light_of_grey(transfer)
    eye: EventCamera | None = None
    average: Callable[[np.ndarray], np.ndarray] | None = None
    frames, last_us = 0, None
    for t_us, frame in _frames(path):
        if last_us is not None and t_us <= last_us:
            raise ValueError(
                f"{path}: frame {frames} has the time {t_us} us and the one before it {last_us} us; "
                "times must increase: encode the video again at a constant frame rate"
            )
        if eye is None or average is None:
            rows, columns = frame.shape[:2]
            eye = EventCamera(camera or CameraConfig(width=columns, height=rows))
            average = area_average((rows, columns), (eye.config.height, eye.config.width))
            eye.reset(average(light[frame] @ LUMA), t_us)
        else:
            events = eye.step(average(light[frame] @ LUMA), t_us)
            yield VideoStep(t_us, events, eye.dropped, eye.config.width, eye.config.height)
        last_us = t_us
        frames += 1
    if frames < 2:
        raise ValueError(f"{path}: has {frames} frame; events need at least two")


def area_average(
    from_shape: tuple[int, int], to_shape: tuple[int, int]
) -> Callable[[np.ndarray], np.ndarray]:
    """A function that averages a picture onto larger (or finer) pixels by the area they share.

    Args:
        from_shape: Rows and columns of the picture.
        to_shape: Rows and columns of the result.

    Returns:
        A function from float32 `from_shape` to float32 `to_shape`. It keeps the mean, and a
        picture of `to_shape` as it is.
    """
    if from_shape == to_shape:
        return np.ascontiguousarray
    rows, columns = (
        _overlap(old, new).astype(np.float32) for old, new in zip(from_shape, to_shape, strict=True)
    )
    return lambda picture: np.clip(rows @ picture @ columns.T, 0.0, None)


def _overlap(old: int, new: int) -> np.ndarray:
    """Weights (new, old): the share of each old pixel in each new one; rows sum to 1."""
    edges = np.arange(new + 1)[:, None] * (old / new)
    filled = np.clip(edges - np.arange(old)[None, :], 0.0, 1.0)  # how much of each lies before an edge
    weights = np.diff(filled, axis=0)
    return weights / weights.sum(axis=1, keepdims=True)


def light_of_grey(transfer: Literal["srgb", "linear"]) -> np.ndarray:
    """Linear light in [0, 1], float32, of each 8-bit value."""
    value = np.arange(256) / 255.0
    if transfer == "srgb":
        value = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return value.astype(np.float32)


def _frames(path: Path) -> Iterator[tuple[int, np.ndarray]]:
    """Time [us] and RGB picture, uint8 (H, W, 3), of every frame.

    ffmpeg writes pictures to one pipe, and one line with time and size for each to another.
    """
    # fmt: off
    command = [
        imageio_ffmpeg.get_ffmpeg_exe(), "-nostdin", "-nostats", "-hide_banner", "-threads", "1", "-xerror",
        "-protocol_whitelist", "file", "-format_whitelist", CONTAINERS, "-max_pixels", str(MAX_PIXELS),
        "-i", f"file:{path.resolve()}", "-map", "0:v:0", "-fps_mode", "passthrough",
        "-vf", "format=rgb24,showinfo=checksum=0", "-f", "rawvideo", "pipe:1",
    ]
    # fmt: on
    with subprocess.Popen(  # noqa: S603  no shell, and the path begins with file:/
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as program:
        assert program.stdout is not None  # noqa: S101  it is a pipe; for the type checker
        assert program.stderr is not None  # noqa: S101  the same
        lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        thread = threading.Thread(target=_read_lines, args=(program.stderr, lines), daemon=True)
        thread.start()
        try:
            yield from _paired(path, program.stdout, lines)
            if program.wait(FRAME_TIMEOUT_S) != 0:
                raise ValueError(f"{path}: is damaged or truncated; copy or encode it again")
        finally:
            program.kill()  # nothing more is wanted of it; it has ended unless the caller stops early
            thread.join()


def _read_lines(pipe: IO[bytes], lines: queue.SimpleQueue) -> None:
    """Hand on what ffmpeg says, line by line, and None at its end."""
    is_begun = False
    while line := pipe.readline(1 << 16):
        if not is_begun:  # the rest of a long line could look like any other
            lines.put(line.decode("latin-1").rstrip())
        is_begun = not line.endswith(b"\n")
    lines.put(None)


def _paired(path: Path, pictures: IO[bytes], lines: queue.SimpleQueue) -> Iterator[tuple[int, np.ndarray]]:
    """Put the two pipes together again."""
    second: Fraction | None = None
    shape: tuple[int, int] | None = None
    said = ""
    while (line := _next_line(path, lines)) is not None:
        base = TIME_BASE_LINE.match(line)
        frame = FRAME_LINE.match(line)
        if base:
            second = Fraction(int(base[1]), int(base[2]) or 1)
        elif frame:
            if shape not in (None, (int(frame[3]), int(frame[2]))):
                raise ValueError(f"{path}: its frames change their size; encode it again with one size")
            shape = (int(frame[3]), int(frame[2]))
            yield _time_us(path, frame[1], second), _picture(path, pictures, shape)
        elif DAMAGE_LINE.match(line):
            said = said or line
    if shape is None:
        raise ValueError(
            f"{path}: is no video that can be read ({said or 'no frames'}); encode it again as mp4"
        )
    if said:
        raise ValueError(f"{path}: is damaged or truncated ({said}); copy or encode it again")


def _next_line(path: Path, lines: queue.SimpleQueue) -> str | None:
    """The next thing that ffmpeg says."""
    try:
        line: str | None = lines.get(timeout=FRAME_TIMEOUT_S)
    except queue.Empty:
        raise ValueError(f"{path}: no frame came in {FRAME_TIMEOUT_S:.0f} s; encode it again") from None
    return line


def _time_us(path: Path, ticks: str, second: Fraction | None) -> int:
    """A presentation time in whole microseconds."""
    if second is None or not re.fullmatch(r"-?\d+", ticks):
        raise ValueError(f"{path}: a frame has no time; encode it again at a constant frame rate")
    return round(int(ticks) * second * 1_000_000)


def _picture(path: Path, pictures: IO[bytes], shape: tuple[int, int]) -> np.ndarray:
    """The next picture."""
    size = 3 * shape[0] * shape[1]
    raw = pictures.read(size)
    if len(raw) != size:
        raise ValueError(f"{path}: its last frame is not whole; encode it again")
    return np.frombuffer(raw, np.uint8).reshape(*shape, 3)
