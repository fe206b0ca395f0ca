"""Figures of results: ways seen from above, event pictures and their copies."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Polygon

from envs.scene import Scene
from jobs.analysis.statistics import half_width
from jobs.rollout.episodes import Trajectory

OFF_COLOUR, NONE_COLOUR, ON_COLOUR = "#f97316", "#15181f", "#60a5fa"
EVENT_COLOURS = LinearSegmentedColormap.from_list("events", [OFF_COLOUR, NONE_COLOUR, ON_COLOUR])
INK, MUTED, GRID = "#1f2430", "#6b7280", "#e5e7eb"
POLICY, ORACLE, STRAIGHT = "#2563eb", "#059669", "#b45309"
AGENT_COLOURS = {"oracle": ORACLE, "straight": STRAIGHT}
OUTCOMES = {"goal": POLICY, "collision": "#dc2626", "time limit": STRAIGHT}


def reconstruction_figure(targets: np.ndarray, pictures: np.ndarray) -> Figure:
    """Event pictures above what the event VAE made of them.

    Args:
        targets: Event pictures, shape (N, H, W), in [-1, 1] or [0, 1].
        pictures: Their reconstructions, same shape.

    Raises:
        ValueError: If the shapes differ or there is nothing to show.
    """
    if targets.shape != pictures.shape or targets.ndim != 3 or len(targets) == 0:
        raise ValueError(f"pictures must be (N, H, W) as targets, got {pictures.shape} and {targets.shape}")
    across = min(8, len(targets))
    down = -(-len(targets) // across)
    figure = Figure(figsize=(1.35 * across + 0.5, 2.9 * down), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.03)  # type: ignore[union-attr, call-arg]
    panels = np.atleast_2d(figure.subplots(2 * down, across, squeeze=False))
    for panel in panels.flat:
        panel.set(xticks=[], yticks=[])
        panel.spines[:].set_color(GRID)
        panel.set_visible(False)
    for place, pair in enumerate(zip(targets, pictures, strict=True)):
        row, column = 2 * (place // across), place % across
        for below, (picture, name) in enumerate(zip(pair, ("events", "decoded"), strict=True)):
            panel = panels[row + below, column]
            panel.set_visible(True)
            panel.imshow(picture, cmap=EVENT_COLOURS, vmin=-1, vmax=1, interpolation="nearest")
            if column == 0:
                panel.set_ylabel(name, color=INK, fontsize=9)
    return figure


def trajectory_figure(tracks: Sequence[Trajectory]) -> Figure:
    """Ways from above, one corridor per seed; the policy's ways have the colour of their outcome."""
    seeds = list(dict.fromkeys(track.seed for track in tracks))
    widest = max(track.scene.width_m for track in tracks)
    across = min(2, len(seeds))
    down = -(-len(seeds) // across)
    height = 0.6 + down * (0.4 + 6.0 * (widest + 2) / 104)
    figure = Figure(figsize=(6.6 * across, height), layout="constrained")
    grid = figure.subplots(down, across, squeeze=False, sharex=True, sharey=True)
    for panel, seed in zip(grid.flat, seeds, strict=False):
        flown = [track for track in tracks if track.seed == seed]
        _draw_scene(panel, flown[0].scene, flown[0].height_m)
        for track in flown:
            _draw_way(panel, track)
        ends = ", ".join(f"{track.agent} {track.xy_m[-1, 1]:.0f} m" for track in flown)
        panel.set_title(f"corridor {seed}: {ends}", loc="left", fontsize=8.5, color=INK)
        panel.tick_params(labelsize=8)
    for panel in grid.flat[len(seeds) :]:
        panel.set_visible(False)
    figure.supxlabel("y, along the corridor [m]", fontsize=8)
    figure.supylabel("x, to the right [m]", fontsize=8)
    keys = [Line2D([], [], color=colour, lw=2, label=f"ends: {name}") for name, colour in OUTCOMES.items()]
    keys.append(Line2D([], [], color=ORACLE, lw=1.2, ls="--", label="oracle"))
    figure.legend(handles=keys, loc="outside upper center", ncols=len(keys), frameon=False, fontsize=9)
    return figure


def _draw_scene(panel: Axes, scene: Scene, height_m: float) -> None:
    """Walls, goal line and obstacles; right of the flight is down, as seen by the agent."""
    half = scene.width_m / 2
    shapes = [_outline(section) for section in scene.sections(height_m)]
    panel.add_collection(PatchCollection(shapes, facecolor="#6b7280", edgecolor="#6b7280", lw=0.5, zorder=2))
    panel.hlines([-half, half], 0, scene.length_m, color=INK, lw=2)
    panel.vlines(scene.length_m, -half, half, color=ORACLE, lw=1.5, ls=":")
    panel.set(xlim=(-2, scene.length_m + 2), ylim=(half + 1, -half - 1), aspect="equal", facecolor="#fafafa")
    panel.spines[:].set_visible(False)


def _outline(section: np.ndarray) -> Patch:
    """A section of `envs.scene.obstacles`, its y to the right and its x upwards."""
    x, y, ux, uy, hx, hy, radius = section
    if hx == 0.0 and hy == 0.0:
        return Circle((y, x), radius)
    corners = [(a * hx, b * hy) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return Polygon([(y + a * uy + b * ux, x + a * ux - b * uy) for a, b in corners])


def _draw_way(panel: Axes, track: Trajectory) -> None:
    bound = track.agent == "oracle"
    colour = ORACLE if bound else OUTCOMES[track.outcome]
    x_m, y_m = track.xy_m.T
    panel.plot(y_m, x_m, color=colour, lw=1.2 if bound else 2.0, ls="--" if bound else "-", zorder=3)
    panel.plot(y_m[0], x_m[0], "o", color=colour, ms=4, zorder=4)
    if track.outcome == "collision":
        panel.plot(y_m[-1], x_m[-1], "X", color=OUTCOMES["collision"], ms=10, mec="white", mew=1, zorder=5)


@dataclass(frozen=True)
class Curve:
    """How one training of an experiment went: environment steps, and means over the last flights (n,)."""

    exp: str
    seed: int
    env_steps: np.ndarray
    success_rate: np.ndarray
    distance_m: np.ndarray


def learning_figure(curves: Sequence[Curve]) -> Figure:
    """Success in training against steps: a line per training, their mean in bold, a panel per experiment.

    The mean, with its 95 % interval over trainings, is drawn where every one has a point before and after.
    """
    names = list(dict.fromkeys(curve.exp for curve in curves))
    across = min(4, len(names))
    down = -(-len(names) // across)
    figure = Figure(figsize=(2.9 * across + 0.4, 2.3 * down + 0.5), layout="constrained")
    panels = figure.subplots(down, across, squeeze=False, sharey=True)
    for panel, name in zip(panels.flat, names, strict=False):
        own = [curve for curve in curves if curve.exp == name and curve.env_steps.size]
        for curve in own:
            panel.plot(curve.env_steps / 1e3, 100 * curve.success_rate, color=POLICY, lw=0.8, alpha=0.5)
        if own:
            steps = np.linspace(
                max(curve.env_steps[0] for curve in own), min(curve.env_steps[-1] for curve in own), 100
            )
            every = [np.interp(steps, curve.env_steps, curve.success_rate) for curve in own]
            mean = 100 * np.mean(every, axis=0)
            if len(own) > 1:
                half = 100 * half_width(np.array(every))
                ends = np.clip([mean - half, mean + half], 0, 100)
                panel.fill_between(steps / 1e3, *ends, color=POLICY, alpha=0.15, lw=0)
            panel.plot(steps / 1e3, mean, color=POLICY, lw=2.2)
            panel.annotate(
                f"{mean[-1]:.0f} %", (steps[-1] / 1e3, mean[-1]), (-2, -14), textcoords="offset points",
                ha="right", fontsize=9, color=INK,
            )  # fmt: skip
        plural = "s" if len(own) != 1 else ""
        panel.set_title(f"{name}, {len(own)} training{plural}", loc="left", fontsize=9, color=INK)
        panel.grid(axis="y", color=GRID)
        panel.set(ylim=(-3, 103))
        panel.tick_params(labelsize=8)
        panel.spines[["top", "right"]].set_visible(False)
    for panel in panels.flat[len(names) :]:
        panel.set_visible(False)
    figure.supxlabel("Environment steps [thousands]", fontsize=9)
    figure.supylabel("Success of the last 100 flights [%]", fontsize=9)
    return figure
