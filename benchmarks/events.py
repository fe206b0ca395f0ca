"""Compare the event camera's time per frame with plain copying and with the paper's published design.

Run: OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python -m benchmarks.events
Expect: two tables in about two minutes, on one thread; medians of interleaved frames in one run.
The scene is 24 gratings and three bars that move 0.1 ("sparse") or 1 ("dense") pixels per frame
of 5 ms; threshold 0.2.

Columns. "together": time per frame if all frames are passed in one call (`EventCamera.steps`),
like the renders of a control step in the simulator. "of copying": time relative to `np.copyto`
of the bytes that any design with this memory has to touch: 12 per pixel (luminance 4, quiet
band 8) and 37 per event (the event 13, the pixel's level 16 and band 8). The last "published"
and "together": how many times longer the paper's design takes than one call per frame, and than
one call for all. The design is rewritten here: a loop over all pixels with two logarithms each,
and a structured sort by field name. It produces fewer events, see memory "legacy" in
`envs.events.camera`.

A second table has the cost of each effect of a real sensor, and of the lights of conf/light: process time of
an environment step at 64x64 and 200 Hz in the same corridors, with the effects interleaved in each step, and
the median of the ratios to a step without effects.
"""

import time
from collections.abc import Callable

import numba
import numpy as np
import yaml

from envs.config import EnvConfig
from envs.corridor import CorridorEnv
from envs.events import EventCamera
from jobs.analysis.tables import show_table
from jobs.config.env_keys import env_with
from jobs.run.provenance import REPOSITORY

SIZES = ((64, 64), (346, 260), (640, 480), (1280, 720))
SPEEDS = (("sparse", 0.1), ("dense", 1.0))  # pixels per frame
FRAMES = 12
INTERVAL_US = 5000
THRESHOLD = 0.2
SECONDS = 2.5  # time of measuring, per row
PIXEL_BYTES, EVENT_BYTES = 12, 37
EPISODES, STEPS = 4, 150  # for the times of effects
EFFECTS: dict[str, dict[str, object]] = {
    "none": {},
    "whole images": {"camera.refractory_us": 1},
    "cutoff": {"camera.cutoff_hz": 30.0},
    "mismatch": {"camera.threshold_mismatch": 0.25},
    "leakage": {"faults.leak_hz": 0.1, "faults.leak_jitter": 0.1},
    "shot noise": {"faults.shot_noise_hz": 5.0},
    "hot pixels": {"faults.hot_pixel_share": 0.005, "faults.hot_pixel_hz": 100.0},
    "latency, jitter": {"camera.latency_us": 100, "camera.latency_jitter_us": 50.0},
    "readout limit": {"camera.readout_hz": 1e6},
}
PUBLISHED_EVENT = np.dtype([("timestamp", "f8"), ("x", "u2"), ("y", "u2"), ("polarity", "b")], align=True)


def main() -> None:
    """Measure and print both tables."""
    head = ["pixels", "scene", "us/frame", "together", "events/pixel", "ns/pixel", "of copying"]
    rows = []
    for width, height in SIZES:
        for name, speed in SPEEDS:
            frames = moving_gratings(width, height, speed)
            events, seconds = design_times(frames)
            pixels, ours, together = width * height, seconds["ours"], seconds["together"]
            times = (f"{1e6 * ours:,.1f}", f"{1e6 * together:,.1f}")
            row = (*times, f"{events / pixels:.4f}", f"{1e9 * ours / pixels:.2f}")
            ratios = [f"{ours / seconds['copying']:.1f}x"]
            ratios += [f"{seconds['published'] / one:.1f}x" for one in (ours, together)]
            rows.append((f"{width}x{height}", name, *row, *ratios))
    title = "Event camera, one thread, 5 ms per frame, threshold 0.2"
    show_table(title, [*head, "published", "together"], rows, 2)
    show_effects()


def show_effects() -> None:
    """Measure and print the cost of each effect of a real sensor."""
    changes = EFFECTS | {f"light={name}": light_settings(name) for name in ("day", "dusk", "night")}
    base = EnvConfig(window_capacity=None, split="validation")
    envs = {name: CorridorEnv(env_with(base, change)) for name, change in changes.items()}
    seconds: dict[str, list[float]] = {name: [] for name in envs}
    events, names = dict.fromkeys(envs, 0), list(envs)
    for episode in range(EPISODES):
        for env in envs.values():
            env.reset(seed=episode)
        for step, action in enumerate(np.random.default_rng(episode).integers(0, 3, STEPS).tolist()):
            over, first = False, step % len(names)  # take turns as the first, with cold caches
            for name in names[first:] + names[:first]:
                env = envs[name]
                start = time.process_time()
                over |= env.step(action)[2]
                seconds[name].append(time.process_time() - start)
                events[name] += env.events.size
            if over:
                break
    none, rows = np.array(seconds["none"]), []
    for name, taken in seconds.items():
        ratio = float(np.median(np.array(taken) / none))
        per_step = f"{1e6 * np.median(taken):,.0f}", f"{ratio:.2f}x", f"{events[name] / none.size:.0f}"
        rows.append((name, *per_step))
    show_table("Effects of a real sensor", ["effect", "us/step", "of none", "events/step"], rows, 1)


def light_settings(name: str) -> dict[str, object]:
    """Return the settings of a light in conf/light, by their keys."""
    groups = yaml.safe_load((REPOSITORY / "conf" / "light" / f"{name}.yaml").read_text())
    return {f"{group}.{key}": value for group, values in groups.items() for key, value in values.items()}


def moving_gratings(width: int, height: int, speed: float) -> list[np.ndarray]:
    """Return frames of 24 random gratings of 1 to 12 cycles per width, behind three dark bars."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    wave = 2 * np.pi * rng.uniform(1, 12, 24) / width
    angle, phase = rng.uniform(0, 2 * np.pi, (2, 24))
    frames = []
    for k in range(FRAMES):
        level = np.zeros((height, width), np.float32)
        for along, across, shift in zip(wave * np.cos(angle), wave * np.sin(angle), phase, strict=True):
            level += np.sin(along * (x - speed * k) + across * y + shift, dtype=np.float32)
        luminance = 0.5 * np.exp(0.08 * level)
        for bar in range(3):
            place = (width * (bar + 0.5) / 3 + speed * k) % width
            luminance *= 1 - 0.7 * np.clip(2.5 - np.abs(x - place), 0, 1)
        frames.append(luminance.astype(np.float32))
    return frames


def design_times(frames: list[np.ndarray]) -> tuple[float, dict[str, float]]:
    """Return the camera's events per frame, and the median seconds per frame of each design."""
    height, width = frames[0].shape
    camera, published = EventCamera(width, height, contrast_threshold=THRESHOLD), Published(width, height)
    times, stack = [k * INTERVAL_US for k in range(1, FRAMES)], np.stack(frames[1:])
    camera.reset(frames[0], 0)
    events = camera.steps(stack, times).size / len(times)
    source = np.ones(int(PIXEL_BYTES * width * height + EVENT_BYTES * events), np.uint8)
    target = np.empty_like(source)
    starts: dict[str, Callable[[], object]] = {
        "ours": lambda: camera.reset(frames[0], 0),
        "together": lambda: camera.reset(frames[0], 0),
        "copying": lambda: None,
        "published": lambda: published.reset(frames[0]),
    }
    steps: dict[str, Callable[[np.ndarray, int], object]] = {
        "ours": camera.step,
        "together": lambda _, t_us: camera.steps(stack, times) if t_us == times[0] else None,
        "copying": lambda frame, t_us: np.copyto(target, source),
        "published": published.step,
    }
    taken: dict[str, list[float]] = {name: [] for name in steps}
    end = time.perf_counter() + SECONDS
    while time.perf_counter() < end or len(taken["ours"]) < 2 * FRAMES:
        for name, step in steps.items():
            starts[name]()
            for frame, t_us in zip(stack, times, strict=True):
                start = time.perf_counter()
                step(frame, t_us)
                taken[name].append(time.perf_counter() - start)
    taken["together"] = [seconds / len(times) for seconds in taken["together"][:: len(times)]]
    return events, {name: float(np.median(seconds[len(seconds) // 9 :])) for name, seconds in taken.items()}


class Published:
    """The design of the paper's published simulator, with the clock in microseconds."""

    def __init__(self, width: int, height: int) -> None:
        """Create a camera for frames of (height, width)."""
        self._width = width
        self._last = np.zeros(width * height, np.float32)
        self._t_us = 0.0
        self.active = 0

    def reset(self, luminance: np.ndarray) -> None:
        """Start from `luminance` at time 0."""
        self._last, self._t_us = luminance.ravel() + np.float32(0.001), 0.0

    def step(self, luminance: np.ndarray, t_us: int) -> np.ndarray:
        """Return the events since the last frame, sorted by time only."""
        current = luminance.ravel() + np.float32(0.001)
        output, image = np.zeros(10 * current.size, PUBLISHED_EVENT), np.zeros(current.size)
        interval = t_us - self._t_us
        count = published_events(current, self._last, (self._t_us, interval, self._width), output, image)
        self.active = np.nonzero(image)[0].size
        self._last, self._t_us = current, t_us
        events = output[:count]
        events.sort(order=["timestamp"])
        return events


@numba.njit(cache=True, error_model="numpy")
def published_events(current, last, frame, output, image):  # type: ignore[no-untyped-def]
    """Write a pixel's whole thresholds less one as events, at most 10; return the number of events."""
    t0, interval, width = frame
    count = 0
    for i in range(current.size):
        change = np.log(current[i]) - np.log(last[i])
        if abs(change) < THRESHOLD:
            continue
        number = min(int((abs(change) - THRESHOLD) / THRESHOLD), 10)
        if number > 0:
            image[i] = 255
        for k in range(number):
            output[count].timestamp = t0 + k * interval / number
            output[count].x, output[count].y = i % width, i // width
            output[count].polarity = 1 if change > 0 else -1
            count += 1
    return count


if __name__ == "__main__":
    main()
