"""Plots of what accuracy costs: cost against error with its Pareto front, events against control rate."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jobs.analysis.plots import COLOURS, INK, MUTED, tidy

MARKERS = {"default": "*", "most exact": "D", "precision": "s", "time bins": "s", "newest events": "s"}
SPEEDS = (10, 20, 50, 100, 200, 500, 1_000, 2_000, 5_000, 10_000, 20_000)
LETTER, LINE = 0.017, 0.035  # size of small print, as shares of a panel
MIN_ERROR = 1e-3  # that is drawn on a logarithmic axis


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
    intervals: Sequence[tuple[float, float]] | None
    front: Sequence[int]


class CostedSetting(NamedTuple):
    """A setting of the simulator with its cost [us] and its event error."""

    knob: str
    setting: str
    cost_us: float
    error: float


def pareto(points: Sequence[tuple[float, float]]) -> list[int]:
    """Places of the points that no other beats in cost and error both, by rising cost."""
    order = sorted(range(len(points)), key=lambda place: points[place])
    front: list[int] = []
    for place in order:
        if not front or points[place][1] < points[front[-1]][1]:
            front.append(place)
    return front


def plot_costs(
    scene: str, settings: Sequence[CostedSetting], front: Sequence[int], tolerance: float
) -> Figure:
    """Draw the cost of settings against their event error, with the Pareto front as a line."""
    figure = Figure(figsize=(9.6, 5.6), layout="constrained")
    panel = figure.subplots()
    places = np.array([(setting.cost_us, max(setting.error, MIN_ERROR)) for setting in settings])
    panel.plot(*places[list(front)].T, color=MUTED, lw=1.2, ls="--", zorder=1, label="Pareto front")
    for knob in dict.fromkeys(setting.knob for setting in settings):
        own = [place for place, setting in enumerate(settings) if setting.knob == knob]
        marker, size, order = ("*", 260, 4) if knob == "default" else ("o", 34, 3)
        x, y = places[own].T
        panel.scatter(x, y, marker=marker, s=size, zorder=order, color=COLOURS[knob], label=knob)
        for place in own if knob != "default" else []:
            text = settings[place].setting.rpartition(" ")[2]
            panel.annotate(text, places[place], (5, 4), textcoords="offset points", fontsize=7, color=INK)
    panel.axhline(tolerance, color=MUTED, lw=0.8, ls=":", label="tolerance asked")
    panel.set(xscale="log", yscale="log", xlabel="Process time of an environment step [us]")
    panel.set_ylabel("Event error: share of events that differ")
    panel.set_title(f"Scene {scene}", loc="left", fontsize=10)
    tidy(panel)
    panel.legend(frameon=False, fontsize=8)
    return figure


def plot_choices(settings: Sequence[tuple[str, str, float]], panels: Sequence[Panel]) -> Figure:
    """Draw a panel each of values over the speed of settings (knob, setting, steps/s); fronts are named."""
    figure = Figure(figsize=(4.6 * len(panels), 5.4), layout="constrained")
    speed = np.array([steps_per_s for *_, steps_per_s in settings])
    ticks = [tick for tick in SPEEDS if 0.8 * speed.min() < tick < 1.25 * speed.max()]
    every = list(figure.subplots(1, len(panels)))
    for axes, panel in zip(every, panels, strict=True):
        _draw_choices(axes, panel, [knob for knob, *_ in settings], speed)
        axes.set(xscale="log", xlabel="Environment steps per second", ylabel=panel.label)
        axes.set_xticks(ticks, [f"{tick:,}" for tick in ticks])
        axes.set_xticks([], minor=True)
        if panel.intervals is None:  # errors, many of them small
            axes.set_yscale("symlog", linthresh=1.0)
            axes.yaxis.set_major_formatter("{x:g}")
            axes.set_ylim(-0.1, 1.6 * np.nanmax(panel.values))
        tidy(axes)
        named = [settings[row][1] or settings[row][0] for row in panel.front]
        _annotate(
            axes,
            [(name, speed[row], panel.values[row]) for name, row in zip(named, panel.front, strict=True)],
        )
    figure.legend(*every[0].get_legend_handles_labels(), loc="outside lower center", ncols=8, frameon=False)
    return figure


def _draw_choices(axes: Axes, panel: Panel, knobs: Sequence[str], speed: np.ndarray) -> None:
    """Draw the points of one panel with their intervals, and the front as a line."""
    values, front = np.array(panel.values), list(panel.front)
    axes.plot(speed[front], values[front], color=MUTED, lw=1.2, ls="--", zorder=1, label="Pareto front")
    if panel.intervals is not None:
        spread = np.abs(np.array(panel.intervals).T - values)
        axes.errorbar(speed, values, spread, fmt="none", ecolor=MUTED, elinewidth=0.7, alpha=0.5, zorder=2)
    for knob in dict.fromkeys(knobs):
        own = np.array(knobs) == knob
        size = 240 if knob == "default" else 34
        marker, colour = MARKERS.get(knob, "o"), COLOURS[knob]
        axes.scatter(speed[own], values[own], label=knob, marker=marker, color=colour, s=size, zorder=3)


def _annotate(axes: Axes, points: Sequence[tuple[str, float, float]]) -> None:
    """Write names beside points, towards the middle; of names that would cover each other, the first."""
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
        axes.annotate(
            name, (x, y), (-7 if left else 7, 0), textcoords="offset points",
            ha="right" if left else "left", va="center", fontsize=7,
        )  # fmt: skip


def plot_memory_modes(rates_hz: Sequence[float], events_hz: Mapping[str, Sequence[float]]) -> Figure:
    """Draw events per second of flight against the control rate, one line per memory mode."""
    figure = Figure(figsize=(7.2, 4.2), layout="constrained")
    panel = figure.subplots()
    for memory, values in events_hz.items():
        panel.plot(rates_hz, values, marker="o", color=COLOURS[memory], label=f"memory: {memory}")
    panel.set(xscale="log", xlabel="Control rate [Hz]", ylabel="Events per second of flight", ylim=(0, None))
    panel.set_xticks(rates_hz, [f"{rate:g}" for rate in rates_hz])
    panel.set_xticks([], minor=True)
    tidy(panel, "y")
    panel.legend(frameon=False)
    return figure
