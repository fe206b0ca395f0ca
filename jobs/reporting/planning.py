"""What a study of other numbers of trainings and corridors would tell of the paper's claims.

Run: python -m jobs.reporting.planning taught_claims 10 28
Prints, for each claim of a study whose episodes are in docs/data: the standard deviation between trainings
of a group, that of single episodes of a training, that of the groups' difference between corridors, and
half of the 95 % interval of the difference, with as many trainings of each group and as many corridors as
asked, if they differ as those of the study.
"""

import argparse
import sys
from collections.abc import Sequence

from jobs.analysis.statistics import corridor_spread, expected_half_width, spread_of
from jobs.analysis.tables import show_table
from jobs.reporting.breaks import place
from jobs.reporting.paper_claims import CLAIMS, UNITS, compared, over_conditions
from jobs.reporting.sweep_data import read_data
from jobs.run.provenance import REPOSITORY

DATA, ABOUT = REPOSITORY / "docs" / "data", "_about.json"
HEAD = (
    "Claim",
    "Against",
    "SD between trainings",
    "SD of an episode",
    "SD between corridors",
    "95 % interval",
)


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
        apart = corridor_spread(*means)
        scale, _, unit = UNITS[claim.measure]
        spreads = [
            f"{scale * one:.0f}, {scale * other:.0f}{unit}" for one, other in zip(ours, theirs, strict=True)
        ]
        half = scale * expected_half_width(ours, theirs, apart, trainings, corridors)
        texts = (*spreads, f"{scale * apart:.0f}{unit}", f"±{half:.1f}{unit}")
        rows.append((f"{claim.ours}: {claim.text}", claim.theirs, *texts))
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
