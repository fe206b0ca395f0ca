"""The world: scenes, renderers, the event camera, and the environment made of them."""

from pathlib import Path


def _forget_stale_kernels() -> None:
    """Delete compiled kernels that are older than the newest source file of this package.

    numba checks the file of a kernel alone, not the files of the kernels that it calls: after an
    edit there, it would go on running the old machine code. `envs` and `models` may not import
    each other, so each has this function; a test runs both.
    """
    folder = Path(__file__).parent
    newest = max(path.stat().st_mtime_ns for path in folder.rglob("*.py"))
    for compiled in folder.rglob("__pycache__/*.nbi"):
        try:
            if compiled.stat().st_mtime_ns < newest:
                compiled.unlink()
        except OSError:  # another process was faster, or the folder is not ours: numba then decides
            continue


_forget_stale_kernels()
