"""The plot of a trade: speed against event error, and against the change of success; a row for each scene."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jobs.analysis.plots import COLOURS, INK, MUTED, tidy

MARKERS = {"default": "*", "most exact": "D", "precision": "s", "time bins": "s", "newest events": "s"}
RATIOS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
Range = tuple[float, float, float]  # a value and the ends of its interval


class TradePoint(NamedTuple):
    """A setting in a scene.

    Attributes:
        scene: Where.
        knob: What is varied.
        name: To what, in a word.
        speed: Times the default's.
        error: Share of events that differ [%], NaN where none changes.
        difference: Of success, to the default's [points].
        groups: The same of each group of policies.
        front: Whether no other setting beats it.
    """

    scene: str
    knob: str
    name: str
    speed: Range
    error: float
    difference: Range
    groups: tuple[float, ...]
    front: bool


def plot_trade(points: Sequence[TradePoint], margin: float) -> Figure:
    """Draw all settings; `margin` is what success may lose [points]."""
    scenes = list(dict.fromkeys(point.scene for point in points))
    figure = Figure(figsize=(11.0, 4.4 * len(scenes) + 0.6), layout="constrained")
    every = figure.subplots(len(scenes), 2, squeeze=False)
    for scene, (errors, changes) in zip(scenes, every, strict=True):
        own = [point for point in points if point.scene == scene]
        _draw_errors(errors, [point for point in own if point.error == point.error])
        _draw_changes(changes, own, margin)
        errors.set_title(f"Scene {scene}", loc="left", fontsize=10, color=INK)
    known: dict[str, Artist] = {}
    for axes in every.flat:
        known |= dict(zip(*axes.get_legend_handles_labels()[::-1], strict=True))
    figure.legend(list(known.values()), list(known), loc="outside lower center", ncols=7, frameon=False)
    return figure


def _draw_errors(axes: Axes, points: Sequence[TradePoint]) -> None:
    """Event error over speed; what no setting beats is ringed."""
    front = [(point.speed[0], point.error) for point in points if point.front]
    axes.plot(*np.array(front).T, "o", ms=12, mfc="none", mec=MUTED, zorder=1, label="beaten by none")
    _scatter(axes, points, [(point.error,) * 3 for point in points])
    axes.set_yscale("symlog", linthresh=1.0)
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_ylim(-0.1, 1.6 * max(point.error for point in points))
    axes.set_ylabel("Events that differ [%]")


def _draw_changes(axes: Axes, points: Sequence[TradePoint], margin: float) -> None:
    """Change of success over speed, with what may be lost."""
    axes.axhline(0.0, color=MUTED, lw=0.8)
    axes.axhline(-margin, color=MUTED, lw=0.8, ls=":", label="what may be lost")
    for point in points:
        axes.plot([point.speed[0]] * len(point.groups), point.groups, "_", color=MUTED, ms=7, zorder=2)
    _scatter(axes, points, [point.difference for point in points])
    axes.set_ylabel("Success minus the default's [points]")


def _scatter(axes: Axes, points: Sequence[TradePoint], values: Sequence[Range]) -> None:
    """Points of all settings at their speed, with both intervals, named."""
    for point, (value, low, high) in zip(points, values, strict=True):
        speed, slow, fast = point.speed
        colour, usual = COLOURS[point.knob], point.knob == "default"
        axes.errorbar(
            speed, value, [[value - low], [high - value]], [[speed - slow], [fast - speed]],
            fmt="none", ecolor=colour, elinewidth=0.8, alpha=0.4, zorder=2,
        )  # fmt: skip
        size, marker = (240, "*") if usual else (34, MARKERS.get(point.knob, "o"))
        axes.scatter([speed], [value], marker=marker, s=size, color=colour, label=point.knob, zorder=3)
        if not usual:
            axes.annotate(
                point.name, (speed, value), (4, 3), textcoords="offset points", fontsize=6, color=INK
            )
    axes.set(xscale="log", xlabel="Speed, times the default's")
    ends = [end for point in points for end in point.speed]
    ticks = [tick for tick in RATIOS if 0.8 * min(ends) < tick < 1.25 * max(ends)]
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_xticks([], minor=True)
    tidy(axes)
