"""Two pictures of a sweep: success of every policy under every condition, and the paper's claims."""

from collections.abc import Mapping, Sequence
from typing import cast

import numpy as np
from matplotlib.figure import Figure

from jobs.analysis.plots import BLUE, GREEN, INK, MUTED, RED, tidy
from jobs.analysis.statistics import Difference
from jobs.evaluation.group_stats import Condition
from jobs.reporting.breaks import Change
from jobs.reporting.paper_claims import GAIN, Claim, Finding

UNITS = {"success": (100, "points of success"), "distance_m": (1, "m of distance")}
VERDICT_COLOURS = {"holds": GREEN, "reversed": RED, "equivalent": BLUE}


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
        places = column + 0.05 + 0.4 * change.success
        panel.plot(places, np.full(len(places), row), "o", color=colour, ms=2.5, alpha=0.8)
    panel.set_xticks(range(len(columns)), columns, rotation=35, ha="left", fontsize=8)
    panel.xaxis.tick_top()
    panel.set_yticks(range(len(rows)), [labels[at] for at in rows], fontsize=8)
    panel.spines[:].set_visible(False)
    panel.tick_params(length=0)
    bar = figure.colorbar(picture, ax=panel, shrink=0.5, pad=0.01)
    bar.set_label("Change against the baseline [points]", fontsize=8)
    note = (
        "Numbers: success [%], bold where the change is certain. Dots: each training, from 0 (left) to 100 %."
    )
    figure.supxlabel(note, fontsize=8, color=MUTED)
    return figure


def claims_plot(findings: Mapping[Claim, Finding]) -> Figure:
    """Draw the difference of each tested claim with its interval, by its measure, coloured by the verdict."""
    tested = {claim: one for claim, one in findings.items() if one.overall and one.overall.interval}
    measures = [name for name in UNITS if any(claim.measure == name for claim in tested)]
    sizes = [sum(claim.measure == name for claim in tested) for name in measures]
    figure = Figure(figsize=(9.6, 1.2 + 0.34 * sum(sizes)), layout="constrained")
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
            panel.text(1.01, row, one.verdict, transform=panel.get_yaxis_transform(), va="center", fontsize=8)
        names = [f"{claim.ours}: {claim.text}" for claim, _ in own]
        panel.set_yticks(range(len(own)), [text if len(text) < 70 else f"{text[:67]}..." for text in names])
        panel.tick_params(axis="y", labelsize=8)
        panel.set_ylim(len(own) - 0.5, -0.5)
        panel.set_xlabel(f"Difference [{unit}]; grey: too small to matter", fontsize=8)
        tidy(panel, "x")
    return figure
