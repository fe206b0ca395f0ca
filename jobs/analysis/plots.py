"""Plots of results: trajectories from above, event pictures and learning curves; the styles of groups."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.colors import LinearSegmentedColormap, to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Polygon

from envs.scene import Scene
from jobs.analysis.colours import (
    BASELINE_STYLES,
    COLOURS,
    EVENTS,
    GREEN,
    GRID,
    GROUP_STYLES,
    INK,
    MUTED,
    OTHER_STYLES,
    RED,
    TAUGHT,
)
from jobs.analysis.ground_plan import ground_plan
from jobs.rollout.episodes import Trajectory

EVENT_COLOURS = LinearSegmentedColormap.from_list("events", EVENTS / 255.0)


def style_of(group: str) -> tuple[str, str]:
    """Return a group's colour and marker, the same in every plot; a taught kind has its kind's, but paler."""
    kind = group.removeprefix(TAUGHT)
    if kind != group and kind in GROUP_STYLES:
        colour, marker = GROUP_STYLES[kind]
        red, green, blue = (0.55 * part + 0.45 for part in to_rgb(colour))
        return to_hex((red, green, blue)), marker
    return (GROUP_STYLES | BASELINE_STYLES).get(group) or OTHER_STYLES[
        sum(group.encode()) % len(OTHER_STYLES)
    ]


def tidy(panel: Axes, grid: str = "both") -> None:
    """Draw a light grid along an axis or "both", and remove the frame at the top and on the right."""
    panel.grid(axis=grid, color=GRID)  # type: ignore[arg-type]
    panel.spines[["top", "right"]].set_visible(False)


def panel_grid(
    count: int, max_across: int, size: tuple[float, float], margin: tuple[float, float], **shared: Any
) -> tuple[Figure, list[Axes]]:
    """Create a figure of `count` panels in rows of at most `max_across`.

    Args:
        count: Panels.
        max_across: Panels side by side.
        size: Width and height of a panel [inches].
        margin: Width and height that the figure has in addition to the panels [inches].
        **shared: Arguments of `Figure.subplots`, such as sharex.
    """
    across = min(max_across, count)
    down = -(-count // across)
    inches = size[0] * across + margin[0], size[1] * down + margin[1]
    figure = Figure(figsize=inches, layout="constrained")
    panels = list(figure.subplots(down, across, squeeze=False, **shared).flat)
    for panel in panels[count:]:
        panel.set_visible(False)
    return figure, panels[:count]


def plot_reconstructions(targets: np.ndarray, pictures: np.ndarray) -> Figure:
    """Draw event pictures above their reconstructions by the event VAE.

    Args:
        targets: Event pictures, shape (N, H, W), in [-1, 1] or [0, 1].
        pictures: Their reconstructions, same shape.

    Raises:
        ValueError: The shapes differ, or there are no pictures.
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


def plot_trajectories(tracks: Sequence[Trajectory]) -> Figure:
    """Draw trajectories from above, a panel per corridor; the policy's are coloured by outcome."""
    seeds = list(dict.fromkeys(track.seed for track in tracks))
    height = 0.4 + 6.0 * (max(track.scene.width_m for track in tracks) + 2) / 104
    figure, panels = panel_grid(len(seeds), 2, (6.6, height), (0.0, 0.6), sharex=True, sharey=True)
    for panel, seed in zip(panels, seeds, strict=True):
        own = [track for track in tracks if track.seed == seed]
        _draw_scene(panel, own[0].scene, own[0].height_m)
        for track in own:
            _draw_trajectory(panel, track)
        ends = ", ".join(f"{track.agent} {track.xy_m[-1, 1]:.0f} m" for track in own)
        panel.set_title(f"corridor {seed}: {ends}", loc="left", fontsize=8.5, color=INK)
        panel.tick_params(labelsize=8)
    figure.supxlabel("y, along the corridor [m]", fontsize=8)
    figure.supylabel("x, to the right [m]", fontsize=8)
    outcomes = ("goal", "collision", "time limit")
    keys = [Line2D([], [], color=COLOURS[name], lw=2, label=f"ends: {name}") for name in outcomes]
    keys.append(Line2D([], [], color=GREEN, lw=1.2, ls="--", label="oracle"))
    figure.legend(handles=keys, loc="outside upper center", ncols=len(keys), frameon=False, fontsize=9)
    return figure


def _draw_scene(panel: Axes, scene: Scene, height_m: float) -> None:
    """Draw walls, goal line and obstacles; the vehicle's right is down."""
    half = scene.width_m / 2
    circles, corners = ground_plan(scene, height_m)
    shapes: list[Patch] = [Circle((y, x), radius) for x, y, radius in circles]
    shapes += [Polygon(own[:, ::-1]) for own in corners]
    panel.add_collection(PatchCollection(shapes, facecolor=MUTED, edgecolor=MUTED, lw=0.5, zorder=2))
    panel.hlines([-half, half], 0, scene.length_m, color=INK, lw=2)
    panel.vlines(scene.length_m, -half, half, color=GREEN, lw=1.5, ls=":")
    panel.set(xlim=(-2, scene.length_m + 2), ylim=(half + 1, -half - 1), aspect="equal", facecolor="#fafafa")
    panel.spines[:].set_visible(False)


def _draw_trajectory(panel: Axes, track: Trajectory) -> None:
    oracle = track.agent == "oracle"
    colour = GREEN if oracle else COLOURS[track.outcome]
    x_m, y_m = track.xy_m.T
    panel.plot(y_m, x_m, color=colour, lw=1.2 if oracle else 2.0, ls="--" if oracle else "-", zorder=3)
    panel.plot(y_m[0], x_m[0], "o", color=colour, ms=4, zorder=4)
    if track.outcome == "collision":
        panel.plot(y_m[-1], x_m[-1], "X", color=RED, ms=10, mec="white", mew=1, zorder=5)


@dataclass(frozen=True)
class Curve:
    """One training of an experiment: environment steps, and means over the last episodes, (n,) each."""

    exp: str
    seed: int
    env_steps: np.ndarray
    success_rate: np.ndarray
    distance_m: np.ndarray


def plot_learning_curves(curves: Sequence[Curve]) -> Figure:
    """Draw success in training against steps: a line for each experiment, the mean of its trainings.

    A line spans the steps that all trainings have in common. The legend has the final means, best first.
    """
    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    panel = figure.subplots()
    means = []
    for name in dict.fromkeys(curve.exp for curve in curves if curve.env_steps.size):
        own = [curve for curve in curves if curve.exp == name and curve.env_steps.size]
        first, last = max(one.env_steps[0] for one in own), min(one.env_steps[-1] for one in own)
        steps = np.linspace(first, last, 100)
        every = [np.interp(steps, one.env_steps, one.success_rate) for one in own]
        means.append((name, len(own), steps, 100 * np.mean(every, axis=0)))
    for name, count, steps, mean in sorted(means, key=lambda one: -one[-1][-1]):
        colour, marker = style_of(name)
        label = f"{name}: {mean[-1]:.0f} %, {count} seed{'s' if count > 1 else ''}"
        panel.plot(steps / 1e3, mean, color=colour, marker=marker, markevery=12, ms=6, lw=1.8, label=label)
    panel.set(ylim=(-3, 103), xlabel="Environment steps [thousands]")
    panel.set_ylabel("Success of the last 100 training episodes [%]")
    tidy(panel, "y")
    figure.legend(loc="outside right upper", frameon=False, fontsize=9)
    return figure
