"""An end for what hangs: a process that takes too long is ended, so that another can try again."""

import contextlib
import faulthandler
from collections.abc import Iterator


@contextlib.contextmanager
def ending_after(seconds: float) -> Iterator[None]:
    """End this process, with a traceback in its log, if the block takes longer.

    A kernel that hangs holds the interpreter, and no exception gets through to it: the
    watching thread is none of Python's. One block at a time, and not from within another.
    """
    faulthandler.dump_traceback_later(seconds, exit=True)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()
