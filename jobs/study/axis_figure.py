"""Success and distance of all groups along one axis of a study."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from jobs.analysis.colours import MUTED
from jobs.analysis.plots import style_of, tidy
from jobs.config.conditions import axis_numbers, moving_settings
from jobs.rollout.tasks import text_of
from jobs.study.results import Value
from jobs.study.summaries import Summary
from jobs.study.words import TITLES

WIDTH = 0.7  # of the markers of all groups at one value; values are 1 apart


def axis_figure(axis: str, points: Mapping[Value, Mapping[str, object]], found: Sequence[Summary]) -> Figure:
    """Draw a marker with interval for each group and value; lines join them if the axis is numeric.

    Args:
        axis: Name of the axis.
        points: Value -> changed settings; the first setting labels the axis.
        found: Summaries along this axis.
    """
    by_text = {text_of(value): changes for value, changes in points.items()}
    moving, numbers = moving_settings(by_text), axis_numbers(by_text) is not None
    places, groups = list(points), list(dict.fromkeys(one.group for one in found))
    figure = Figure(figsize=(11.0, 4.6), layout="constrained")
    panels = figure.subplots(1, 2)
    for rank, group in enumerate(groups):
        own = [one for one in found if one.group == group]
        aside = WIDTH * ((rank + 0.5) / len(groups) - 0.5)
        x = np.array([places.index(one.condition[1]) for one in own]) + aside
        colour, marker = style_of(group)
        success = np.array([(one.success.value, *(one.success.interval or (0.0, 1.0))) for one in own])
        metres = [one.distance_m for one in own]
        distance = np.array([(one.value, *(one.interval or (one.value, one.value))) for one in metres])
        for panel, rows in zip(panels, (100 * success, distance), strict=True):
            value, low, high = rows.T
            panel.vlines(x, low, high, color=colour, alpha=0.5, lw=1.2)
            panel.plot(x, value, color=colour, marker=marker, ms=6, lw=1.4 if numbers else 0, label=group)
    for panel in panels:
        panel.set_xticks(range(len(points)), [_tick(point, moving) for point in points.values()], fontsize=8)
        title = TITLES.get(axis, next(iter(next(iter(points.values())))))
        panel.set_xlabel(title if len(moving) < 2 else f"{title}, and what changes with it")
        tidy(panel, "y")
    panels[0].set(ylim=(-2, 103), ylabel="Episodes that reached the goal [%]")
    panels[1].set(ylim=(-2, 103), ylabel="Mean distance without collision [m]")
    handles, names = panels[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=min(len(names), 5), frameon=False)
    figure.supxlabel(_footnote(axis, points, moving), x=0.995, ha="right", fontsize=7, color=MUTED)
    return figure


def _tick(point: Mapping[str, object], moving: Sequence[str]) -> str:
    """Return the label of a point; if several settings vary, one line for each with its name."""
    if len(moving) < 2:
        return text_of(next(iter(point.values()))).replace("_", "\n")
    return "\n".join(f"{key.rpartition('.')[2]} {text_of(point[key])}" for key in moving)


def _footnote(axis: str, points: Mapping[Value, Mapping[str, object]], moving: Sequence[str]) -> str:
    """Return the footnote: the axis, the settings that are constant along it, and the kind of interval."""
    point = next(iter(points.values()))
    held = [f"{key.rpartition('.')[2]} {value}" for key, value in point.items() if key not in moving]
    return "; ".join([axis, *held, "95 % intervals over trainings"])
