"""Draw change of success against event error: a panel for each group, a line for each kind of error."""

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jobs.analysis.colours import INK, MUTED
from jobs.analysis.plots import panel_grid, tidy
from jobs.study.changes import Change
from jobs.study.computed import Study
from jobs.study.results import Condition
from jobs.study.spec import Section

# Colour and marker of each kind of error; the colour-blind safe palette of Okabe and Ito.
KINDS = {
    "lost": ("#0072b2", "o"), "displaced": ("#009e73", "s"), "flipped": ("#e69f00", "^"),
    "invented": ("#d55e00", "D"), "jittered": ("#cc79a7", "v"),
}  # fmt: skip
OTHER = ("#6b7280", ".")
DODGE = 0.09  # sideways shift between kinds at the same dose, in units of the square-root axis
TICKS = (0, 1, 5, 10, 20, 40)  # event error [%]


def dose_figure(study: Study, said: Section) -> Figure:
    """Draw a panel for each group: change of success [points] with interval, a line for each kind of error.

    Markers of conditions in a group's training distribution are hollow. Axes whose names end with `dashed`
    are the same conditions behind a filter, drawn as dashed lines without intervals.
    """
    errors = {one.condition: one.measured for one in study.doses}
    met = {(one.condition, group) for one in study.doses for group in one.met_by}
    ending = said.get("dashed", "")
    changes = [one for one in study.changes if one.condition in errors]
    dashed = [
        one._replace(condition=(one.condition[0].removesuffix(ending), one.condition[1]))
        for one in study.changes
        if ending and one.condition[0].endswith(ending)
    ]
    groups = list(dict.fromkeys(change.group for change in changes))
    kinds = list(dict.fromkeys(kind for kind, _ in errors))
    figure, panels = panel_grid(len(groups), 4, (3.1, 2.7), (0.4, 0.9), sharex=True, sharey=True)
    for panel, group in zip(panels, groups, strict=True):
        for place, kind in enumerate(kinds):
            aside = DODGE * (place - (len(kinds) - 1) / 2)
            _draw_kind(panel, _own(changes, group, kind), errors, aside, met)
            _draw_kind(panel, _own(dashed, group, kind), errors, aside)
        panel.axhline(0, color=MUTED, lw=0.8, zorder=1)
        count = max(len(one.success) for one in changes if one.group == group)
        plural = "s" if count > 1 else ""
        panel.set_title(f"{group}, {count} training{plural}", loc="left", fontsize=9, color=INK)
        ticks = [tick for tick in TICKS if tick <= 110 * max(errors.values())]
        panel.set_xticks([tick**0.5 for tick in ticks], [str(tick) for tick in ticks])
        panel.tick_params(labelsize=8, labelbottom=True)
        tidy(panel)
    keys = [Line2D([], [], color=_look(kind)[0], marker=_look(kind)[1], label=kind) for kind in kinds]
    if met:
        keys.append(Line2D([], [], color=MUTED, marker="o", mfc="white", ls="", label="met in training"))
    if dashed:
        keys.append(
            Line2D([], [], color=MUTED, ls="--", marker="o", ms=3.5, mfc="white", label="behind the filter")
        )
    figure.legend(handles=keys, loc="outside upper center", ncols=len(keys), frameon=False, fontsize=9)
    figure.supxlabel("Measured event error [%], square-root scale", fontsize=9)
    figure.supylabel("Change of success [points]", fontsize=9)
    return figure


def _look(kind: str) -> tuple[str, str]:
    return KINDS.get(kind, OTHER)


def _own(changes: Sequence[Change], group: str, kind: str) -> list[Change]:
    return [one for one in changes if (one.group, one.condition[0]) == (group, kind)]


def _draw_kind(
    panel: Axes,
    changes: Sequence[Change],
    errors: Mapping[Condition, float],
    aside: float,
    met: Collection[tuple[Condition, str]] | None = None,
) -> None:
    """Draw one kind of error: a line from the origin, intervals, and a marker for each dose.

    Markers of conditions in `met` are hollow. None: all are hollow; the line is dashed, without intervals.
    """
    if not changes:
        return
    ordered = sorted(changes, key=lambda one: errors[one.condition])
    colour, marker = _look(ordered[0].condition[0])
    x = np.sqrt([100 * errors[one.condition] for one in ordered]) + aside
    y = [100 * one.difference.value for one in ordered]
    if met is None:
        panel.plot([0.0, *x], [0.0, *y], "--", color=colour, lw=1.1, zorder=3)
        panel.plot(x, y, marker, color=colour, ms=3.5, mfc="white", zorder=5)
        return
    panel.plot([0.0, *x], [0.0, *y], color=colour, lw=1.6, zorder=3)
    for place, value, one in zip(x, y, ordered, strict=True):
        ends = [100 * end for end in one.difference.interval or ()]
        panel.plot([place] * len(ends), ends, color=colour, lw=1.0, alpha=0.55, zorder=2)
        hollow = (one.condition, one.group) in met
        panel.plot(place, value, marker, color=colour, ms=5, mfc="white" if hollow else colour, zorder=4)
