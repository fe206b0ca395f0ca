"""Remove what a command has created before its settings were rejected, so that nothing is left behind."""

import contextlib
from collections.abc import Callable

_made: list[Callable[[], object]] = []


def undo_if_refused(remove: Callable[[], object]) -> None:
    """Register a function that removes something just created that holds no result yet."""
    _made.append(remove)


def keep_what_was_made() -> None:
    """Forget all registered functions, because there are results now."""
    _made.clear()


def undo() -> None:
    """Call the registered functions, the newest first; ignore their errors."""
    while _made:
        with contextlib.suppress(Exception):
            _made.pop()()
