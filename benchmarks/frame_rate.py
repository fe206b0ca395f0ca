"""Measure how many events a low frame rate misses, the estimate of that loss, and the gain by optical flow.

Run: OMP_NUM_THREADS=1 python -m benchmarks.frame_rate
Expect: a table in about half a minute. Corridors of poles, straight through at 20 m/s, 96x72 pixels. Frames
at 1,000 Hz are the truth; the rows use every 16th, 32nd and 64th of them. "Missed": missing share of the true
events, and its estimate by `FrameLoss` from the frames alone. "r": correlation of net events per pixel and
5 ms, blurred by a pixel. "flow" needs OpenCV (the extra `flow`), and is left out without it.
"""

import importlib.util

import numpy as np
from scipy.ndimage import gaussian_filter

from envs.config import CameraConfig, FaultsConfig
from envs.raycast import RaycastRenderer
from envs.recordings.video import Eye
from envs.scene import make_scene
from jobs.analysis.tables import show_table

CORRIDORS, SECONDS, SPEED_MPS, TRUE_HZ = 4, 1.536, 20.0, 1000
EVERY = (16, 32, 64)
WINDOW_US = 5000
CAMERA = CameraConfig(width=96, height=72)
HEADINGS = ("Frames at [Hz]", "Between them", "Events [%]", "Missed [%]", "Estimate [%]", "r")


def main() -> None:
    """Measure and print the table."""
    films = [film(seed) for seed in range(CORRIDORS)]
    truths = [seen(frames, 1, by_flow=False)[0] for frames in films]
    ways = (False, True) if importlib.util.find_spec("cv2") else (False,)
    rows = []
    for every in EVERY:
        for by_flow in ways:
            told = [seen(frames, every, by_flow) for frames in films]
            events = [events for events, _ in told]
            share = sum(map(len, events)) / sum(map(len, truths))
            estimate = float(np.mean([estimate for _, estimate in told]))
            rows.append(
                (
                    f"{TRUE_HZ / every:.0f}",
                    "flow" if by_flow else "a line",
                    f"{100 * share:.0f}",
                    f"{100 * (1 - share):.0f}",
                    f"{100 * estimate:.0f}",
                    f"{likeness(truths, events):.2f}",
                )
            )
    show_table("Events of frames at a low rate", HEADINGS, rows, words=2)


def film(seed: int) -> np.ndarray:
    """Return frames of a corridor at `TRUE_HZ`, float32 (K, H, W); each of `EVERY` divides K - 1."""
    renderer = RaycastRenderer(
        make_scene("poles", np.random.default_rng(seed)),
        CAMERA.width,
        CAMERA.height,
        CAMERA.fov_deg,
        samples=4,
    )
    times_s = np.arange(round(SECONDS * TRUE_HZ) + 1) / TRUE_HZ
    return np.stack([renderer.render(0.0, 10.0 + SPEED_MPS * t, 2.0).copy() for t in times_s.tolist()])


def seen(frames: np.ndarray, every: int, by_flow: bool) -> tuple[np.ndarray, float]:
    """Return the events of each `every`-th frame, and the estimated share of missed events."""
    eye = Eye(CAMERA, FaultsConfig(), np.random.default_rng(0), by_flow)
    eye.reset(frames[0], 0)
    steps = [
        eye.step(frames[place], place * 1_000_000 // TRUE_HZ) for place in range(every, len(frames), every)
    ]
    return np.concatenate([step.events for step in steps]), steps[-1].missed or 0.0


def likeness(truths: list[np.ndarray], others: list[np.ndarray]) -> float:
    """Return the correlation of net events per pixel and window, blurred by a pixel, over all corridors."""
    pairs = zip(truths, others, strict=True)
    images = [(net_images(truth), net_images(other)) for truth, other in pairs]
    first, second = (np.concatenate(side).ravel() for side in zip(*images, strict=True))
    return float(np.corrcoef(first, second)[0, 1])


def net_images(events: np.ndarray) -> np.ndarray:
    """Return ON minus OFF events of each window of 5 ms, blurred by a pixel, float64 (windows, H, W)."""
    windows = int(SECONDS * 1_000_000) // WINDOW_US + 1
    net = np.zeros((windows, CAMERA.height, CAMERA.width))
    np.add.at(net, (events["t"] // WINDOW_US, events["y"], events["x"]), events["p"])
    return gaussian_filter(net, (0.0, 1.0, 1.0))


if __name__ == "__main__":
    main()
