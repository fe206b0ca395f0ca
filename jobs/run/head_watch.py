"""End a job if its Ray loses the head or its node. Ray itself would exit without advice, or wait forever."""

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from types import FrameType

from jobs.run.signals import ENDING, signal_of

# Ray waits 60 s for a lost head, and then ends the process without any cleanup.
SILENCE_S = 40.0
ASK_EVERY_S = 5.0
LOOK_EVERY_S = 0.2  # for ended processes of Ray, after which Ray ends this one within seconds
ESSENTIAL = ("raylet", "gcs_server")
LEAVE_S = 10.0  # for cleanup; calls that wait for Ray may never return


class HeadLostError(RuntimeError):
    """The head of the cluster does not answer; the message says in one line what to do."""


@contextlib.contextmanager
def watching_head() -> Iterator[None]:
    """Stop the block, which runs in the main thread, if Ray's head is silent for `SILENCE_S` or Ray ends.

    Raises:
        HeadLostError: The head was silent for `SILENCE_S`, or a process of Ray has ended.
    """
    watch = _Watch()
    threading.Thread(target=watch.run, name="head-watch", daemon=True).start()
    try:
        with _heard(watch.lost):
            yield
    except KeyboardInterrupt as error:
        if signal_of(error) in ENDING or not watch.lost.is_set():
            raise
        watch.told.set()
        raise HeadLostError(watch.reason) from None
    finally:
        watch.over.set()


@contextlib.contextmanager
def _heard(lost: threading.Event) -> Iterator[None]:
    """Let SIGINT interrupt the block once the head is lost, even if this process ignores SIGINT.

    A command that a script starts in the background ignores SIGINT, and still does until the head is lost.
    """
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        yield
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        if lost.is_set():
            signal.default_int_handler(number, frame)

    signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def head_answers(seconds: float) -> bool:
    """Whether the head of the running Ray answers in time; Ray repeats the request until then."""
    from ray._private.worker import global_worker

    try:
        global_worker.gcs_client.internal_kv_exists(b"", None, timeout=seconds)
    except Exception:  # of several types; after a shutdown there is no client
        return False
    return True


def ended_process() -> str:
    """Return which of the `ESSENTIAL` processes that this process started has ended; "" if none."""
    from ray._private import worker

    node = worker._global_node
    dead = [] if node is None else [name for name, _ in node.dead_processes()]
    return next((name for name in ESSENTIAL if name in dead), "")


CONTINUES = "the same command continues"


class _Watch:
    def __init__(self) -> None:
        self.reason = ""
        self.over, self.lost, self.told = threading.Event(), threading.Event(), threading.Event()

    def run(self) -> None:
        asked_s = time.monotonic()
        while not self.over.wait(LOOK_EVERY_S):
            due = time.monotonic() - asked_s > ASK_EVERY_S
            self.reason = self._lost() if due or ended_process() else ""
            if self.reason and not self.over.is_set():
                self._stop()
                return
            asked_s = time.monotonic() if due else asked_s

    def _lost(self) -> str:
        """Return why the job cannot continue; "" if it can.

        The head is asked at least twice, because the whole machine may have been suspended for a while.
        """
        began = time.monotonic()
        while time.monotonic() - began < SILENCE_S:
            name = ended_process()
            if name:
                return f"Ray's process {name} has ended: it was killed, or crashed; {CONTINUES}"
            if head_answers(SILENCE_S / 2):
                return ""
            time.sleep(0.5)
        return (
            f"Ray's head has not answered for {SILENCE_S:.0f} s: its process, its machine or the network to "
            f"it is lost; once there is a cluster again, {CONTINUES}"
        )

    def _stop(self) -> None:
        self.lost.set()
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
        time.sleep(LEAVE_S)
        if not self.told.is_set():
            sys.stderr.write(f"evade: failed: {self.reason}\n")
            sys.stderr.flush()
        os._exit(1)
