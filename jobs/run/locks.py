"""Locks between processes. A lock is released when its process ends, even if it is killed."""

import contextlib
import os
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from core.files import naming
from jobs.run.files import RunError
from jobs.run.progress import console


@contextlib.contextmanager
def locked(file: Path, waiting: str = "") -> Iterator[None]:
    """Hold a lock file, created if missing; while another process holds it, print `waiting` and wait."""
    file.parent.mkdir(parents=True, exist_ok=True)
    try:
        lock = FileLock(file).acquire(blocking=False)
    except Timeout:
        if waiting:
            console.print(waiting)
        lock = FileLock(file).acquire()
    with lock:
        yield


@contextlib.contextmanager
def held_alone(folder: Path) -> Iterator[None]:
    """Lock a folder for this process: two processes would do the work twice and mix their results.

    Raises:
        RunError: Another process holds the folder; the message names it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / ".lock"
    try:
        lock = FileLock(file).acquire(blocking=False)
    except Timeout:
        holder = file.read_text(errors="replace") or "another process"
        raise RunError(f"{folder}: {holder} works there; wait until it has ended") from None
    with lock:
        with naming(file):
            file.write_text(f"process {os.getpid()} of {os.uname().nodename}")
        yield


def private_folder(place: str | None = None) -> Path:
    """Return a temporary folder that no other user can read or fill with links; create it if it is missing.

    Args:
        place: Its parent folder; None: the system's temporary folder.

    Raises:
        RunError: The folder belongs to someone else, or others may enter it.
    """
    folder = Path(place or tempfile.gettempdir(), f"evade-{os.getuid()}")
    with contextlib.suppress(FileExistsError):  # it may be a link of another user: checked below
        folder.mkdir(mode=0o700)
    info = folder.lstat()
    if not stat.S_ISDIR(info.st_mode) or info.st_uid != os.getuid() or info.st_mode & 0o077:
        found = f"mode {stat.S_IMODE(info.st_mode):04o} of user {info.st_uid}"
        raise RunError(f"{folder}: must be a folder that its owner alone can enter, got {found}; delete it")
    return folder
