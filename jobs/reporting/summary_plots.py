"""Pictures of a whole sweep: its map, the paper's claims, every axis, and how far episodes get."""

import textwrap
from collections.abc import Mapping, Sequence
from typing import NamedTuple, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jobs.analysis.plots import AMBER, BLUE, GREEN, GREYS, INK, MUTED, RED, panel_grid, style_of, tidy
from jobs.analysis.statistics import Difference
from jobs.evaluation.group_stats import Condition, GroupResult
from jobs.reporting.breaks import Change
from jobs.reporting.paper_claims import GAIN, Claim, Finding
from jobs.rollout.agents import BASELINES

UNITS = {"success": (100, "points of success"), "distance_m": (1, "m of distance")}
VERDICT_COLOURS = {"holds": GREEN, "reversed": RED, "equivalent": BLUE, "does not hold": AMBER}
STACKED = 0.16  # rows between the dots of two trainings in a map


def change_map(changes: Sequence[Change], groups: Sequence[str], labels: Mapping[Condition, str]) -> Figure:
    """Draw a map of conditions x groups: success [%], coloured by its change, a dot for each training.

    Args:
        changes: What is drawn.
        groups: Columns; those without any change are left out.
        labels: Condition -> what stands beside its row, in the order of the rows.
    """
    found = {(change.condition, change.group): change for change in changes}
    columns = [group for group in groups if any(change.group == group for change in changes)]
    rows = [at for at in labels if any(change.condition == at for change in changes)]
    figure = Figure(figsize=(3.2 + 1.15 * len(columns), 1.8 + 0.3 * len(rows)), layout="constrained")
    panel = figure.subplots()
    table = np.full((len(rows), len(columns)), np.nan)
    for change in changes:
        place = rows.index(change.condition), columns.index(change.group)
        table[place] = 100 * change.difference.value
    picture = panel.imshow(table, cmap="RdBu", vmin=-100, vmax=100, aspect="auto")
    for row, column in np.argwhere(np.isfinite(table)):
        change = found[rows[row], columns[column]]
        colour = "white" if abs(table[row, column]) > 60 else INK
        weight = "bold" if change.certain else "normal"
        text = f"{100 * change.success.mean():.0f}"
        panel.text(
            column - 0.22, row, text, ha="center", va="center", color=colour, fontsize=9, weight=weight
        )
        places, count = column + 0.05 + 0.4 * change.success, len(change.success)
        panel.plot(places, row + STACKED * (np.arange(count) - (count - 1) / 2), "o", color=colour, ms=2)
    alone = {change.group for change in changes if len(change.success) == 1}
    names = [f"{group} (1 training)" if group in alone else group for group in columns]
    panel.set_xticks(range(len(columns)), names, rotation=35, ha="left", fontsize=8)
    panel.xaxis.tick_top()
    panel.set_yticks(range(len(rows)), [labels[at] for at in rows], fontsize=8)
    panel.spines[:].set_visible(False)
    panel.tick_params(length=0)
    bar = figure.colorbar(picture, ax=panel, shrink=0.5, pad=0.01)
    bar.set_label("Change against the baseline [points]", fontsize=8)
    bold = (
        "bold where the change is certain" if any(one.certain for one in changes) else "no change is certain"
    )
    note = (
        f"Numbers: success [%]; {bold} for further trainings. Dots: each training, one below the other, "
        "from 0 (middle of the cell) to 100 % (right). Empty: the change cannot affect that policy, "
        "or is another row."
    )
    figure.supxlabel(note, fontsize=8, color=MUTED)
    return figure


def claims_plot(findings: Mapping[Claim, Finding]) -> Figure:
    """Draw the difference of each tested claim with its interval, by its measure, coloured by the verdict."""
    tested = {claim: one for claim, one in findings.items() if one.overall and one.overall.interval}
    measures = [name for name in UNITS if any(claim.measure == name for claim in tested)]
    sizes = [sum(claim.measure == name for claim in tested) for name in measures]
    figure = Figure(figsize=(9.6, 1.2 + 0.42 * sum(sizes)), layout="constrained")
    panels = figure.subplots(len(measures), 1, squeeze=False, height_ratios=sizes)[:, 0]
    for panel, name in zip(panels, measures, strict=True):
        scale, unit = UNITS[name]
        own = [(claim, one) for claim, one in tested.items() if claim.measure == name]
        panel.axvspan(-scale * GAIN[name], scale * GAIN[name], color=MUTED, alpha=0.12, lw=0)
        panel.axvline(0, color=MUTED, lw=0.8)
        for row, (_, one) in enumerate(own):
            colour, overall = VERDICT_COLOURS.get(one.verdict, MUTED), cast(Difference, one.overall)
            panel.plot([scale * end for end in overall.interval or ()], [row, row], color=colour, lw=1.6)
            panel.plot(scale * overall.value, row, "o", color=colour, ms=5)
            beside = {"transform": panel.get_yaxis_transform(), "va": "center", "fontsize": 8}
            panel.text(1.01, row, one.verdict, color=colour, **beside)
        panel.set_yticks(range(len(own)), [_claim_label(claim) for claim, _ in own])
        panel.tick_params(axis="y", labelsize=7.5)
        panel.set_ylim(len(own) - 0.5, -0.5)
        panel.set_xlabel(f"Difference [{unit}]; above 0: as claimed; grey: too small to matter", fontsize=8)
        tidy(panel, "x")
    return figure


def _claim_label(claim: Claim) -> str:
    """Two groups, and below them what the paper says of the first."""
    return "\n".join((f"{claim.ours} against {claim.theirs}:", *textwrap.wrap(claim.text, 52)))


class Survival(NamedTuple):
    """Episodes of a group, an EPISODE array for each training.

    Attributes:
        usual: With nothing changed.
        worst: The condition in which it succeeds least, in words.
        there: Under that condition.
    """

    usual: Sequence[np.ndarray]
    worst: str
    there: Sequence[np.ndarray]


def still_going(episodes: np.ndarray, length_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Share of episodes that have not ended before a distance, as the corners of a step function.

    Args:
        episodes: EPISODE (n,), at least one.
        length_m: Where the goal line is; episodes that reach it go on to there [m].

    Returns:
        Distances from 0 to the goal line, rising [m], and the share that gets beyond each [-].
    """
    ends = np.sort(np.minimum(episodes["distance_m"][~episodes["success"]], length_m))
    beyond = 1.0 - np.arange(1, ends.size + 1) / episodes.size
    last = beyond[-1] if ends.size else 1.0
    return np.concatenate([[0.0], ends, [length_m]]), np.concatenate([[1.0], beyond, [last]])


def survival_plot(groups: Mapping[str, Survival], length_m: float) -> Figure:
    """Draw the share of episodes still going over distance, a panel for each group.

    Args:
        groups: Group -> its episodes.
        length_m: Where the goal line is [m].
    """
    figure, panels = panel_grid(max(len(groups), 1), 4, (2.9, 2.2), (0.4, 0.5), sharex=True, sharey=True)
    for panel, (group, own) in zip(panels, groups.items(), strict=bool(groups)):
        for trainings, colour in ((own.usual, BLUE), (own.there, RED)):
            for one in trainings if len(trainings) > 1 else ():
                x, share = still_going(one, length_m)
                panel.step(x, 100 * share, where="post", color=colour, lw=0.7, alpha=0.45)
            x, share = still_going(np.concatenate(trainings), length_m)
            panel.step(x, 100 * share, where="post", color=colour, lw=2.0)
        panel.set_title(group, loc="left", fontsize=9, color=INK, pad=15)
        panel.text(0.0, 1.04, own.worst, transform=panel.transAxes, fontsize=7, color=RED)
        panel.set(xlim=(0, length_m), ylim=(0, 103))
        panel.tick_params(labelsize=8, labelbottom=True)
        tidy(panel)
    figure.supxlabel("Distance travelled [m]", fontsize=9)
    figure.supylabel("Episodes still going [%]", fontsize=9)
    return figure


def axes_map(axes: Mapping[str, Sequence[GroupResult]], groups: Sequence[str]) -> Figure:
    """Draw success along axes of numbers: a row for each group, in front of all others in grey.

    Args:
        axes: Name of an axis -> its results.
        groups: Rows, as far as they have results; baselines, which see nothing, have none.
    """
    there = {one.group for own in axes.values() for one in own}
    rows = [group for group in groups if group in there and group not in BASELINES] or sorted(there)
    size = 1.75 * len(axes) + 1.5, 1.15 * len(rows) + 0.9
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(len(rows), len(axes), squeeze=False, sharey=True, sharex="col")
    for column, (axis, results) in enumerate(axes.items()):
        values = list(dict.fromkeys(one.condition[1] for one in results))
        for row, group in enumerate(rows):
            panel = panels[row, column]
            for other in rows:
                _draw_group(panel, [one for one in results if one.group == other], values, other == group)
            panel.set_xticks(range(len(values)), values)
            panel.set(ylim=(-4, 104))
            panel.tick_params(labelsize=6.5)
            tidy(panel, "y")
        panels[0, column].set_title(axis, fontsize=7.5, color=INK)
    for row, group in enumerate(rows):
        panels[row, 0].set_ylabel(group.replace("_", "\n"), fontsize=7.5, color=style_of(group)[0])
    figure.supylabel("Success [%]", fontsize=8)
    return figure


def _draw_group(panel: Axes, results: Sequence[GroupResult], values: Sequence[str], own: bool) -> None:
    """A group's success over the places of the values: in its colour with its interval, or in grey."""
    x = [values.index(one.condition[1]) for one in results]
    y = [100 * one.success.value for one in results]
    if not own:
        panel.plot(x, y, color=GREYS[0], lw=0.6, alpha=0.6, zorder=1)
        return
    colour, marker = style_of(results[0].group) if results else (INK, "o")
    ends = np.array([100 * np.array(one.success.interval or (0.0, 1.0)) for one in results]).reshape(-1, 2)
    panel.fill_between(x, ends[:, 0], ends[:, 1], color=colour, alpha=0.15, lw=0, zorder=2)
    panel.plot(x, y, color=colour, marker=marker, ms=3.5, lw=1.6, zorder=3)
