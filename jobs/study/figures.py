"""Figures of a study's page, one function for each `kind` that its file can name."""

import textwrap
from collections.abc import Callable, Sequence
from typing import cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from envs.scene import make_scene
from jobs.analysis.colours import AMBER, BLACK, BLUE, GREEN, GREYS, INK, MUTED, PINK, RED
from jobs.analysis.plots import panel_grid, style_of, tidy
from jobs.analysis.statistics import Difference
from jobs.config.conditions import NOMINAL, axis_numbers
from jobs.rollout.agents import BASELINES
from jobs.study.changes import Change, content
from jobs.study.computed import Study
from jobs.study.contrasts import Finding
from jobs.study.dose_figure import dose_figure
from jobs.study.results import Condition, Results, text_of
from jobs.study.spec import Section, tags_of
from jobs.study.spread import crossed_tables, factors
from jobs.study.summaries import Summary
from jobs.study.tables import scale_of
from jobs.study.words import TITLES, condition_text

COLOURS = {"above": GREEN, "below": RED, "within": BLUE, "no_gain": AMBER, "no_loss": INK}  # of verdicts


def change_map(study: Study, said: Section) -> Figure:
    """Draw success [%] by condition and group, coloured by its change; the first row is the baseline."""
    changes = study.changes
    columns = [group for group in study.results.groups if any(change.group == group for change in changes)]
    rows = [at for at in study.results.conditions if any(change.condition == at for change in changes)]
    first = [change.baseline for change in changes if change.baseline[0] == NOMINAL][:1]
    rows = [*first, *rows]
    figure = Figure(figsize=(2.6 + 0.85 * len(columns), 1.6 + 0.27 * len(rows)), layout="constrained")
    panel = figure.subplots()
    table = np.full((len(rows), len(columns)), np.nan)
    for change in changes:
        column = columns.index(change.group)
        if change.baseline in first:
            table[0, column] = 0.0
            _write_cell(panel, change.before, 0.0, 0, column, "normal")
        row, points = rows.index(change.condition), 100 * change.difference.value
        table[row, column] = points
        _write_cell(panel, change.success, points, row, column, "bold" if change.certain else "normal")
    picture = panel.imshow(table, cmap="RdBu", vmin=-100, vmax=100, aspect="auto")
    alone = {change.group for change in changes if len(change.success) == 1}
    names = [f"{group} (1 run)" if group in alone else group for group in columns]
    panel.set_xticks(range(len(columns)), names, rotation=35, ha="left", fontsize=9)
    panel.xaxis.tick_top()
    panel.set_yticks(range(len(rows)), [condition_text(at) for at in rows], fontsize=9)
    panel.axhline(0.5, color=INK, lw=1.2, visible=bool(first))
    panel.spines[:].set_visible(False)
    panel.tick_params(length=0)
    bar = figure.colorbar(picture, ax=panel, shrink=0.5, pad=0.01)
    bar.set_label("Change against the baseline [points]", fontsize=9)
    return figure


def _write_cell(panel: Axes, success: np.ndarray, points: float, row: int, column: int, weight: str) -> None:
    """Write the mean success [%] into a cell in a legible colour, unless it is already there."""
    text = f"{100 * success.mean():.0f}"
    written = {(one.get_position(), one.get_text()) for one in panel.texts}
    if ((column, row), text) not in written:
        colour = "white" if abs(points) > 60 else INK
        panel.text(column, row, text, ha="center", va="center", color=colour, fontsize=9, weight=weight)


def forest(study: Study, said: Section) -> Figure:
    """Draw each test of a family with its interval, coloured by the verdict; a panel for each unit."""
    family, tested = study.families[said["family"]][0], tested_of(study, said)
    units = list(dict.fromkeys(scale_of(one.contrast) for one in tested))
    sizes = [sum(scale_of(one.contrast) == unit for one in tested) for unit in units]
    figure = Figure(figsize=(9.6, 1.2 + 0.42 * sum(sizes)), layout="constrained")
    panels = figure.subplots(len(units), 1, squeeze=False, height_ratios=sizes)[:, 0]
    words = family.words
    colours = {word: COLOURS[name] for name, word in words.items()}
    colours[f"{words.get('no_gain')}, {words.get('no_loss')}"] = COLOURS["within"]
    for panel, unit in zip(panels, units, strict=True):
        scale, own = unit[0], [one for one in tested if scale_of(one.contrast) == unit]
        margin = scale * family.margin[own[0].contrast.measure if unit[2] == "m" else "success"]
        panel.axvspan(-margin, margin, color=MUTED, alpha=0.12, lw=0)
        panel.axvline(0, color=MUTED, lw=0.8)
        for row, one in enumerate(own):
            colour, difference = colours.get(one.verdict, MUTED), cast(Difference, one.difference)
            panel.plot([scale * end for end in difference.interval or ()], [row, row], color=colour, lw=1.6)
            panel.plot(scale * difference.value, row, "o", color=colour, ms=5)
            panel.text(1.01, row, one.verdict, color=colour, va="center", fontsize=8,
                       transform=panel.get_yaxis_transform())  # fmt: skip
        panel.set_yticks(range(len(own)), [_label(one) for one in own])
        panel.tick_params(axis="y", labelsize=7.5)
        panel.set_ylim(len(own) - 0.5, -0.5)
        panel.set_xlabel(f"Difference [{unit[2]}]; grey: too small to matter", fontsize=8)
        tidy(panel, "x")
    return figure


def tested_of(study: Study, said: Section) -> list[Finding]:
    """Return the findings with an interval of the figure's family; single trainings have no interval."""
    findings = study.families[said["family"]][1]
    return [one for one in findings if one.difference and one.difference.interval]


def _label(one: Finding) -> str:
    ours, theirs = one.contrast.ours.group, one.contrast.theirs
    against = f" against {theirs.group}" if theirs else ""
    return "\n".join((f"{ours}{against}:", *textwrap.wrap(one.contrast.name, 52)))


def still_going(episodes: np.ndarray, length_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the share of episodes still running at a distance, as the corners of a step function.

    Args:
        episodes: EPISODE (n,), at least one.
        length_m: Distance of the goal line; successful episodes last until there [m].

    Returns:
        Ascending distances from 0 to the goal line [m], and the share of episodes that get beyond each [-].
    """
    ends = np.sort(np.minimum(episodes["distance_m"][~episodes["success"]], length_m))
    beyond = 1.0 - np.arange(1, ends.size + 1) / episodes.size
    last = beyond[-1] if ends.size else 1.0
    return np.concatenate([[0.0], ends, [length_m]]), np.concatenate([[1.0], beyond, [last]])


def worst_conditions(results: Results, changes: Sequence[Change]) -> dict[str, Condition]:
    """Return group -> its condition with the lowest success, for groups evaluated in the nominal one."""
    found = {}
    for group in dict.fromkeys(change.group for change in changes):
        if (results.nominal, group) in results.cells:
            own = (change for change in changes if change.group == group)
            found[group] = min(own, key=lambda one: one.success.mean()).condition
    return found


def survival(study: Study, said: Section) -> Figure:
    """Draw the share of episodes still running over distance, in the nominal and in the worst condition."""
    results, worst = study.results, worst_conditions(study.results, study.changes)
    length_m = make_scene(results.facts["scene"], np.random.default_rng(0)).length_m
    figure, panels = panel_grid(max(len(worst), 1), 4, (2.9, 2.2), (0.4, 0.5), sharex=True, sharey=True)
    for panel, (group, at) in zip(panels, worst.items(), strict=bool(worst)):
        for place, colour in ((results.nominal, BLUE), (at, RED)):
            trainings = list(results.cells[place, group].values())
            for one in trainings if len(trainings) > 1 else ():
                x, share = still_going(one, length_m)
                panel.step(x, 100 * share, where="post", color=colour, lw=0.7, alpha=0.45)
            x, share = still_going(np.concatenate(trainings), length_m)
            panel.step(x, 100 * share, where="post", color=colour, lw=2.0)
        panel.set_title(group, loc="left", fontsize=9, color=INK, pad=15)
        panel.text(0.0, 1.04, condition_text(at), transform=panel.transAxes, fontsize=7, color=RED)
        panel.set(xlim=(0, length_m), ylim=(0, 103))
        panel.tick_params(labelsize=8, labelbottom=True)
        tidy(panel)
    figure.supxlabel("Distance travelled [m]", fontsize=9)
    figure.supylabel("Episodes still going [%]", fontsize=9)
    return figure


def numeric_axes(results: Results) -> list[str]:
    """Return the axes along which a single number changes."""
    return [
        axis
        for axis, points in results.axes.items()
        if axis != NOMINAL and len(points) > 1 and axis_numbers({str(at): own for at, own in points.items()})
    ]


def axes_map(study: Study, said: Section) -> Figure:
    """Draw success along the numeric axes: the groups in `said` with intervals, all others in grey."""
    axes = {axis: [one for one in study.summaries if one.condition[0] == axis]
            for axis in numeric_axes(study.results)}  # fmt: skip
    there = {one.group for own in axes.values() for one in own}
    groups = [group for group in study.results.groups if group in there and group not in BASELINES]
    front = [group for group in said.get("groups") or groups if group in there] or groups
    figure, panels = panel_grid(len(axes), 3, (3.3, 2.5), (0.4, 0.6), sharey=True)
    for panel, (axis, found) in zip(panels, axes.items(), strict=True):
        values = list(dict.fromkeys(one.condition[1] for one in found))
        for group in groups:
            own = [one for one in found if one.group == group]
            place = 0.12 * (front.index(group) - (len(front) - 1) / 2) if group in front else None
            _draw_group(panel, own, values, place)
        panel.set_xticks(range(len(values)), [text_of(value) for value in values])
        panel.set(ylim=(-4, 104), xlabel=TITLES.get(axis, axis))
        tidy(panel, "y")
    panels[0].set_ylabel("Success [%]")
    handles, names = panels[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=min(len(names), 5), frameon=False)
    return figure


def _draw_group(panel: Axes, found: Sequence[Summary], values: Sequence[object], place: float | None) -> None:
    """Draw a group's success over the index of each value: with intervals, shifted by `place`; None: grey."""
    x = np.array([values.index(one.condition[1]) for one in found], float)
    y = [100 * one.success.value for one in found]
    if place is None:
        panel.plot(x, y, color=GREYS[0], lw=0.6, alpha=0.6, zorder=1)
        return
    colour, marker = style_of(found[0].group) if found else (INK, "o")
    ends = np.array([100 * np.array(one.success.interval or (0.0, 1.0)) for one in found]).reshape(-1, 2)
    panel.vlines(x + place, ends[:, 0], ends[:, 1], color=colour, alpha=0.5, lw=1.2, zorder=2)
    name = found[0].group if found else ""
    panel.plot(x + place, y, color=colour, marker=marker, ms=5, lw=1.6, zorder=3, label=name)


def lines(study: Study, said: Section) -> Figure:
    """Draw success along axes: a panel per value of one tag, a line per axis and value of another tag."""
    results, tags = study.results, tags_of(study.said, study.results)
    panels_of = sorted({tags[group][said["panels"]] for group in results.trained})
    figure = Figure(figsize=(3.4 * len(panels_of), 3.4), layout="constrained")
    panels = figure.subplots(1, len(panels_of), sharey=True, squeeze=False)[0]
    for panel, value in zip(panels, panels_of, strict=True):
        groups = [group for group in results.trained if tags[group][said["panels"]] == value]
        first = said["axes"][0]
        shown = [(axis, group) for axis in said["axes"] for group in groups
                 if axis == first or not _same_episodes(results, first, axis, group)]  # fmt: skip
        for place, (axis, group) in enumerate(shown):
            points = {at[1]: results.values(at, group).mean(axis=1) for at in results.conditions
                      if at[0] == axis and (at, group) in results.cells}  # fmt: skip
            name = str(tags[group][said["lines"]])
            label = name if axis == said["axes"][0] else f"{name}, by {axis}"
            colour, marker = ((BLUE, "o"), (AMBER, "s"), (BLACK, "D"), (PINK, "^"))[place % 4]
            x = np.array([float(at) for at in sorted(points)]) * (0.96 + 0.04 * place)
            y = 100 * np.array([points[at] for at in sorted(points)])
            panel.plot(x, y.mean(axis=1), color=colour, lw=1.4, marker=marker, ms=6, label=label)
            panel.plot(x, y, marker, color=colour, ms=3.5, alpha=0.6)
        _label_rates(panel, results, said["axes"][0], value)
    panels[0].set(ylabel="Success [%]", ylim=(-3, 103))
    panels[-1].legend(frameon=False, fontsize=8)
    return figure


def _same_episodes(results: Results, one: str, other: str, group: str) -> bool:
    """Whether a group has the same episodes along two axes, at the values that both axes have."""
    shared = [value for value in results.axes[other] if value in results.axes[one]]
    return all(
        content(results.trainings((one, value), group)) == content(results.trainings((other, value), group))
        for value in shared
    )


def _label_rates(panel: Axes, results: Results, axis: str, trained_at: float) -> None:
    ticks = [float(value) for value in results.axes[axis]]
    panel.axvline(trained_at, color=MUTED, lw=0.8, ls=":")
    panel.set_xscale("log")
    panel.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    panel.xaxis.set_minor_locator(NullLocator())
    panel.set_xlabel(TITLES.get(axis, axis))
    panel.set_title(f"Trained at {trained_at:g}", loc="left", fontsize=10)
    tidy(panel)


def dots(study: Study, said: Section) -> Figure:
    """Draw both groups of a test under each condition, a small marker for each training."""
    results, (one, *_) = study.results, study.families[said["family"]][1]
    at, groups = one.contrast.ours.at, [one.contrast.theirs.group, one.contrast.ours.group]  # type: ignore[union-attr]
    names = ["mean of these", *map(condition_text, at)]
    figure = Figure(figsize=(6.4, 1.0 + 0.34 * len(names)), layout="constrained")
    panel = figure.subplots()
    for group, aside in zip(groups, (-0.15, 0.15), strict=True):
        rates = np.array([100 * results.values(place, group).mean(axis=1) for place in at])
        colour, marker = style_of(group)
        for row, each in enumerate((rates.mean(axis=0), *rates)):
            panel.plot(each, np.full(len(each), row + aside), marker, color=colour, ms=3.5, alpha=0.4, mew=0)
            (mean,) = panel.plot(each.mean(), row + aside, "|", color=colour, ms=11, mew=2)
            if not row:
                mean.set_label(f"{group}: mean of {len(each)} trainings")
    panel.axhline(0.5, color=MUTED, lw=0.8)
    panel.set_yticks(range(len(names)), names)
    panel.set(xlabel="Success [%]", xlim=(-3, 103), ylim=(len(names) - 0.4, -0.6))
    figure.legend(frameon=False, fontsize=9, ncols=2, loc="outside upper center")
    tidy(panel, "x")
    return figure


def spread(study: Study, said: Section) -> Figure:
    """Draw the mean success of every training as a map, and its spread by each factor per condition."""
    tables, names = crossed_tables(study.said, study.results), study.said["spread"]
    mean = 100 * np.mean(list(tables.values()), axis=0)
    figure = Figure(figsize=(9.6, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.4))
    _draw_numbers(left, mean, float(mean.min()), float(mean.max()))
    left.set_xticks(range(len(mean)))
    left.set_yticks(range(len(mean)))
    left.set(xlabel=names["columns"][0].upper() + names["columns"][1:], ylabel=names["rows"].capitalize())
    left.set_title("Success [%], mean of the conditions", loc="left", fontsize=10)
    overall, each = factors(tables)
    rows = {"mean of these": overall, **{condition_text(at): one for at, one in each.items()}}
    shown = {names["rows"]: (BLUE, "o"), names["columns"]: (AMBER, "s"), "neither": (BLACK, "D")}
    for place, (label, (colour, marker)) in enumerate(shown.items()):
        values = [one.spread[place] for one in rows.values()]
        right.plot(values, np.arange(len(rows)) + 0.18 * (place - 1), marker, color=colour, ms=6, label=label)
    right.set_yticks(range(len(rows)), list(rows))
    right.set_ylim(len(rows) - 0.5, -0.5)
    right.set_xlim(left=-0.5)
    right.set_title("Standard deviation of success [points] by", loc="left", fontsize=10)
    right.legend(frameon=False, fontsize=8)
    tidy(right)
    return figure


def _draw_numbers(panel: Axes, values: np.ndarray, low: float = 0.0, high: float = 100.0) -> None:
    """Draw a map of numbers, coloured from `low` to `high`."""
    panel.imshow(values, cmap="cividis", vmin=low, vmax=high, aspect="auto")
    for row, column in np.ndindex(values.shape):
        colour = "black" if values[row, column] > low + 0.55 * (high - low) else "white"
        panel.text(
            column, row, f"{values[row, column]:.0f}", ha="center", va="center", color=colour, fontsize=9
        )


def variants(study: Study, said: Section) -> Figure:
    """Draw success by variant and condition as a map, and a family's tests with a dot for each pair."""
    results, (_, findings) = study.results, study.families[said["family"]]
    groups, found = results.trained, {one.contrast.ours.group: one for one in findings}
    values = np.array(
        [[100 * results.values(at, group).mean() for at in results.conditions] for group in groups]
    )
    figure = Figure(figsize=(4.6 + 0.72 * values.shape[1], 1.6 + 0.42 * len(groups)), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(1.6, 1))
    _draw_numbers(left, values)
    left.set_xticks(range(values.shape[1]), map(condition_text, results.conditions), rotation=35, ha="right")
    left.set_yticks(range(len(groups)), groups)
    left.set_title("Success [%]", loc="left", fontsize=10)
    right.axvline(0, color=MUTED, lw=0.8)
    for row, group in enumerate(groups):
        one = found.get(group)
        if one is not None and one.difference is not None and one.difference.interval is not None:
            right.plot([100 * end for end in one.difference.interval], [row, row], color=INK, lw=1.2)
            right.plot(100 * one.difference.value, row, "|", color=INK, ms=12)
            pairs = 100 * pair_differences(results, one)
            right.plot(pairs, [row] * len(pairs), "o", color=BLUE, ms=4, alpha=0.8)
    right.set_title("Difference [points]", loc="left", fontsize=10)
    tidy(right, "x")
    return figure


def pair_differences(results: Results, one: Finding) -> np.ndarray:
    """Return the difference of success, -1..1, of each pair of trainings with the same seed, (n,)."""
    ours, theirs = one.contrast.ours.group, one.contrast.theirs.group  # type: ignore[union-attr]
    seeds = [seed for seed in results.groups[ours] if seed in results.groups[theirs]]
    rates = [np.mean([[results.cells[at, group][seed]["success"].mean() for seed in seeds]
                      for at in one.contrast.ours.at], axis=0) for group in (ours, theirs)]  # fmt: skip
    difference: np.ndarray = rates[0] - rates[1]
    return difference


KINDS: dict[str, Callable[[Study, Section], Figure]] = {
    "map": change_map,
    "forest": forest,
    "survival": survival,
    "axes": axes_map,
    "doses": dose_figure,
    "lines": lines,
    "dots": dots,
    "spread": spread,
    "variants": variants,
}
# Data that a kind of figure needs, for kinds whose data may be missing; empty: no figure is drawn.
NEEDED: dict[str, Callable[[Study, Section], object]] = {
    "map": lambda study, said: study.changes,
    "forest": tested_of,
    "axes": lambda study, said: numeric_axes(study.results),
    "dots": lambda study, said: study.families[said["family"]][1],
}
CAPTIONS = {
    "map": "Success [%] of each group under each condition. Colour: the change against the baseline "
    "of the condition. First row: the baseline. Bold: significant for other runs. Empty: the change cannot "
    "affect that policy.",
    "forest": "Difference of each test. A line is a test: the dot is the difference, the line its 95 % "
    "interval, of this test alone. Within the grey band a difference is too small to matter.",
    "survival": "Share of episodes that have not ended before a distance [%]. Thin: one training. Thick: "
    "all. Blue: nothing changed. Red: the condition in which the group succeeds least, named above.",
    "axes": "Success along every axis of numbers. Markers: means of the named groups with 95 % intervals, "
    "shifted sideways. Grey: the other groups. Values stand at equal distances.",
    "doses": "Change of success against the measured event error. The 95 % intervals are not adjusted; "
    "markers are shifted sideways. Hollow: a training of the group met as much of that kind.",
    "lines": "Success against control rate. A marker is one training, shifted sideways; a line is the "
    "mean. Dotted: the value at which they were trained.",
    "dots": "Success of every training under each condition. A small marker is one training, a stroke"
    " the mean of its group.",
    "spread": "Mean success of every training, and by what success differs. Left: a cell is one "
    "training. Right: the standard deviations of the table.",
    "variants": "Success of each variant, and the difference of the means. Left: success [%], mean of the"
    " trainings. Right: a dot for each pair of trainings of one seed, a tick for their mean, a bar for its "
    "95 % interval.",
}
