"""From events to actions: embedding, event VAE, lookup table, encoder files, policies."""

import os
import pickle
from pathlib import Path


def _forget_stale_kernels() -> None:
    """Delete compiled kernels that are older than the newest source file of this package, or cut short.

    numba checks the file of a kernel alone, not the files of the kernels that it calls: after an
    edit there, it would go on running the old machine code. It writes the name of a kernel before the
    kernel: a full disk or a kill in between would leave the new name with the old machine code. And it
    raises where a file is empty or ends too early. `envs` and `models` may not import each other, so
    each has this function; a test runs both.
    """
    folder = Path(__file__).parent
    newest = max(path.stat().st_mtime_ns for path in folder.rglob("*.py"))
    for compiled in folder.rglob("__pycache__/*.nb[ci]"):
        try:
            if compiled.stat().st_mtime_ns < newest or not _is_whole(compiled):
                compiled.unlink()
        except OSError:  # another process was faster, or the folder is not ours: numba then decides
            continue


def _is_whole(compiled: Path) -> bool:
    """Whether a file, which is a pickle, has its end."""
    with compiled.open("rb") as file:
        try:
            file.seek(-1, os.SEEK_END)
        except OSError:  # empty
            return False
        return file.read(1) == pickle.STOP


_forget_stale_kernels()
