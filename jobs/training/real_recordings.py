"""Turn recordings of real cameras into data for the event VAE: cropped, downscaled, in control steps."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from envs.config import CameraConfig, EnvConfig, sensor_settings, settings_hash
from envs.events import EVENT
from envs.kinematics import clock_us
from envs.recordings import Recording
from envs.recordings.downscale import Downscaler
from jobs.config.schema import RecordingConfig
from jobs.run.recordings import recording_parts

GAP_US = 1_000_000  # between one recording and the next


class Recorded(NamedTuple):
    """A part of a recording.

    Attributes:
        name: Name of the file.
        events: EVENT (N,) of the simulator's sensor size, t in us from the start of the part.
        ends_us: Ends of the control steps [us], int64 (S,); the first step starts at 0.
    """

    name: str
    events: np.ndarray
    ends_us: np.ndarray


def read_recorded(
    path: str | Path, env: EnvConfig, validation_share: float, settings: RecordingConfig
) -> dict[str, Recorded]:
    """Return an event file as the simulator's camera would have recorded the middle of its picture.

    The picture is cropped to the largest centred part with the camera's proportions, and downscaled to the
    camera's resolution (`envs.recordings.downscale`). Contrast threshold, optics and motion remain the
    recording's, whatever the simulation has. Gaps of more than a second are closed.

    Args:
        path: A file that `envs.recordings.read_events` reads.
        env: The simulation: camera and control rate.
        validation_share: Fraction of the time, at the end, used for validation, 0 < share < 1.
        settings: Facts that the file does not state.

    Returns:
        The parts "train" and "validation".

    Raises:
        ValueError: The file cannot be read, does not state its sensor's size, has fewer pixels than the
            camera, or is too short for a control step in each part.
    """
    fitted = fit(path, env, settings)
    kept = round(fitted.steps * (1.0 - validation_share))
    if not 0 < kept < fitted.steps:
        least = 1 / env.control_hz / min(validation_share, 1.0 - validation_share)
        raise ValueError(
            f"{path}: must last at least {least:.3g} s, got {fitted.steps / env.control_hz:.3g} s; name "
            "another file"
        )
    spans = {"train": (0, kept), "validation": (kept, fitted.steps)}
    return {split: _part(Path(path).name, fitted.events, span, env) for split, span in spans.items()}


def read_whole(path: str | Path, env: EnvConfig, settings: RecordingConfig) -> tuple[Recorded, "Fitted"]:
    """Return a whole file as one part, read as by `read_recorded`, and the `Fitted` recording.

    Raises:
        ValueError: As in `read_recorded`, or the file is shorter than a control step.
    """
    fitted = fit(path, env, settings)
    if fitted.steps == 0:
        raise ValueError(
            f"{path}: must last at least a control step, {1 / env.control_hz:.3g} s, and contains "
            f"{fitted.num_events:,} events; name another file"
        )
    return _part(Path(path).name, fitted.events, (0, fitted.steps), env), fitted


class Fitted(NamedTuple):
    """A recording at the camera's resolution, on a clock that starts at 0 and has no gaps.

    Attributes:
        events: EVENT (N,), t in us.
        steps: Number of whole control steps.
        num_events: Number of events in the file.
        gaps: Number of gaps that were closed [-].
        closed_us: Total length of these gaps [us].
    """

    events: np.ndarray
    steps: int
    num_events: int
    gaps: int
    closed_us: int


def fit(path: str | Path, env: EnvConfig, settings: RecordingConfig) -> Fitted:
    """Read a file part by part, crop and downscale it, and close its gaps; raises like `read_recorded`."""
    small, downscale, shape = [np.empty(0, EVENT)], None, (0, 0)
    begin_us, last_us, count, gaps, closed_us = None, 0, 0, 0, 0
    step_us = round(1e6 / env.control_hz)
    for file in recording_parts(path, settings):
        if file.width is None or file.height is None:
            raise ValueError(f"{path}: does not say its sensor's size; give width and height")
        events, shape = cropped(file.events, (file.height, file.width), env.camera)
        downscale = downscale or Downscaler(shape, (env.camera.height, env.camera.width))
        events = downscale(events)
        if file.events.size:
            begin_us = int(file.events["t"][0]) - 1 if begin_us is None else begin_us
            last_us = int(file.events["t"][-1])
        shift_us = np.full(events.size, closed_us, np.int64)
        for before_us, after_us in file.gaps:
            closed_us, gaps = closed_us + after_us - before_us - step_us, gaps + 1
            shift_us[events["t"] >= after_us] = closed_us
        events["t"] -= shift_us
        count += file.events.size
        small.append(events)
    begin_us = 0 if begin_us is None else begin_us
    together = np.concatenate(small)
    together["t"] -= begin_us
    duration_us = last_us - closed_us - begin_us if count else 0
    return Fitted(together, int(duration_us * env.control_hz / 1e6), count, gaps, closed_us)


def cropped(
    events: np.ndarray, shape: tuple[int, int], camera: CameraConfig
) -> tuple[np.ndarray, tuple[int, int]]:
    """Crop to the largest centred part with a camera's proportions; return events and its shape (H, W).

    Raises:
        ValueError: The recording has fewer pixels than the camera.
    """
    scale = min(shape[0] / camera.height, shape[1] / camera.width)
    if scale < 1.0:
        size = f"{camera.width}x{camera.height}"
        raise ValueError(f"a recording must have at least {size} pixels, got {shape[1]}x{shape[0]}")
    height, width = int(scale * camera.height), int(scale * camera.width)
    top, left = (shape[0] - height) // 2, (shape[1] - width) // 2
    y, x = events["y"].astype(np.int64) - top, events["x"].astype(np.int64) - left
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    kept = events[inside]
    kept["x"], kept["y"] = x[inside], y[inside]
    return kept, (height, width)


def _part(name: str, events: np.ndarray, span: tuple[int, int], env: EnvConfig) -> Recorded:
    """Return the control steps `span` of a recording, with times from the start of the first one."""
    ends_us = np.array([clock_us(step, env.control_hz) for step in range(span[0], span[1] + 1)], np.int64)
    first, last = np.searchsorted(events["t"], ends_us[[0, -1]], side="right")
    part = events[first:last].copy()
    part["t"] -= ends_us[0]
    return Recorded(name, part, ends_us[1:] - ends_us[0])


def with_recorded(recording: Recording, parts: Sequence[tuple[Recorded, int]]) -> Recording:
    """Append parts of recordings to recorded episodes, each up to its largest number of control steps."""
    clock = int(recording.index["step_end_us"][-1]) + GAP_US if len(recording.index["step_end_us"]) else 0
    episode = int(recording.about["flights"])
    events, index, names = [recording.events], [np.stack(list(recording.index.values()))], []
    for part, most_steps in parts:
        ends = part.ends_us[:most_steps]
        if not len(ends):
            continue
        shown = part.events[: np.searchsorted(part.events["t"], ends[-1], side="right")].copy()
        shown["t"] += clock
        events.append(shown)
        starts = np.concatenate([[0], ends[:-1]])
        index.append(np.stack([clock + starts, clock + ends, np.full(len(ends), episode)]))
        names.append(part.name)
        clock, episode = clock + int(ends[-1]) + GAP_US, episode + 1
    joined = dict(zip(recording.index, np.concatenate(index, axis=1), strict=True))
    about = recording.about | {"flights": episode, "recordings": names}
    return Recording(np.concatenate(events), joined, about)


def no_episodes(env: EnvConfig) -> Recording:
    """Return an empty recording, to which real recordings are appended."""
    settings = sensor_settings(env)
    none = np.empty(0, np.int64)
    about = {"sensor": settings, "sensor_hash": settings_hash(settings), "scenes": [], "flights": 0}
    index = {"step_t_us": none, "step_end_us": none, "step_flight": none}
    return Recording(np.empty(0, EVENT), index, about)
