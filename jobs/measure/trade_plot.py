"""The plot of a trade: a row for each setting, with its speed, its event error and the change of success."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jobs.analysis.colours import INK, MUTED
from jobs.analysis.plots import tidy

Range = tuple[float, float, float]  # a value and the ends of its interval
STYLES = (("o", "#2563eb"), ("^", "#d97706"), ("s", "#111827"))  # of scenes, told apart without colour too
APART = 0.3  # of the scenes within a row
HEADINGS = ("Speed, times the default's", "Events that differ [%]", "Success minus the default's [points]")


class TradePoint(NamedTuple):
    """A setting in a scene.

    Attributes:
        scene: Where.
        name: The setting.
        speed: Times the default's.
        error: Share of events that differ [%], NaN where none changes.
        difference: Of success, to the default's [points].
        front: Whether no other setting beats it.
    """

    scene: str
    name: str
    speed: Range
    error: float
    difference: Range
    front: bool


def plot_trade(points: Sequence[TradePoint], margin: float) -> Figure:
    """Draw all settings; `margin` is what success may lose [points]."""
    names = list(dict.fromkeys(point.name for point in points))
    scenes = list(dict.fromkeys(point.scene for point in points))
    figure = Figure(figsize=(10.0, 1.3 + 0.27 * len(names)), layout="constrained")
    panels = figure.subplots(1, 3, sharey=True)
    for number, scene in enumerate(scenes):
        own = {point.name: point for point in points if point.scene == scene}
        rows = np.array([names.index(name) for name in own]) + APART * (number - (len(scenes) - 1) / 2)
        marker, colour = STYLES[number % len(STYLES)]
        errors = [(point.error, point.error, point.error) for point in own.values()]
        for panel, values in zip(
            panels,
            ([one.speed for one in own.values()], errors, [one.difference for one in own.values()]),
            strict=True,
        ):
            _dots(panel, rows, values, marker, colour, scene)
    _dress(panels, names, {point.name for point in points if point.front}, margin)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper right", ncols=3, frameon=False)
    return figure


def _dots(
    panel: Axes, rows: np.ndarray, values: Sequence[Range], marker: str, colour: str, label: str
) -> None:
    """Draw the values of a scene with their intervals, filled; NaN leaves a row empty."""
    middle, low, high = np.array(values).T
    panel.hlines(rows, low, high, color=colour, lw=1.2, alpha=0.6)
    panel.scatter(middle, rows, marker=marker, s=26, color=colour, label=label, zorder=3)


def _dress(panels: Sequence[Axes], names: Sequence[str], front: set[str], margin: float) -> None:
    """Name rows and axes, and mark the default's values and what success may lose."""
    for panel, heading, usual in zip(panels, HEADINGS, (1.0, None, 0.0), strict=True):
        panel.set_xlabel(heading)
        if usual is not None:
            panel.axvline(usual, color=MUTED, lw=0.8)
        panel.grid(axis="y", color="#e5e7eb", lw=0.6)
        tidy(panel)
    panels[0].set_xscale("log")
    panels[0].set_xticks([0.05, 0.1, 0.2, 0.5, 1, 2], ["0.05", "0.1", "0.2", "0.5", "1", "2"])
    panels[0].set_xticks([], minor=True)
    panels[1].set_xscale("symlog", linthresh=1.0)
    panels[1].set_xticks([0, 1, 3, 10, 30, 100], ["0", "1", "3", "10", "30", "100"])
    panels[2].axvline(-margin, color=MUTED, lw=0.8, ls=":")
    panels[0].set_yticks(range(len(names)), [f"{name} *" if name in front else name for name in names])
    panels[0].tick_params(axis="y", labelcolor=INK, length=0)
    panels[0].set_ylim(len(names) - 0.4, -0.6)
