"""What the numbers do at the ends of their ranges, measured: each extreme, its result, and the worst error.

Run: python -m platform.launch +exp=numerics
Expect: a minute or two; a table, and the page docs/numerics.md.
"""

import math
from collections.abc import Sequence
from pathlib import Path

from jobs.analysis.tables import markdown_table, show_table
from jobs.config.config import Config
from jobs.run.files import write_atomic
from jobs.run.folder import finish, open_run
from jobs.run.progress import console, progress
from jobs.run.provenance import REPOSITORY, command, git_commit, today
from jobs.run.templates import render
from jobs.studies.numerics.extremes import EXTREMES, Extreme
from jobs.tracking.tracker import open_tracker

TEMPLATE = Path(__file__).parent / "page.md.j2"
PAGE = REPOSITORY / "docs" / "numerics.md"
HEADINGS = ("Part", "Extreme", "Defined result", "Worst error", "Accepted", "Test")


class NumericsError(RuntimeError):
    """An error is larger than what is accepted."""


def run(config: Config) -> dict[str, float]:
    """Measure every extreme, and write the page; return the worst errors.

    Raises:
        NumericsError: One is larger than what is accepted; the page is not written.
    """
    folder = open_run(config)
    with open_tracker(folder.config, folder, key="numerics") as tracker:
        tracker.tags({"kind": "numerics"})
        worst = []
        with progress("Numerics", len(EXTREMES), "extremes") as advance:
            for extreme in EXTREMES:
                worst.append(extreme.worst())
                advance(1, note=extreme.part)
        rows = table_rows(EXTREMES, worst)
        show_table("Numbers at the ends of their ranges", HEADINGS, rows, 3, None)
        refuse_excess(EXTREMES, worst)
        text = render(
            TEMPLATE, command=command(), commit=git_commit()[:7], date=today(), count=len(rows),
            table=markdown_table(HEADINGS, rows, 3),
        )  # fmt: skip
        write_atomic(PAGE, text)
        tracker.text("numerics/numerics.md", text)
        metrics = {f"sim/extreme_{place:02d}": error for place, error in enumerate(worst)}
        tracker.log(0, metrics)
        console.print(f"Written: {PAGE.relative_to(REPOSITORY)}", markup=False)
    return finish(folder, "numerics", metrics)


def table_rows(extremes: Sequence[Extreme], worst: Sequence[float]) -> list[tuple[str, ...]]:
    """One line for each extreme; errors with their units, "none" for 0."""
    return [
        (
            extreme.part,
            extreme.what,
            extreme.result,
            f"{error:.2g} {extreme.unit}" if error else "none",
            f"{extreme.bound:g} {extreme.unit}" if extreme.bound else "none",
            f"`{extreme.test}`",
        )
        for extreme, error in zip(extremes, worst, strict=True)
    ]


def refuse_excess(extremes: Sequence[Extreme], worst: Sequence[float]) -> None:
    """Raise where an error is above what is accepted, or is no number.

    Raises:
        NumericsError: As said.
    """
    for extreme, error in zip(extremes, worst, strict=True):
        if math.isnan(error) or error > extreme.bound:
            rule = f"must be at most {extreme.bound:g} {extreme.unit}"
            raise NumericsError(f"{extreme.part}, {extreme.what}: the error {rule}, got {error:g}")
