"""What a study of other numbers of trainings and corridors would tell of the tests of a published one.

Run: python -m jobs.study.planning taught_claims 10 28
Prints, for each test between two groups of several trainings: the standard deviations between trainings of a
group, of single episodes of a training, and of the groups' difference between corridors; and half of the 95 %
interval of the difference, with as many trainings of each group and as many corridors as asked.
"""

import argparse
import sys
from collections.abc import Sequence

from jobs.analysis.statistics import corridor_spread, expected_half_width, spread_of
from jobs.analysis.tables import show_table
from jobs.run.provenance import REPOSITORY
from jobs.study.contrasts import compared_values
from jobs.study.results import read_published
from jobs.study.spec import families_of, read_study
from jobs.study.tables import scale_of

DATA, ABOUT = REPOSITORY / "docs" / "data", "_about.json"
HEAD = (
    "Test",
    "Against",
    "SD between trainings",
    "SD of an episode",
    "SD between corridors",
    "95 % interval",
)


def plan_rows(study: str, trainings: int, corridors: int) -> list[tuple[str, ...]]:
    """Return a row under `HEAD` for each test between groups of several trainings.

    Args:
        study: Name of the published study.
        trainings: Number for each group.
        corridors: Number, the same for all groups.
    """
    results, rows = read_published(DATA, study), []
    for family in families_of(read_study(study), results):
        for one in family.contrasts:
            sides = compared_values(one, results, {})
            if one.paired or one.theirs is None or any(side is None or len(side) < 2 for side in sides):
                continue  # a single training has no spread
            ours, theirs = (spread_of(side) for side in sides if side is not None)
            apart = corridor_spread(*sides)  # type: ignore[arg-type]
            scale, _, unit = scale_of(one)
            spreads = [f"{scale * a:.0f}, {scale * b:.0f} {unit}" for a, b in zip(ours, theirs, strict=True)]
            half = scale * expected_half_width(ours, theirs, apart, trainings, corridors)
            texts = (*spreads, f"{scale * apart:.0f} {unit}", f"±{half:.1f} {unit}")
            rows.append((f"{one.ours.group}: {one.name}", one.theirs.group, *texts))
    return rows


def several(word: str) -> int:
    """Parse a number of trainings or corridors, at least two.

    Raises:
        argparse.ArgumentTypeError: The word is not such a number.
    """
    if not word.isdecimal() or int(word) < 2:
        raise argparse.ArgumentTypeError(f"must be a whole number, two at least, got {word!r}")
    return int(word)


def main(words: Sequence[str]) -> None:
    """Print the table; wrong arguments end the program with a message."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    studies = sorted(path.name.removesuffix(ABOUT) for path in DATA.glob(f"*{ABOUT}"))
    parser.add_argument("study", choices=studies, help="whose episodes say how much trainings differ")
    parser.add_argument("trainings", type=several, help="of each group")
    parser.add_argument("corridors", type=several, help="the same for all")
    asked = parser.parse_args(words)
    design = f"{asked.trainings} trainings of each group in {asked.corridors} corridors"
    rows = plan_rows(asked.study, asked.trainings, asked.corridors)
    show_table(f"{design}, by the spread in {asked.study}", HEAD, rows, 2)


if __name__ == "__main__":
    main(sys.argv[1:])
