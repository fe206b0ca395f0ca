"""From what trainings by PPO differ: from their encoder, or from the seed of PPO.

The study `+exp=encoder_seeds` crosses both; docs/encoder_seeds.md has its plan.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from jobs.analysis.plots import BLUE, MUTED, RED, tidy
from jobs.analysis.statistics import crossed_spread, holm
from jobs.analysis.tables import markdown_table
from jobs.evaluation.group_stats import Condition, episode_values
from jobs.evaluation.sweep_report import SweepFacts
from jobs.reporting.breaks import SweptEpisodes
from jobs.reporting.words import condition_text

ENCODERS = "encoder_seeds"  # name of the experiment, and of what is published of it
OWN, OTHER = "own", "encoder_"  # groups: encoder and PPO of one seed; by the encoder of the seed in the name
HEAD = (
    "Success [%]",
    "Mean",
    "SD of encoders",
    "p (Holm)",
    "SD of seeds of PPO",
    "p (Holm)",
    "SD of the rest",
)
MEAN = "mean of these"


def by_encoder(episodes: SweptEpisodes) -> dict[Condition, np.ndarray]:
    """Success rate of each training, 0..1, (encoders, seeds of PPO), under each condition.

    Args:
        episodes: Of the study.

    Raises:
        ValueError: A training is missing.
    """
    cells: dict[Condition, dict[tuple[int, int], float]] = {}
    for (condition, group), trainings in episodes.items():
        for seed, success in zip(trainings, episode_values(trainings, "success").mean(axis=1), strict=True):
            if seed is not None:
                encoder = seed if group == OWN else int(group.removeprefix(OTHER))
                cells.setdefault(condition, {})[encoder, seed] = float(success)
    return {condition: _table(own) for condition, own in cells.items()}


def _table(cells: Mapping[tuple[int, int], float]) -> np.ndarray:
    seeds = sorted({seed for place in cells for seed in place})
    missing = [(encoder, seed) for encoder in seeds for seed in seeds if (encoder, seed) not in cells]
    if missing:
        raise ValueError(f"every encoder must be met by every seed of PPO; missing: {missing}; train these")
    return np.array([[cells[encoder, seed] for seed in seeds] for encoder in seeds])


def spread_rows(tables: Mapping[Condition, np.ndarray]) -> list[tuple[str, ...]]:
    """A row under `HEAD` for the mean of all conditions, a family of tests, and one for each, another."""
    mean = np.mean(list(tables.values()), axis=0)
    return [
        *_rows({MEAN: mean}),
        *_rows({condition_text(*condition): table for condition, table in tables.items()}),
    ]


def _rows(tables: Mapping[str, np.ndarray]) -> list[tuple[str, ...]]:
    """Rows of tables whose tests are one family."""
    spreads = [crossed_spread(100 * table) for table in tables.values()]
    tested = [p for one in spreads for p in (one.rows_p, one.columns_p) if p is not None]
    adjusted = iter(holm(tested))
    rows = list[tuple[str, ...]]()
    for (name, table), one in zip(tables.items(), spreads, strict=True):
        ps = ["-" if p is None else f"{next(adjusted):.2g}" for p in (one.rows_p, one.columns_p)]
        mean = f"{100 * table.mean():.0f}"
        rows.append((name, mean, f"{one.rows:.0f}", ps[0], f"{one.columns:.0f}", ps[1], f"{one.rest:.0f}"))
    return rows


def results_text(about: SweepFacts, episodes: SweptEpisodes) -> str:
    """What the results say, as Markdown: what is found in the mean, and a table."""
    tables = by_encoder(episodes)
    mean, rows = np.mean(list(tables.values()), axis=0), spread_rows(tables)
    parts = (
        f"{_found(rows[0])} Under all {len(tables)} conditions together the {mean.size} trainings succeed in "
        f"{_span(mean)} % of their flights; the means by encoder are {_span(mean.mean(axis=1))} %, those by "
        f"seed of PPO {_span(mean.mean(axis=0))} %.",
        markdown_table(HEAD, rows, 1).rstrip("\n"),
        "Standard deviations [points] of what the trainings by one encoder have in common, of what those of "
        "one seed of PPO have in common, and of what neither explains. The tests of the mean are one family, "
        "those of the single conditions another.",
    )
    return "\n\n".join(parts)


def _found(row: Sequence[str]) -> str:
    """Which of the two factors are certain, by a row under `HEAD`."""
    tested = (("encoder", row[3]), ("seed of PPO", row[5]))
    certain = [name for name, p in tested if p != "-" and float(p) < 0.05]
    if certain:
        return f"Trainings differ by their {' and their '.join(certain)}, for certain."
    return "Trainings differ for certain neither by their encoder nor by their seed of PPO."


def _span(values: np.ndarray) -> str:
    return f"{100 * values.min():.0f} to {100 * values.max():.0f}"


def draw(about: SweepFacts, episodes: SweptEpisodes) -> Figure:
    """Draw the mean success of every training as a map, and what it differs by under each condition."""
    tables = by_encoder(episodes)
    mean = 100 * np.mean(list(tables.values()), axis=0)
    figure = Figure(figsize=(9.6, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.4))
    left.imshow(mean, cmap="cividis", vmin=0, vmax=100)
    for row, column in np.ndindex(mean.shape):
        colour = "black" if mean[row, column] > 55 else "white"
        left.text(column, row, f"{mean[row, column]:.0f}", ha="center", va="center", color=colour)
    left.set_xticks(range(len(mean)))
    left.set_yticks(range(len(mean)))
    left.set(xlabel="Seed of PPO", ylabel="Seed of the encoder")
    left.set_title("Success [%], mean of the conditions", loc="left", fontsize=10)
    spreads = {MEAN: crossed_spread(mean)}
    spreads |= {condition_text(*at): crossed_spread(100 * table) for at, table in tables.items()}
    shown = {"encoder": (BLUE, "o"), "seed of PPO": (RED, "s"), "neither": (MUTED, "D")}
    for place, (label, (colour, marker)) in enumerate(shown.items()):
        values = [(one.rows, one.columns, one.rest)[place] for one in spreads.values()]
        rows = np.arange(len(spreads)) + 0.18 * (place - 1)
        right.plot(values, rows, marker, color=colour, ms=6, label=label)
    right.set_yticks(range(len(spreads)), list(spreads))
    right.set_ylim(len(spreads) - 0.5, -0.5)
    right.set_xlim(left=-0.5)
    right.set_title("Standard deviation of success [points] by", loc="left", fontsize=10)
    right.legend(frameon=False, fontsize=8)
    tidy(right)
    return figure
