"""A time limit for work that may hang: the process is ended, so that another can try again."""

import contextlib
import faulthandler
from collections.abc import Iterator


@contextlib.contextmanager
def ending_after(seconds: float) -> Iterator[None]:
    """End this process, with a traceback in its log, if the block takes longer.

    A kernel that hangs holds the interpreter, so that no exception reaches it: the thread that watches
    is not one of Python's. One block at a time; blocks cannot be nested.
    """
    faulthandler.dump_traceback_later(seconds, exit=True)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()
