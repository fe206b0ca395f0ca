"""Why trainings by PPO differ: by their encoder, or by their seed of PPO.

The study `+exp=encoder_seeds` crosses both; docs/encoder_seeds.md has its plan.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from jobs.analysis.plots import BLUE, MUTED, RED, tidy
from jobs.analysis.statistics import CONFIDENCE, CrossedSpread, crossed_spread, holm
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


class Factors(NamedTuple):
    """What the trainings of a table differ by.

    Attributes:
        mean: Success of all [%].
        spread: Standard deviations [points].
        encoder_p, seed_p: Of the tests that these are 0, after Holm; None: not tested.
    """

    mean: float
    spread: CrossedSpread
    encoder_p: float | None
    seed_p: float | None


def factors(tables: Mapping[Condition, np.ndarray]) -> dict[str, Factors]:
    """Those of the mean of all conditions, whose tests are a family, and of each, whose tests are another."""
    mean = np.mean(list(tables.values()), axis=0)
    return _family({MEAN: mean}) | _family({condition_text(*at): table for at, table in tables.items()})


def _family(tables: Mapping[str, np.ndarray]) -> dict[str, Factors]:
    """Of tables whose tests are one family."""
    spreads = {name: crossed_spread(100 * table) for name, table in tables.items()}
    tested = [p for one in spreads.values() for p in (one.rows_p, one.columns_p) if p is not None]
    adjusted = iter(holm(tested))
    found = {}
    for name, one in spreads.items():
        ps = [None if p is None else next(adjusted) for p in (one.rows_p, one.columns_p)]
        found[name] = Factors(100 * float(tables[name].mean()), one, *ps)
    return found


def _row(name: str, one: Factors) -> tuple[str, ...]:
    """A row under `HEAD`."""
    encoder_p, seed_p = ("-" if p is None else f"{p:.2g}" for p in (one.encoder_p, one.seed_p))
    spread = one.spread
    return (
        name, f"{one.mean:.0f}", f"{spread.rows:.0f}", encoder_p, f"{spread.columns:.0f}", seed_p,
        f"{spread.rest:.0f}",
    )  # fmt: skip


def certain_factors(one: Factors) -> list[str]:
    """Which of the two factors make trainings differ for certain."""
    tested = {"encoder": one.encoder_p, "seed of PPO": one.seed_p}
    return [name for name, p in tested.items() if p is not None and p < 1.0 - CONFIDENCE]


def results_text(about: SweepFacts, episodes: SweptEpisodes) -> str:
    """What the results say, as Markdown: what is found in the mean, and a table."""
    tables = by_encoder(episodes)
    mean, found = np.mean(list(tables.values()), axis=0), factors(tables)
    certain = " and by their ".join(certain_factors(found[MEAN]))
    flights = about["trials"] * len(tables)
    verdict = (
        f"differ by their {certain}, for certain"
        if certain
        else "differ for certain neither by their encoder nor by their seed of PPO"
    )
    parts = (
        f"Trainings {verdict}. Under all {len(tables)} conditions together the {mean.size} succeed in "
        f"{_span(mean)} % of their flights; the means by encoder are {_span(mean.mean(axis=1))} %, those by "
        f"seed of PPO {_span(mean.mean(axis=0))} %. What neither explains is {found[MEAN].spread.rest:.0f} "
        f"points of standard deviation, of which chance over {flights} flights makes at most "
        f"{50 / math.sqrt(flights):.0f}.",
        markdown_table(HEAD, [_row(*item) for item in found.items()], 1).rstrip("\n"),
        "Standard deviations [points] of what the trainings by one encoder have in common, of what those of "
        "one seed of PPO have in common, and of what neither explains. The tests of the mean are one family, "
        "those of the single conditions another.",
    )
    return "\n\n".join(parts)


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
    spreads = {name: one.spread for name, one in factors(tables).items()}
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
