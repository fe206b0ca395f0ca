"""Errors that Tune writes about a trial whose process ended."""

import re
from pathlib import Path

FAILURE = re.compile(r"^Failure # \d+ .*$", re.MULTILINE)  # starts each error that Tune writes about a trial
LOW_MEMORY = re.compile(r"low on memory\. Memory on the node .*? was (\S+) used / (\S+) limit", re.DOTALL)


def newest_error(file: str | None) -> str:
    """Return the newest error that Tune has written about a trial, as text; empty if there is none.

    Tune also pickles the error itself, but in a place where another user of the machine may write.
    """
    if file is None or not Path(file).is_file():
        return ""
    return FAILURE.split(Path(file).read_text())[-1].strip()


def low_memory(error: str) -> str | None:
    """Return a message if an error says that Ray's memory monitor ended a process; else None.

    The monitor ends processes before the kernel does: when more of the machine's memory is in use than
    RAY_memory_usage_threshold (95 % by default).
    """
    found = LOW_MEMORY.search(error)
    if found is None:
        return None
    return f"by Ray, for lack of memory: {found[1]} of {found[2]} in use"
