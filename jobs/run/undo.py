"""Remove what a command has made before it is refused, so that a refusal leaves nothing behind."""

import contextlib
from collections.abc import Callable

_made: list[Callable[[], object]] = []


def undo_if_refused(remove: Callable[[], object]) -> None:
    """Remember how to remove something that was just made and holds no result yet."""
    _made.append(remove)


def keep_what_was_made() -> None:
    """Forget all of it, because there are results now."""
    _made.clear()


def undo() -> None:
    """Remove what was made, the newest first. What cannot be removed stays."""
    while _made:
        with contextlib.suppress(Exception):
            _made.pop()()
