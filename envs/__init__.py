"""The world: scenes, renderers, the event camera, and the environment made of them."""

from pathlib import Path


def _forget_stale_kernels() -> None:
    """Delete kernels that numba has kept from before the newest source file.

    numba looks at the file of a kernel alone, not at those whose kernels it calls: after an
    edit there, it would go on with what it has compiled from the old ones.
    """
    folder = Path(__file__).parent
    newest = max(path.stat().st_mtime_ns for path in folder.glob("*.py"))
    for kept in (folder / "__pycache__").glob("*.nbi"):
        try:
            if kept.stat().st_mtime_ns < newest:
                kept.unlink()
        except OSError:  # another process was faster, or the folder is not ours: numba then decides
            continue


_forget_stale_kernels()
