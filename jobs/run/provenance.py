"""Return the provenance of a result: commit, machine, command and date."""

import os
import re
import shlex
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import TypedDict

REPOSITORY = Path(__file__).resolve().parents[2]
PLACES = ("runs_dir=", "resume=", "tracking.", "cluster")  # words that say where a command runs and writes


class Provenance(TypedDict):
    """The commit and the machine that produced a result."""

    commit: str
    host: str
    cpus: int | None
    python: str


def provenance() -> Provenance:
    """Return the commit and the machine of this process."""
    python = ".".join(map(str, sys.version_info[:3]))
    return {"commit": git_commit(), "host": os.uname().nodename, "cpus": os.cpu_count(), "python": python}


def git_commit() -> str:
    """Return the commit, with "-dirty" appended if tracked files differ from it; "unknown" without git."""
    commit = _git("rev-parse", "HEAD")
    if commit is None:
        return "unknown"
    return f"{commit}-dirty" if _git("status", "--porcelain", "--untracked-files=no") else commit


def _git(*arguments: str) -> str | None:
    """Return the output of a git command, or None without git or a repository."""
    try:
        command = ["git", "-C", str(REPOSITORY), *arguments]
        result = subprocess.run(  # noqa: S603  own words, no shell
            command, capture_output=True, text=True, timeout=20, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return result.stdout.strip()


def command() -> str:
    """Return the running command, without local paths and without the words in `PLACES`."""
    words = [
        re.sub(r"(?<![\w/.-])(?:\.\.)?/[^\s,\]]*/", "", word)  # paths inside the repository remain
        for word in sys.argv[1:]
        if not word.lstrip("+").startswith(PLACES)
    ]
    return f"python -m platform.launch {shlex.join(words)}"


def today() -> str:
    """Return the date, UTC."""
    return datetime.now(UTC).strftime("%Y-%m-%d")
