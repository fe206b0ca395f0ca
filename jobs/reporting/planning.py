"""What a study of other numbers of trainings and corridors would tell of the paper's claims.

Run: python -m jobs.reporting.planning taught_claims 10 28
Prints, for each claim of a study whose episodes are in docs/data: how much trainings differ, how much single
episodes do beside that, and half of the 95 % interval of the difference with as many trainings of each
group and as many corridors as asked, if they differ as those of the study.
"""

import argparse
import sys
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import t

from jobs.analysis.statistics import CONFIDENCE
from jobs.analysis.tables import show_table
from jobs.reporting.breaks import place
from jobs.reporting.paper_claims import CLAIMS, UNITS, compared, over_conditions
from jobs.reporting.sweep_data import read_data
from jobs.run.provenance import REPOSITORY

DATA, ABOUT = REPOSITORY / "docs" / "data", "_about.json"
HEAD = ("Claim", "Against", "Of trainings", "Of episodes", "Interval")


class Spread(NamedTuple):
    """Standard deviations of a group: of what trainings are on average, and of an episode beside that."""

    trainings: float
    episodes: float


def spread_of(values: np.ndarray) -> Spread:
    """Of values (trainings, corridors), two of each at least, by analysis of variance of two crossed factors.

    What corridors share is no part of it; where trainings differ less than their episodes alone would make
    them differ, theirs is 0.
    """
    trainings, corridors = values.shape
    rest = values - values.mean(axis=0) - values.mean(axis=1, keepdims=True) + values.mean()
    chance = (rest**2).sum() / ((trainings - 1) * (corridors - 1))
    between = values.mean(axis=1).var(ddof=1) - chance / corridors
    return Spread(float(np.sqrt(max(between, 0.0))), float(np.sqrt(chance)))


def expected_half_width(ours: Spread, theirs: Spread, trainings: int, corridors: int) -> float:
    """Half of Welch's 95 % interval of the difference of two groups, in the unit of their spreads.

    Args:
        ours: Of one group.
        theirs: Of the other.
        trainings: Of each, two at least.
        corridors: In which all are evaluated.
    """
    parts = [(one.trainings**2 + one.episodes**2 / corridors) / trainings for one in (ours, theirs)]
    squares = sum(part**2 for part in parts)
    freedom = sum(parts) ** 2 / squares * (trainings - 1) if squares > 0 else 2.0 * (trainings - 1)
    return float(t.ppf((1 + CONFIDENCE) / 2, freedom) * np.sqrt(sum(parts)))


def plan_rows(study: str, trainings: int, corridors: int) -> list[tuple[str, ...]]:
    """A row under `HEAD` for each claim between groups of several trainings.

    Args:
        study: Name of published data.
        trainings: Of each group.
        corridors: In which all are evaluated.
    """
    about, episodes = read_data(DATA, study)
    baselines = {place(one["condition"]): place(one["baseline"]) for one in about["compared"]}
    rows = []
    for claim in CLAIMS:
        sides = compared(claim, lambda at, group: episodes.get((at, group), {}), baselines)
        means = [over_conditions(side) for side in sides if side]
        if len(means) < len(sides) or min(map(len, means)) < 2:  # of one training no spread is known
            continue
        ours, theirs = (spread_of(side) for side in means)
        scale, _, unit = UNITS[claim.measure]
        spreads = [
            f"{scale * one:.0f}, {scale * other:.0f}{unit}" for one, other in zip(ours, theirs, strict=True)
        ]
        half = scale * expected_half_width(ours, theirs, trainings, corridors)
        rows.append((f"{claim.ours}: {claim.text}", claim.theirs, *spreads, f"±{half:.1f}{unit}"))
    return rows


def several(word: str) -> int:
    """A number of trainings or corridors, of which there must be two.

    Raises:
        argparse.ArgumentTypeError: It is no such number.
    """
    if not word.isdecimal() or int(word) < 2:
        raise argparse.ArgumentTypeError(f"must be a whole number, two at least, got {word!r}")
    return int(word)


def main(words: Sequence[str]) -> None:
    """Print the table; wrong words end the program with the rule."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    studies = sorted(path.name.removesuffix(ABOUT) for path in DATA.glob(f"*{ABOUT}"))
    parser.add_argument("study", choices=studies, help="whose episodes say how much trainings differ")
    parser.add_argument("trainings", type=several, help="of each group")
    parser.add_argument("corridors", type=several, help="the same for all")
    asked = parser.parse_args(words)
    design = f"{asked.trainings} trainings of each group in {asked.corridors} corridors"
    rows = plan_rows(asked.study, asked.trainings, asked.corridors)
    show_table(f"{design}, by the spread in {asked.study}", HEAD, rows, 2, None)


if __name__ == "__main__":
    main(sys.argv[1:])
