"""Ends a job whose Ray has lost its head: Ray would leave without saying what to do, or wait."""

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator

# Ray waits 60 s for a head that is gone, and then ends the process in the middle of what it does.
SILENCE_S = 40.0
ASK_EVERY_S = 5.0
LEAVE_S = 10.0  # to close what is open; what waits for Ray may wait forever


class HeadLostError(RuntimeError):
    """The head of the cluster does not answer; the message says so in one line, and what to do."""


@contextlib.contextmanager
def watching_head(ask: Callable[[float], bool] | None = None) -> Iterator[None]:
    """Stop the block, which runs in the main thread, if Ray's head is silent for `SILENCE_S`.

    Args:
        ask: Whether the head answers within so many seconds; None for that of the running Ray.

    Raises:
        HeadLostError: The head was silent so long.
    """
    watch = _Watch(ask or head_answers)
    threading.Thread(target=watch.run, name="head-watch", daemon=True).start()
    try:
        yield
    except KeyboardInterrupt:
        if not watch.lost.is_set():
            raise
        watch.told.set()
        raise HeadLostError(reason()) from None
    finally:
        watch.over.set()


def head_answers(seconds: float) -> bool:
    """Whether the head of the running Ray answers in time; each request is repeated until then."""
    from ray._private.worker import global_worker

    try:
        global_worker.gcs_client.internal_kv_exists(b"", None, timeout=seconds)
    except Exception:  # of several types, and a client that is closed has none at all
        return False
    return True


def reason() -> str:
    """What to say of a head that is lost."""
    return (
        f"Ray's head has not answered for {SILENCE_S:.0f} s: its process, its machine or the network to it "
        "is lost; once there is a cluster again, the same command continues"
    )


class _Watch:
    def __init__(self, ask: Callable[[float], bool]) -> None:
        self.ask = ask
        self.over, self.lost, self.told = threading.Event(), threading.Event(), threading.Event()

    def run(self) -> None:
        while not self.over.wait(ASK_EVERY_S):
            if self._is_silent() and not self.over.is_set():
                self._stop()
                return

    def _is_silent(self) -> bool:
        """Whether it does not answer, asked at least twice: everything may have been stopped for a while."""
        began = time.monotonic()
        while time.monotonic() - began < SILENCE_S:
            if self.ask(SILENCE_S / 2):
                return False
            time.sleep(0.5)
        return True

    def _stop(self) -> None:
        self.lost.set()
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
        time.sleep(LEAVE_S)
        if not self.told.is_set():
            sys.stderr.write(f"evade: failed: {reason()}\n")
            sys.stderr.flush()
        os._exit(1)
