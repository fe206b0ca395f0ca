"""Plots of a sweep: every axis as lines or bars, and where along the corridor episodes ended in contact."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jobs.analysis.plots import INK, MUTED, panel_grid, style_of, tidy
from jobs.analysis.statistics import Interval
from jobs.config.conditions import axis_numbers, moving_settings
from jobs.evaluation.group_stats import GroupResult
from jobs.rollout.agents import BASELINES

SCALES = {
    "env.control_hz": ("Control rate [Hz]", "log"),
    "env.speed_mps": ("Speed [m/s]", "linear"),
    "env.action_delay_ms": ("Delay of actions [ms]", "linear"),
    "env.scene": ("Scene", "linear"),
    "camera.contrast_threshold": ("Contrast threshold [log intensity]", "log"),
    "camera.memory": ("Memory of the pixels", "linear"),
    "faults.sparsity": ("Dead pixels [fraction]", "linear"),
    "faults.background_activity": ("Background activity [fraction of true events]", "linear"),
    "faults.background_activity_hz": ("Background activity [Hz per pixel]", "linear"),
    "faults.shot_noise_hz": ("Shot noise in black [Hz per pixel]", "linear"),
    "renderer": ("Renderer", "linear"),
}
MAX_BANDS = 4  # of groups in one panel; more would cover each other, and become bars on points set apart
DODGE = 0.012  # between such points, as a share of the axis
MAX_ACROSS = 2  # panels of the collision map side by side
Quantity = Callable[[GroupResult], tuple[float, Interval]]


def axis_figure(
    axis: str, points: Mapping[str, Mapping[str, object]], results: Sequence[GroupResult]
) -> Figure:
    """Success and distance of all groups along one axis: lines over numbers, bars over words.

    Bars also where several settings change together: no single number says what a point is.

    Args:
        axis: Its name.
        points: Value as text -> settings that it changes; the first one names it.
        results: Of this axis.
    """
    first = next(iter(next(iter(points.values()))))
    label, scale = SCALES.get(first, (first, "linear"))
    moving, words = moving_settings(points), axis_numbers(points) is None
    groups = list(dict.fromkeys(result.group for result in results))
    figure = Figure(figsize=(11.0, 4.6), layout="constrained")
    panels = figure.subplots(1, 2)
    ticks = [_tick(point, moving) for point in points.values()] if words else list(points)
    for panel, quantity in zip(panels, (_success_percent, _distance_m), strict=True):
        if words:
            _draw_bars(panel, list(points), groups, results, quantity)
            panel.set_xticks(range(len(points)), ticks, fontsize=8 if len(moving) < 2 else 7)
        else:
            _draw_lines(panel, groups, results, quantity, scale)
        panel.set_xlabel(label if len(moving) < 2 else f"{label}, and what changes with it")
        tidy(panel, "y")
        panel.set_axisbelow(True)
        panel.spines[["top", "right"]].set_visible(False)
    panels[0].set(ylim=(0, 103), ylabel="Episodes that reached the goal [%]")
    panels[1].set(ylim=(0, 103), ylabel="Mean distance without collision [m]")
    handles, names = panels[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=min(len(names), 5), frameon=False)
    figure.supxlabel(_footnote(axis, points, moving, results), x=0.995, ha="right", fontsize=7, color=MUTED)
    return figure


def _draw_lines(
    panel: Axes, groups: Sequence[str], results: Sequence[GroupResult], quantity: Quantity, scale: str
) -> None:
    """A line for each group with its intervals: a band, or bars where there are many groups."""
    seen = [group for group in groups if group not in BASELINES]
    crowded = len(seen) > MAX_BANDS
    panel.set_xscale(scale)
    ticks = sorted({float(result.condition[1]) for result in results})
    for group in groups:
        own = [result for result in results if result.group == group]
        own.sort(key=lambda result: float(result.condition[1]))
        colour, marker = style_of(group)
        x = np.array([float(result.condition[1]) for result in own])
        if crowded and group in seen:
            x = _set_apart(x, ticks, scale, seen.index(group) - (len(seen) - 1) / 2)
        y, low, high = np.array([(value, *interval) for value, interval in map(quantity, own)]).T
        dashes = "--" if group in BASELINES else "-"
        panel.plot(
            x, y, color=colour, marker=marker, ms=6, lw=1.8, ls=dashes, mec="white", mew=0.6, label=group
        )
        if not crowded:
            panel.fill_between(x, low, high, color=colour, alpha=0.10, lw=0)
        elif group in seen:
            panel.vlines(x, low, high, color=colour, alpha=0.5, lw=1.2, zorder=1)
    panel.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    panel.set_xticks([], minor=True)
    panel.margins(x=0.05)


def _set_apart(x: np.ndarray, ticks: Sequence[float], scale: str, places: float) -> np.ndarray:
    """Points of an axis moved to the side by so many places of `DODGE`."""
    if scale == "log":
        return x * (ticks[-1] / ticks[0]) ** (DODGE * places)
    return x + (ticks[-1] - ticks[0]) * DODGE * places


def _draw_bars(
    panel: Axes,
    values: Sequence[str],
    groups: Sequence[str],
    results: Sequence[GroupResult],
    quantity: Quantity,
) -> None:
    """Bars of all groups side by side at each value, with their intervals."""
    width = 0.84 / len(groups)
    for place, group in enumerate(groups):
        own = [result for result in results if result.group == group]
        offset = (place - (len(groups) - 1) / 2) * width
        x = [values.index(result.condition[1]) + offset for result in own]
        y, low, high = np.array([(value, *interval) for value, interval in map(quantity, own)]).T
        spread = np.abs(np.array([y - low, high - y]))
        caps = {"lw": 0.9, "capsize": min(2.5, 14 * width)}
        panel.bar(
            x, y, 0.94 * width, color=style_of(group)[0], yerr=spread, label=group, ecolor=INK, error_kw=caps
        )


def _tick(point: Mapping[str, object], moving: Sequence[str]) -> str:
    """What a point is; where several settings change, each on a line of its own, numbers with their names."""
    if len(moving) < 2:
        return str(next(iter(point.values()))).replace("_", "\n")
    return "\n".join(_setting_text(key.rpartition(".")[2], point[key]) for key in moving)


def _setting_text(name: str, value: object) -> str:
    """A number behind its name; a word, which says itself what it is, alone and in short lines."""
    return f"{name} {value:g}" if isinstance(value, int | float) else str(value).replace("_", "\n")


def _footnote(
    axis: str,
    points: Mapping[str, Mapping[str, object]],
    moving: Sequence[str],
    results: Sequence[GroupResult],
) -> str:
    """What stays the same along the axis, and how much was evaluated."""
    point = next(iter(points.values()))
    held = [f"{key.rpartition('.')[2]} {value}" for key, value in point.items() if key not in moving]
    episodes = {result.episodes for result in results}
    trainings = {len(result.trainings) for result in results}
    counts = f"{_range(episodes)} episodes of {_range(trainings)} trainings for each group"
    return "; ".join([axis, *held, counts, "95 % intervals"])


def _range(counts: set[int]) -> str:
    return " to ".join(str(count) for count in sorted({min(counts), max(counts)}))


def _success_percent(result: GroupResult) -> tuple[float, Interval]:
    low, high = result.success.interval or (0.0, 1.0)
    return 100 * result.success.value, (100 * low, 100 * high)


def _distance_m(result: GroupResult) -> tuple[float, Interval]:
    distance = result.distance_m
    return distance.value, distance.interval or (distance.value, distance.value)


def collision_figure(
    ends: Mapping[str, tuple[np.ndarray, np.ndarray]], length_m: float, half_width_m: float
) -> Figure:
    """Where episodes of each group ended in contact, seen from above.

    Args:
        ends: Group -> EPISODE without any change, and EPISODE under all changes in the same scene.
        length_m: Where the goal line is [m].
        half_width_m: Where the walls are [m].
    """
    figure, panels = panel_grid(len(ends), MAX_ACROSS, (6.6, 2.3), (0.0, 0.7), sharex=True, sharey=True)
    for panel, (group, (unchanged, changed)) in zip(panels, ends.items(), strict=True):
        _draw_contacts(panel, group, unchanged, changed)
        panel.hlines([-half_width_m, half_width_m], 0, length_m, color=INK, lw=1.5)
        panel.vlines(length_m, -half_width_m, half_width_m, color=MUTED, lw=1.2, ls=":")
        panel.set(xlim=(-2, length_m + 2), ylim=(half_width_m + 1.5, -half_width_m - 1.5))
    figure.supxlabel(
        "y, along the corridor [m]; large dots: nothing changed, small dots: with changes in the same scene",
        fontsize=8,
    )
    figure.supylabel("x, to the right [m]", fontsize=8)
    return figure


def _draw_contacts(panel: Axes, group: str, unchanged: np.ndarray, changed: np.ndarray) -> None:
    """The contacts of one group as dots, large where nothing was changed."""
    colour, usual, others = style_of(group)[0], *(rows[rows["collision"]] for rows in (unchanged, changed))
    panel.scatter(
        usual["distance_m"],
        usual["x_m"],
        s=26,
        alpha=0.95,
        color=colour,
        edgecolors="white",
        lw=0.5,
        zorder=3,
    )
    panel.scatter(others["distance_m"], others["x_m"], s=7, alpha=0.25, color=colour, lw=0, zorder=2)
    counts = f"unchanged {len(usual)} of {len(unchanged)}, changed {len(others)} of {len(changed)}"
    panel.set_title(f"{group}: contacts {counts}", loc="left", fontsize=9, color=INK)
    panel.spines[:].set_visible(False)
    panel.tick_params(labelsize=8, labelbottom=True, labelleft=True)
