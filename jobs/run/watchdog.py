"""Limit the time of work that may hang: end the process, so that another process can retry."""

import contextlib
import faulthandler
from collections.abc import Iterator


@contextlib.contextmanager
def ending_after(seconds: float) -> Iterator[None]:
    """End this process, with a traceback in its log, if the block takes longer.

    A kernel that hangs holds the interpreter's lock, so no exception can reach it; the watching thread is
    therefore not a Python thread. Blocks cannot be nested.
    """
    faulthandler.dump_traceback_later(seconds, exit=True)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()
