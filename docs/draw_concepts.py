"""Draw the figures of docs/events.md: one pixel of an event camera, as the simulator computes it.

Run from the repository root: python -m docs.draw_concepts
"""

from pathlib import Path

import matplotlib as mpl
import numpy as np

mpl.use("Agg")
import matplotlib.pyplot as plt

from envs.config import CameraConfig
from envs.events import EventCamera

IMAGES = Path(__file__).resolve().parent / "images"
ON, OFF = "#2563eb", "#c2410c"
FRAMES, FRAME_US = 60, 1000


def main() -> None:
    """Draw one pixel in both memory modes."""
    time_ms = np.arange(FRAMES) * FRAME_US / 1000
    light = 0.35 + 0.3 * np.sin(time_ms / 9.0) * np.exp(-time_ms / 60.0) + 0.1 * (time_ms > 40)
    figure, axes = plt.subplots(1, 2, figsize=(10, 3.4), sharey=True, layout="constrained")
    titles = {"reference": "reference: the level of the last event", "frame": "frame: the frame before"}
    for ax, (memory, title) in zip(axes, titles.items(), strict=True):
        draw_pixel(ax, time_ms, light, memory)
        ax.set(title=f"camera.memory = {title}", xlabel="time [ms]")
    axes[0].set_ylabel("log of the light of one pixel")
    axes[0].legend(frameon=False, loc="lower left")
    figure.savefig(IMAGES / "concept_pixel.png", dpi=110)


def draw_pixel(ax: plt.Axes, time_ms: np.ndarray, light: np.ndarray, memory: str) -> None:
    """Draw the light of a pixel, levels one threshold apart, and the pixel's events."""
    camera = EventCamera(CameraConfig(width=1, height=1, contrast_threshold=0.15, memory=memory))
    frames = light.astype(np.float32).reshape(-1, 1, 1)
    camera.reset(frames[0], 0)
    events = np.concatenate([camera.step(frame, (k + 1) * FRAME_US) for k, frame in enumerate(frames[1:])])
    log = np.log(light + camera.config.luminance_floor)
    for level in np.arange(log[0] - 1.5, log[0] + 1.5, 0.15):
        ax.axhline(level, color="0.9", zorder=0)
    ax.plot(time_ms, log, color="0.2")
    for sign, colour, name in ((1, ON, "ON"), (-1, OFF, "OFF")):
        own = events["t"][events["p"] == sign] / 1000
        at = np.interp(own, time_ms, log)
        ax.plot(own, at, "^" if sign > 0 else "v", color=colour, label=f"{name}: {len(own)} events")
    ax.set_ylim(log.min() - 0.15, log.max() + 0.15)
    if memory == "frame":
        ax.legend(frameon=False, loc="lower left")


if __name__ == "__main__":
    main()
