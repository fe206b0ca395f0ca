"""Write docs/numerics.md from what the tests of extremes record.

Run: python -m tests.numerics.page
Expect: a minute or two; a failing test leaves the page as it is.
"""

import subprocess
import sys
import tempfile
from pathlib import Path
from xml.etree import ElementTree

from jobs.analysis.tables import markdown_table
from jobs.run.files import write_atomic
from jobs.run.provenance import git_commit, today

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "numerics.md"
TESTS = "tests/numerics/test_extremes.py"
HEADINGS = ("Part", "Extreme", "Defined result", "Worst error", "Accepted")
TEXT = """# Numbers at the ends of their ranges

Each of {count} extreme inputs has one defined result. The worst error is measured against float64 or a closed
form, and a test fails if it exceeds the accepted bound (`{tests}`). A value outside its range
raises an error that states the rule and the value.

{table}
"None" means exact: not one event, bit or accepted value too many.

Measured on {date} at commit {commit}; `python -m tests.numerics.page` (`make numerics`) measures again.
"""


def main() -> None:
    """Run the tests and write the page."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        command = [sys.executable, "-m", "pytest", TESTS, "-m", "", "-n", "0", f"--junitxml={report}"]
        subprocess.run(command, cwd=ROOT, check=True)
        rows = read_rows(report)
    table = markdown_table(HEADINGS, [table_row(row) for row in rows], 3)
    facts = {"count": len(rows), "tests": TESTS, "date": today(), "commit": git_commit()[:7]}
    write_atomic(PAGE, TEXT.format(table=table, **facts))


def read_rows(report: Path) -> list[dict[str, str]]:
    """Read the properties of each test that recorded some, in the order of the tests."""
    cases = ElementTree.parse(report).iter("testcase")
    found = [{one.get("name"): one.get("value") for one in case.iter("property")} for case in cases]
    return [row for row in found if "error" in row]


def table_row(row: dict[str, str]) -> tuple[str, ...]:
    """Return a text for each of `HEADINGS`; "none" for an error of 0."""
    error, bound = float(row["error"]), float(row["bound"])
    return (
        *(row[name] for name in ("part", "what", "result")),
        f"{error:.2g} {row['unit']}" if error else "none",
        f"{bound:g} {row['unit']}" if bound else "none",
    )


if __name__ == "__main__":
    main()
