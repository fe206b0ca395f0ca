"""Events that an event camera would have seen while a video, or a sequence of images, was taken.

Times are the video's presentation times minus the start time of the file, or the times of the images. Between
two frames the camera model assumes linear log luminance, so changes faster than the frames give no events.
`envs.recordings.frame_rate` estimates how many events are missing.
"""

import dataclasses
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np

from envs.config import LUMINANCE_FLOOR, CameraConfig, FaultsConfig, with_floor
from envs.events import EVENT, EventCamera, RealSensor
from envs.events.faults import has_readout
from envs.recordings.decoder import decoded_images, decoded_video
from envs.recordings.event_file import MAX_BYTES, MAX_EVENTS, EventFile, check_file
from envs.recordings.frame_rate import FrameLoss
from envs.recordings.image_folder import LISTS, check_fps, even_time_us, find_images
from envs.recordings.in_between import frames_between, open_cv
from envs.recordings.light import TRANSFERS, Transfer, area_average, luminance, usual_floor, usual_transfer

MUCH_LOST = 0.05  # fraction of missing events from which on a warning is given


@dataclasses.dataclass(frozen=True)
class VideoStep:
    """Events from one frame of a video to the next.

    Attributes:
        t_us: Time of the later frame [us], by the video's clock, minus the start time of the file.
        events: EVENT array, sorted by t, none later than `t_us`.
        is_noise: bool (N,), which events were not caused by a change of the light.
        dropped: Number of events lost to the camera's `max_events_per_pixel` and its readout.
        width, height: Pixels of the event camera.
        missed: Estimated fraction of the scene's events that all frames until now miss, because nothing is
            seen between them; None: too few frames or events.
    """

    t_us: int
    events: np.ndarray
    is_noise: np.ndarray
    dropped: int
    width: int
    height: int
    missed: float | None


def video_to_events(  # noqa: PLR0913 - each is a separate choice
    path: str | Path,
    camera: CameraConfig | None = None,
    faults: FaultsConfig | None = None,
    *,
    transfer: Transfer | None = None,
    fps: float | None = None,
    interpolate: Literal["linear", "flow"] = "linear",
    rng: np.random.Generator | None = None,
    max_events: int = MAX_EVENTS,
    max_bytes: int = MAX_BYTES,
) -> EventFile:
    """Return all events of a video or of a folder of images; `video_steps` yields them frame by frame.

    Args:
        path: The video file, or the folder.
        camera: The event camera; None: a camera with the video's size and the default settings.
            A video of another size is averaged onto the camera's pixels.
        faults: Faults of the camera's sensor; None: none.
        transfer: As in `video_steps`.
        fps: As in `video_steps`.
        interpolate: As in `video_steps`.
        rng: As in `video_steps`.
        max_events: Maximum number of events.
        max_bytes: Maximum size of the file or of all images [bytes].

    Returns:
        Events from the second frame on, with labels of noise, the number that the camera dropped, and the
        estimated fraction that the frames miss.

    Raises:
        ValueError: As in `video_steps`, or there are more than `max_events` events.
    """
    parts, noise = [np.empty(0, EVENT)], [np.empty(0, bool)]
    count, dropped = 0, 0
    options: dict[str, Any] = {"transfer": transfer, "fps": fps, "interpolate": interpolate, "rng": rng}
    for step in video_steps(path, camera, faults, max_bytes=max_bytes, **options):
        parts.append(step.events)
        noise.append(step.is_noise)
        count += len(step.events)
        if count > max_events:
            raise ValueError(
                f"{path}: gives more than max_events={max_events} events; raise max_events, or take them "
                "frame by frame from video_steps and write them with event_writer"
            )
        dropped += step.dropped
    events, is_noise = np.concatenate(parts), np.concatenate(noise)
    size = step.width, step.height
    return EventFile(events, *size, "video", dropped=dropped, is_noise=is_noise, missed=step.missed)


def video_steps(
    path: str | Path,
    camera: CameraConfig | None = None,
    faults: FaultsConfig | None = None,
    *,
    transfer: Transfer | None = None,
    fps: float | None = None,
    interpolate: Literal["linear", "flow"] = "linear",
    rng: np.random.Generator | None = None,
    max_bytes: int = MAX_BYTES,
) -> Iterator[VideoStep]:
    """Yield the events of a video or of a folder of images frame by frame, with memory for one frame.

    A folder must have an `images.txt` with a line "time [s] name" for each image, or another list of
    `image_folder.LISTS`, unless `fps` is given. 8-bit, 16-bit and floating point values are read unchanged.

    Args:
        path: The video file, or the folder.
        camera: The event camera; None: a camera with the video's size and the default settings.
            A video of another size is averaged onto the camera's pixels, by area and in linear light;
            the whole picture is used, so another aspect ratio is stretched.
        faults: Faults of the camera's sensor; None: none.
        transfer: Conversion of values to light. "srgb": IEC 61966-2-1, right for most videos and photographs;
            "linear": proportional. None: floating point is linear, integers are sRGB.
        fps: Frames per second, replaces the times of the video or the folder.
        interpolate: "linear": log luminance changes linearly from frame to frame. "flow": moving parts are
            interpolated by optical flow (`envs.recordings.in_between`); needs OpenCV.
        rng: Source of all noise; None: `np.random.default_rng(0)`.
        max_bytes: Maximum size of the file or of all images [bytes].

    Yields:
        One `VideoStep` for every frame but the first.

    Raises:
        ValueError: The file is no video, has fewer than two frames, frames of several sizes,
            frames above 2**26 pixels, values that are not finite, or times that are missing or do not
            increase; or as in `find_images`.

    Warns:
        UserWarning: Once, at the end, if the frames seem to miss 5 % of the events or more, and
            `interpolate` is "linear".
    """
    path = Path(path)
    _check_options(transfer, fps, interpolate)
    eye: Eye | None = None
    frames, last_us = 0, None
    for t_us, values in _frames(path, fps, max_bytes):
        if last_us is not None and t_us <= last_us:
            raise ValueError(
                f"{path}: frame {frames} has the time {t_us} us and the one before it {last_us} us; "
                "times must increase: encode the video again at a constant frame rate, or give fps"
            )
        used = transfer or usual_transfer(values.dtype)
        light = luminance(values, used)
        if not np.isfinite(light).all():
            raise ValueError(f"{path}: frame {frames} has values that are not finite; replace them")
        if eye is None:
            config = camera or CameraConfig(width=light.shape[1], height=light.shape[0])
            config = with_floor(config, usual_floor(values.dtype, used))
            eye = Eye(
                config, faults or FaultsConfig(), rng or np.random.default_rng(0), interpolate == "flow"
            )
            eye.reset(light, t_us)
        else:
            yield eye.step(light, t_us)
        last_us = t_us
        frames += 1
    if eye is None or frames < 2:
        raise ValueError(f"{path}: has {frames} frame; events need at least two")
    eye.warn(path)


def _check_options(transfer: str | None, fps: float | None, interpolate: str) -> None:
    """Raise ValueError for an invalid option of `video_steps`."""
    if transfer is not None and transfer not in TRANSFERS:
        raise ValueError(f"transfer must be 'srgb' or 'linear', got {transfer!r}")
    if interpolate not in ("linear", "flow"):
        raise ValueError(f"interpolate must be 'linear' or 'flow', got {interpolate!r}")
    if interpolate == "flow":
        open_cv()
    check_fps(fps)


class Eye:
    """An event camera and its sensor's faults, which see frames of any size."""

    def __init__(
        self, config: CameraConfig, faults: FaultsConfig, rng: np.random.Generator, by_flow: bool
    ) -> None:
        """Create the camera; `rng` draws the noise."""
        self._camera, self._faults, self._rng, self._by_flow = EventCamera(config), faults, rng, by_flow
        self._loss = FrameLoss(self._camera.config)
        self._real: RealSensor | None = None

    def reset(self, light: np.ndarray, t_us: int) -> None:
        """Start at a first frame, float32, linear."""
        config = self._camera.config
        self._average = area_average(light.shape, (config.height, config.width))
        self._last = light
        seen = self._average(light)
        self._camera.reset(seen, t_us)
        self._loss.see(seen, t_us)
        if self._faults != FaultsConfig() or has_readout(config):
            state = self._camera.state, self._camera.pixels
            self._real = RealSensor(config, self._faults, state, self._rng, t_us, labels=True)

    def step(self, light: np.ndarray, t_us: int) -> VideoStep:
        """Return the events until the next frame."""
        config, last_us, seen = self._camera.config, self._camera.t_us, self._average(light)
        assert last_us is not None  # noqa: S101  for the type checker
        parts, dropped = [], 0
        for at_us, picture in [*self._between(light, last_us, t_us), (t_us, seen)]:
            parts.append(self._camera.step(picture, at_us))
            dropped += self._camera.dropped
        events = parts[0] if len(parts) == 1 else np.concatenate(parts)
        is_noise, self._last = np.zeros(events.size, bool), light
        self._loss.see(seen, t_us)
        if self._real is not None:
            events = self._real.events(events, last_us, t_us)
            is_noise, dropped = self._real.is_noise, dropped + self._real.lost
        return VideoStep(t_us, events, is_noise, dropped, config.width, config.height, self._loss.share)

    def _between(self, light: np.ndarray, last_us: int, t_us: int) -> Iterator[tuple[int, np.ndarray]]:
        """Yield times [us] and pictures, on the camera's pixels, between the last frame and this one."""
        if self._by_flow:
            floor = self._camera.config.luminance_floor
            for share, picture in frames_between(self._last, light, floor or LUMINANCE_FLOOR, t_us - last_us):
                yield last_us + round(share * (t_us - last_us)), self._average(picture)

    def warn(self, path: Path) -> None:
        """Warn if the frames seem to miss many events."""
        share, half = self._loss.share, self._loss.at_half_rate
        if share is not None and half is not None and share >= MUCH_LOST and not self._by_flow:
            warnings.warn(
                f"{path}: about {share:.0%} of the scene's events are missing, because nothing is seen "
                f"between two frames (every other frame alone has {half:.0%} fewer events); "
                "record at a higher frame rate, or read docs/recordings.md",
                stacklevel=3,
            )


def _frames(path: Path, fps: float | None, max_bytes: int) -> Iterator[tuple[int, np.ndarray]]:
    """Yield times [us] and values of the frames of a file or a folder."""
    if path.is_dir():
        paths, times_us = find_images(path, fps, max_bytes)
        for t_us, picture in zip(times_us, decoded_images(paths), strict=True):
            yield t_us, picture.values
        return
    if path.name in {one.name for one in LISTS}:
        raise ValueError(f"{path}: lists images; give its folder")
    check_file(path, max_bytes)
    for number, picture in enumerate(decoded_video(path)):
        yield picture.t_us if fps is None else even_time_us(number, fps), picture.values
