"""Let SIGTERM and SIGHUP end a job as Ctrl+C does: one message, runs marked as killed, Ray stopped."""

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType

# docker stop, Slurm and Kubernetes send SIGTERM, a closing terminal sends SIGHUP.
ENDING = (signal.SIGTERM, signal.SIGHUP)


_received: list[int] = []  # signals of `ENDING`, since `end_on_signals`


class Ended(KeyboardInterrupt):
    """The process was asked to end by the signal `number`."""

    def __init__(self, number: int) -> None:
        self.number = number
        super().__init__(signal.Signals(number).name)


def signal_of(error: KeyboardInterrupt) -> int:
    """Return the number of the signal that raised an error; SIGINT if none of `ENDING` was received.

    Ray catches `Ended` while it waits in C++ and raises a plain KeyboardInterrupt in its place.
    """
    return error.number if isinstance(error, Ended) else (_received or [signal.SIGINT])[-1]


def end_on_signals() -> None:
    """Raise `Ended` in the main thread on SIGTERM and SIGHUP; an ignored signal (nohup) stays ignored."""
    if threading.current_thread() is threading.main_thread():
        _received.clear()
        for number in ENDING:
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, _end)


@contextlib.contextmanager
def keeping_handlers() -> Iterator[None]:
    """Restore the handlers of this process after a block: Ray replaces them when it starts."""
    before = {number: signal.getsignal(number) for number in ENDING}
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            for number, handler in before.items():
                if callable(handler):
                    signal.signal(number, handler)


def _end(number: int, frame: FrameType | None) -> None:
    _received.append(number)
    raise Ended(number)
