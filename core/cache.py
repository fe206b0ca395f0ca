"""Choose numba's cache folder if neither the folder of the sources nor the user's home is writable."""

import hashlib
import os
import stat
import sys
import tempfile
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"
ROOMS = ("core", "envs", "models")


def choose_cache(folder: Path) -> None:
    """Set NUMBA_CACHE_DIR to a private temporary folder, unless numba has a better place.

    If root owns the installation and the home is not writable (docker run --user, Kubernetes), numba has no
    place for its cache: it would raise an error, or fill a folder named `~`. Child processes inherit the
    choice.

    Args:
        folder: The folder that holds the packages of `ROOMS`.
    """
    if os.environ.get(VARIABLE) or os.access(folder / "envs", os.W_OK) or _home_is_usable():
        return
    cache = _private_folder() / f"kernels-{_digest(folder)}"
    cache.mkdir(exist_ok=True)
    os.environ[VARIABLE] = str(cache)
    if config := sys.modules.get("numba.core.config"):  # it has read the environment already
        config.CACHE_DIR = str(cache)  # type: ignore[attr-defined]


def _home_is_usable() -> bool:
    """Whether the user's cache folder, or its nearest existing parent, is writable."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")  # noqa: PTH111, PTH118
    path = Path(home)
    if not path.is_absolute():
        return False
    there = next(place for place in (path, *path.parents) if place.exists())
    return there.is_dir() and os.access(there, os.W_OK)


def _private_folder() -> Path:
    """Return a temporary folder private to this user, because numba unpickles the files in its cache."""
    folder = Path(tempfile.gettempdir(), f"evade-{os.getuid()}")
    folder.mkdir(mode=0o700, exist_ok=True)
    info = folder.lstat()
    if stat.S_ISDIR(info.st_mode) and info.st_uid == os.getuid() and not info.st_mode & 0o077:
        return folder
    return Path(tempfile.mkdtemp(prefix="evade-"))


def _digest(folder: Path) -> str:
    """Return a hash of the kernels' sources. numba itself does not notice a changed callee."""
    files = sorted(path for room in ROOMS for path in (folder / room).rglob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[:12]
