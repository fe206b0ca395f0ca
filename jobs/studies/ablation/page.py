"""The page of an ablation: success of each variant, what it changes, and a plot of both."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from jobs.analysis.plots import BLUE, INK, MUTED, tidy
from jobs.analysis.statistics import Difference, Estimate, crossed_mean
from jobs.analysis.tables import estimate_text, markdown_table, publish_plot, show_table
from jobs.evaluation.group_stats import CHANGE, RATE
from jobs.evaluation.sweep_report import SweepFacts
from jobs.run.files import write_atomic, write_json
from jobs.run.folder import Run
from jobs.run.provenance import Provenance
from jobs.tracking.tracker import Tracker

TITLE = "Success [%] with one part of the recipe changed"


class AblationFacts(SweepFacts, Provenance):
    """What made an ablation, as its about.json says it: a sweep over what it has trained, on a machine."""

    seeds: list[int]
    env_steps: int
    variants: dict[str, dict[str, Any]]


class VariantResult(NamedTuple):
    """How the trainings of one variant do.

    Attributes:
        name: Of the variant.
        success: Condition -> mean success of each training (n,).
        mean: Over conditions, trainings and corridors, within 0 and 1.
        difference: Of that to the variant it is compared with, by pairs of trainings of a seed, within -1 and
            1; None: it is compared with none.
        differences: The difference of each pair (n,).
        minutes: Of the policy's training, the mean [min]; None: not known.
    """

    name: str
    success: dict[str, np.ndarray]
    mean: Estimate
    difference: Difference | None
    differences: np.ndarray
    minutes: float | None


def variant_result(
    name: str,
    success: Mapping[str, np.ndarray],
    first: Mapping[str, np.ndarray] | None,
    minutes: Sequence[float],
) -> VariantResult:
    """Compare a variant with another; trainings are the unit, in the same corridors (`crossed_mean`).

    Args:
        name: Of the variant.
        success: Condition -> success (trainings, corridors), of the same corridors each.
        first: The same of the other, trained with the same seeds; None: it is compared with none.
        minutes: Of each training [min]; empty: not known.
    """
    own = np.mean(list(success.values()), axis=0)
    mean = Estimate(*crossed_mean(own, RATE)[:2])
    differences = own - (own if first is None else np.mean(list(first.values()), axis=0))
    difference = None if first is None else crossed_mean(differences, CHANGE)
    per_training = {condition: values.mean(axis=1) for condition, values in success.items()}
    mean_minutes = float(np.mean(minutes)) if minutes else None
    return VariantResult(name, per_training, mean, difference, differences.mean(axis=1), mean_minutes)


def write_page(folder: Run, tracker: Tracker, results: Sequence[VariantResult], facts: AblationFacts) -> None:
    """Print the table; write table, plot and facts into the run folder and the tracker."""
    head, *rows = table_lines(results)
    show_table(TITLE, head, rows, 1, None)
    fewer = [f"`{name}` {len(one['seeds'])}" for name, one in facts["variants"].items() if "seeds" in one]
    but = f" ({', '.join(fewer)})" if fewer else ""
    apart = "validation " if facts["split"] == "validation" else ""
    said = (
        f"{len(facts['seeds'])} trainings each{but}, {facts['env_steps']:,} environment steps, "
        f"{facts['trials']} {apart}corridors for each training and condition. Mean: over the conditions, "
        "95 % interval by trainings and corridors. Change: to the first variant, by pairs of trainings with "
        "the same seed. Minutes: of the policy's training, without the encoder's."
    )
    table = markdown_table(head, rows, 1)
    text = f"`{facts['command']}`, {facts['date']}, commit {facts['commit']}.\n\n{table}\n{said}\n"
    write_atomic(folder.path / "ablation" / "ablation.md", text)
    tracker.text("ablation/ablation.md", text)
    publish_plot(folder, tracker, "ablation/ablation", plot_variants(results))
    write_json(folder.path / "ablation" / "about.json", facts)  # the last: it says that the rest is there


def table_lines(results: Sequence[VariantResult]) -> list[tuple[str, ...]]:
    """Heading and lines of the table: a variant in each line, or in each column if conditions are more."""
    head = ("Variant", *results[0].success, "Mean", "Change [points]", "Minutes")
    lines = [head, *(table_row(result) for result in results)]
    return list(zip(*lines, strict=True)) if len(results[0].success) > len(results) else lines


def table_row(result: VariantResult) -> tuple[str, ...]:
    """One line of the table."""
    return (
        result.name,
        *(f"{100 * values.mean():.0f}" for values in result.success.values()),
        estimate_text(result.mean, 100, ".0f"),
        estimate_text(result.difference, 100, "+.0f"),
        "-" if result.minutes is None else f"{result.minutes:.1f}",
    )


def plot_variants(results: Sequence[VariantResult]) -> Figure:
    """Draw success by variant and condition as a map, and the change of the mean, a dot for each training."""
    conditions = list(results[0].success)
    values = np.array([[100 * one.success[name].mean() for name in conditions] for one in results])
    figure = Figure(figsize=(4.6 + 0.72 * len(conditions), 1.6 + 0.42 * len(results)), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(1.6, 1))
    left.imshow(values, cmap="cividis", vmin=0, vmax=100, aspect="auto")
    for row, column in np.ndindex(values.shape):
        colour = "black" if values[row, column] > 55 else "white"
        left.text(
            column, row, f"{values[row, column]:.0f}", ha="center", va="center", color=colour, fontsize=9
        )
    left.set_xticks(range(len(conditions)), conditions, rotation=35, ha="right")
    left.set_yticks(range(len(results)), [one.name for one in results])
    left.set_title("Success [%]", loc="left", fontsize=10)
    right.axvline(0, color=MUTED, lw=0.8)
    for row, one in enumerate(results):
        if one.difference is not None and one.difference.interval is not None:
            ends = [100 * end for end in one.difference.interval]
            right.plot(ends, [row, row], color=INK, lw=1.2)
            right.plot(100 * one.difference.value, row, "|", color=INK, ms=12)
            right.plot(100 * one.differences, [row] * len(one.differences), "o", color=BLUE, ms=4, alpha=0.8)
    right.set_title("Change of the mean [points]", loc="left", fontsize=10)
    tidy(right, "x")
    return figure
