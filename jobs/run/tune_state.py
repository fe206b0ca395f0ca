"""Back up Tune's state of a training: Tune overwrites its file in place, and a full disk truncates it."""

import json
from pathlib import Path

from jobs.run.files import write_atomic

STATES = "experiment_state-*.json"  # files of Tune, one per command; it reads the newest
KEPT = "kept_state.json"  # does not match `STATES`, so Tune ignores it


def keep_state(experiment: Path) -> None:
    """Copy the newest state of an experiment, if it is intact, to a file that is written atomically."""
    states = sorted(experiment.glob(STATES))
    if states and _is_whole(states[-1]):
        write_atomic(experiment / KEPT, states[-1].read_bytes())


def mend_state(experiment: Path) -> str | None:
    """Replace truncated states by the copy; return a message, None if nothing was done.

    Without a copy, the training continues from an older state or starts again, with the same results.
    """
    damaged = [path for path in sorted(experiment.glob(STATES)) if not _is_whole(path)]
    if not damaged:
        return None
    kept = experiment / KEPT
    if _is_whole(kept):
        write_atomic(damaged[-1], kept.read_bytes())
        done = "the one before takes its place"
    else:
        damaged[-1].unlink()
        done = "the training continues from an older state, or starts again"
    for path in damaged[:-1]:
        path.unlink()
    return f"State of the training damaged, {done}: {damaged[-1]}"


def _is_whole(file: Path) -> bool:
    try:
        return isinstance(json.loads(file.read_bytes()), dict)
    except (FileNotFoundError, ValueError):
        return False
