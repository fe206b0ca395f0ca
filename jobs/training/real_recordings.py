"""Real cameras' recordings as data of the event VAE: cropped, with the simulator's pixels, cut into steps."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from envs.config import CameraConfig, EnvConfig, sensor_settings, settings_hash
from envs.events import EVENT
from envs.kinematics import clock_us
from envs.recordings import Recording, downscale_events, read_events

GAP_US = 1_000_000  # between one recording and the next


class Recorded(NamedTuple):
    """A part of a recording.

    Attributes:
        name: The file's.
        events: EVENT (N,) of the simulator's sensor size, t in us from the beginning of the part.
        ends_us: Ends of its control steps, int64 (S,); the first begins at 0.
    """

    name: str
    events: np.ndarray
    ends_us: np.ndarray


def read_recorded(path: str | Path, env: EnvConfig, validation_share: float) -> dict[str, Recorded]:
    """An event file as the simulator's camera would have seen its middle.

    Of the picture the largest part of the camera's proportions stays, around the centre; pixels are
    made as large as the camera has them (`envs.recordings.downscale`). Contrast threshold, optics and motion
    stay those of the recording, whatever the simulation's are.

    Args:
        path: A file that `envs.recordings.read_events` reads, which says its sensor's size.
        env: The simulation: camera and control rate.
        validation_share: Of the time, at the end, that is kept for validation, 0 < share < 1.

    Returns:
        "train" and "validation".

    Raises:
        ValueError: The file is refused, does not say its size, has fewer pixels than the camera, or
            is too short for a control step of either part.
    """
    events, begin_us, steps = _fitted(path, env)
    kept = round(steps * (1.0 - validation_share))
    if not 0 < kept < steps:
        least = 1 / env.control_hz / min(validation_share, 1.0 - validation_share)
        raise ValueError(f"{path}: must last at least {least:.3g} s, got {steps / env.control_hz:.3g} s")
    spans = {"train": (0, kept), "validation": (kept, steps)}
    return {split: _part(Path(path).name, events, begin_us, span, env) for split, span in spans.items()}


def read_whole(path: str | Path, env: EnvConfig) -> Recorded:
    """As `read_recorded`, all of it; ValueError also if it is shorter than a control step."""
    events, begin_us, steps = _fitted(path, env)
    if steps == 0:
        raise ValueError(f"{path}: must last at least a control step, {1 / env.control_hz:.3g} s")
    return _part(Path(path).name, events, begin_us, (0, steps), env)


def _fitted(path: str | Path, env: EnvConfig) -> tuple[np.ndarray, int, int]:
    """The events of a file as the camera's, the time before the first [us], and their whole control steps."""
    file = read_events(path)
    if file.width is None or file.height is None:
        raise ValueError(
            f"{path}: does not say its sensor's size; write it with envs.recordings.write_events"
        )
    events, shape = cropped(file.events, (file.height, file.width), env.camera)
    events = downscale_events(events, shape, (env.camera.height, env.camera.width))
    begin_us = int(file.events["t"][0]) - 1 if file.events.size else 0
    duration_us = int(file.events["t"][-1]) - begin_us if file.events.size else 0
    return events, begin_us, int(duration_us * env.control_hz / 1e6)


def cropped(
    events: np.ndarray, shape: tuple[int, int], camera: CameraConfig
) -> tuple[np.ndarray, tuple[int, int]]:
    """The events of the largest part in the middle that has a camera's proportions, and its shape (H, W).

    Raises:
        ValueError: It has fewer pixels than the camera.
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


def _part(name: str, events: np.ndarray, begin_us: int, span: tuple[int, int], env: EnvConfig) -> Recorded:
    """Some control steps of a recording, on a clock of their own."""
    ends_us = np.array([clock_us(step, env.control_hz) for step in range(span[0], span[1] + 1)], np.int64)
    first, last = np.searchsorted(events["t"], begin_us + ends_us[[0, -1]], side="right")
    part = events[first:last].copy()
    part["t"] -= begin_us + ends_us[0]
    return Recorded(name, part, ends_us[1:] - ends_us[0])


def with_recorded(recording: Recording, parts: Sequence[tuple[Recorded, int]]) -> Recording:
    """A recording of episodes with parts of others behind it, each of at most a number of control steps."""
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
    """The recording of nothing, for real recordings alone."""
    settings = sensor_settings(env)
    none = np.empty(0, np.int64)
    about = {"sensor": settings, "sensor_hash": settings_hash(settings), "scenes": [], "flights": 0}
    index = {"step_t_us": none, "step_end_us": none, "step_flight": none}
    return Recording(np.empty(0, EVENT), index, about)
