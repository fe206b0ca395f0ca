"""Measure the time from an empty clone to each first result of a new user.

Run: python -m benchmarks.from_clone [COMMIT]; COMMIT is HEAD by default
Expect: a table in 10 to 45 minutes, on an otherwise idle machine: seconds of `make setup`,
`make demo` and `make bytestream` in a new clone, of each stage of the last, and of a second `make demo`.
Caches of this machine are not used: neither its packages nor its compiled kernels. The clone is
removed afterwards.
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from jobs.analysis.tables import show_table
from jobs.run.provenance import REPOSITORY

STAGES = ("collect", "pretrain", "train", "evaluate")


def main() -> None:
    """Measure and print the table."""
    commit = sys.argv[1] if len(sys.argv) > 1 else "HEAD"
    with tempfile.TemporaryDirectory() as folder:
        clone = Path(folder) / "evade"
        os.environ["XDG_CACHE_HOME"], os.environ["PIP_NO_CACHE_DIR"] = str(Path(folder) / "cache"), "1"
        run("git", "clone", "--quiet", str(REPOSITORY), str(clone))
        run("git", "-C", str(clone), "checkout", "--quiet", commit)
        rows = [(name, f"{seconds:,.0f}") for name, seconds in first_results(clone)]
    show_table(f"from an empty clone of {commit}", ("what", "seconds"), rows)


def first_results(clone: Path) -> Iterator[tuple[str, float]]:
    """Yield what a new user waits for, and how long [s]."""
    setup, first, again = (make(clone, target) for target in ("setup", "demo", "demo"))
    yield "make setup", setup
    yield "make setup and make demo", setup + first
    yield "make demo again", again
    began, seconds = time.time(), make(clone, "bytestream")
    yield "make setup and make bytestream", setup + seconds
    (marks,) = clone.glob("runs/*/stages")
    for stage in STAGES:
        ended = (marks / f"{stage}.json").stat().st_mtime
        yield f"  of which {stage}", ended - began
        began = ended


def make(clone: Path, target: str) -> float:
    """Run a target of the Makefile; return its wall time [s]."""
    began = time.perf_counter()
    run("make", "-C", str(clone), target, f"VENV={clone / '.venv'}")
    return time.perf_counter() - began


def run(*words: str) -> None:
    """Run a command as in a shell in which no virtual environment is active."""
    subprocess.run(words, check=True, env=without_this_environment())  # noqa: S603  words of this file


def without_this_environment() -> dict[str, str]:
    """Return the variables of a shell in which no virtual environment is active."""
    kept = os.environ.keys() - {"VIRTUAL_ENV", "PYTHONPATH", "MAKEFLAGS", "MAKELEVEL"}
    return {name: os.environ[name] for name in kept}


if __name__ == "__main__":
    main()
