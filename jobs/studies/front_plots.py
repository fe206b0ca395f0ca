"""Figures of what accuracy costs: cost against error with its Pareto front, events against control rate."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jobs.analysis.plots import GRID, INK, MUTED

COLOURS = {
    "default": "#111827",
    "tolerance": "#2563eb",
    "renders": "#059669",
    "anti-aliasing": "#d97706",
    "pyrender": "#7c3aed",
    "encoding": "#db2777",
    "culling": "#0891b2",
    "memory": "#dc2626",
    "precision": "#65a30d",
    "time bins": "#9333ea",
    "newest events": "#b45309",
    "together": "#64748b",
    "most exact": "#111827",
}
SHAPES = {"default": "*", "most exact": "D", "precision": "s", "time bins": "s", "newest events": "s"}
SPEEDS = (10, 20, 50, 100, 200, 500, 1_000, 2_000, 5_000, 10_000, 20_000)
LETTER, LINE = 0.017, 0.035  # size of small print, as shares of a panel
FLOOR = 1e-3  # of an error that is drawn on a logarithmic axis


class Panel(NamedTuple):
    """What one panel shows of n settings.

    Attributes:
        label: Of the axis.
        values: n numbers, NaN where there is none.
        intervals: Around them; None: there are none.
        front: Places on the Pareto front.
    """

    label: str
    values: Sequence[float]
    intervals: Sequence[tuple[float, ...]] | None
    front: Sequence[int]


def pareto(points: Sequence[tuple[float, float]]) -> list[int]:
    """Places of the points that no other beats in cost and error both, by rising cost."""
    order = sorted(range(len(points)), key=lambda place: points[place])
    front: list[int] = []
    for place in order:
        if not front or points[place][1] < points[front[-1]][1]:
            front.append(place)
    return front


def trade_figure(
    scene: str, rows: Sequence[tuple[str, str, float, float]], front: Sequence[int], tolerance: float
) -> Figure:
    """Cost [us] against event error of rows (knob, setting, cost, error); the front is a line."""
    figure = Figure(figsize=(9.6, 5.6), layout="constrained")
    panel = figure.subplots()
    places = np.array([(cost, max(error, FLOOR)) for *_, cost, error in rows])
    panel.plot(*places[list(front)].T, color=MUTED, lw=1.2, ls="--", zorder=1, label="Pareto front")
    for knob in dict.fromkeys(row[0] for row in rows):
        own = [place for place, row in enumerate(rows) if row[0] == knob]
        star = knob == "default"
        marker, size, above = ("*", 260, 4) if star else ("o", 34, 3)
        look = {"marker": marker, "s": size, "zorder": above, "color": COLOURS.get(knob, INK), "label": knob}
        panel.scatter(places[own, 0], places[own, 1], **look)  # type: ignore[arg-type]
        for place in [] if star else own:
            text = rows[place][1].rpartition(" ")[2]
            panel.annotate(text, places[place], (5, 4), textcoords="offset points", fontsize=7, color=INK)
    panel.axhline(tolerance, color=MUTED, lw=0.8, ls=":", label="tolerance asked")
    panel.set(xscale="log", yscale="log", xlabel="Process time of an environment step [us]")
    panel.set_ylabel("Event error: share of events that differ")
    panel.set_title(f"Scene {scene}", loc="left", fontsize=10)
    panel.grid(color=GRID)
    panel.spines[["top", "right"]].set_visible(False)
    panel.legend(frameon=False, fontsize=8)
    return figure


def choice_figure(settings: Sequence[tuple[str, str, float]], panels: Sequence[Panel]) -> Figure:
    """A panel each of values over the speed of settings (knob, setting, steps/s); the fronts are named."""
    figure = Figure(figsize=(4.6 * len(panels), 5.4), layout="constrained")
    speed = np.array([steps_per_s for *_, steps_per_s in settings])
    for place, (axes, panel) in enumerate(zip(figure.subplots(1, len(panels)), panels, strict=True)):
        values, front = np.array(panel.values), list(panel.front)
        axes.plot(speed[front], values[front], color=MUTED, lw=1.2, ls="--", zorder=1, label="Pareto front")
        if panel.intervals is not None:
            spread = np.abs(np.array(panel.intervals).T - values)
            axes.errorbar(
                speed, values, spread, fmt="none", ecolor=MUTED, elinewidth=0.7, alpha=0.5, zorder=2
            )
        for knob in dict.fromkeys(setting[0] for setting in settings):
            own = [row for row, setting in enumerate(settings) if setting[0] == knob]
            size = 240 if knob == "default" else 34
            look = {"marker": SHAPES.get(knob, "o"), "color": COLOURS.get(knob, INK), "s": size, "zorder": 3}
            axes.scatter(speed[own], values[own], label=knob, **look)
        axes.set(xscale="log", xlabel="Environment steps per second", ylabel=panel.label)
        ticks = [tick for tick in SPEEDS if 0.8 * speed.min() < tick < 1.25 * speed.max()]
        axes.set_xticks(ticks, [f"{tick:,}" for tick in ticks])
        axes.set_xticks([], minor=True)
        if panel.intervals is None:  # errors, many of them small
            axes.set_yscale("symlog", linthresh=1.0)
            axes.yaxis.set_major_formatter("{x:g}")
            axes.set_ylim(-0.1, 1.6 * np.nanmax(values))
        axes.grid(color=GRID)
        _name(axes, [(settings[row][1] or settings[row][0], speed[row], values[row]) for row in front])
        axes.spines[["top", "right"]].set_visible(False)
        if place == 0:
            figure.legend(
                *axes.get_legend_handles_labels(), loc="outside lower center", ncols=8, frameon=False
            )
    return figure


def _name(axes: Axes, points: Sequence[tuple[str, float, float]]) -> None:
    """Names beside points, towards the middle; of names that would cover each other, the first."""
    taken: list[tuple[float, float, float]] = []
    for name, x, y in points:
        at, above = axes.transAxes.inverted().transform(axes.transData.transform((x, y)))
        left = at > 0.5
        wide = LETTER * len(name)
        begin = at - wide if left else at
        if any(
            begin < end and start < begin + wide and abs(above - line) < LINE for start, end, line in taken
        ):
            continue
        taken.append((begin, begin + wide, above))
        look: dict[str, Any] = {"ha": "right" if left else "left", "va": "center", "fontsize": 7}
        axes.annotate(name, (x, y), (-7 if left else 7, 0), textcoords="offset points", **look)


def memory_figure(rates_hz: Sequence[float], events_hz: Mapping[str, Sequence[float]]) -> Figure:
    """Events per second of flight against the control rate, one line per memory mode."""
    figure = Figure(figsize=(7.2, 4.2), layout="constrained")
    panel = figure.subplots()
    for memory, colour in zip(events_hz, ("#2563eb", "#d97706", "#dc2626"), strict=False):
        panel.plot(rates_hz, events_hz[memory], marker="o", color=colour, label=f"memory: {memory}")
    panel.set(xscale="log", xlabel="Control rate [Hz]", ylabel="Events per second of flight", ylim=(0, None))
    panel.set_xticks(rates_hz, [f"{rate:g}" for rate in rates_hz])
    panel.set_xticks([], minor=True)
    panel.grid(axis="y", color=GRID)
    panel.spines[["top", "right"]].set_visible(False)
    panel.legend(frameon=False)
    return figure
