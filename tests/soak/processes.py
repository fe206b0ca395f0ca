"""The processes below this one: who they are, what they hold, and how all of them are ended."""

import contextlib
import ctypes
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from tests.support.faults import command_line, descendants

SUBREAPER = 36  # prctl's: processes whose parents have ended become children of this one
PAGE = os.sysconf("SC_PAGE_SIZE")
ROLES = {
    "/raylet/raylet": "raylet",
    "/gcs/gcs_server": "gcs_server",
    "ray::PlainEnvRunner": "env runner",
    "ray::ImplicitFunc": "sweep worker",
    "ray::PPO": "learner",
    "platform.launch": "driver",
    "ray::": "other of Ray",
    "/ray/": "other of Ray",
}


class Sample(NamedTuple):
    """One process at one moment: resident memory [MB] and open files."""

    pid: int
    role: str
    rss_mb: float
    files: int


def adopt_orphans() -> None:
    """Become the parent of every process below whose own parent has ended, so that none is lost."""
    ctypes.CDLL(None, use_errno=True).prctl(SUBREAPER, 1, 0, 0, 0)


def role_of(pid: int) -> str:
    """What a process is, by its command line."""
    line = command_line(pid)
    return next((role for mark, role in ROLES.items() if mark in line), "other")


def reap(known: set[int]) -> None:
    """Bury the adopted children that have ended; those in `known` have somebody who waits for them."""
    for pid in children():
        if pid not in known and state(pid) == "Z":
            with contextlib.suppress(ChildProcessError):
                os.waitpid(pid, os.WNOHANG)


def children() -> list[int]:
    """The direct children of this process."""
    found = []
    for task in Path("/proc/self/task").iterdir():
        with contextlib.suppress(OSError):
            found += [int(pid) for pid in (task / "children").read_text().split()]
    return found


def state(pid: int) -> str:
    """A process's state as one letter, Z for one that has ended; empty if it has gone."""
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    return ""


def living(pids: Iterator[int] | list[int]) -> list[int]:
    """Those that have not ended."""
    return [pid for pid in pids if state(pid) not in ("", "Z")]


def samples(dashboard: int | None) -> list[Sample]:
    """All processes of the soak; those below `dashboard` are its server's."""
    served = {dashboard, *descendants(dashboard)} if dashboard else set()
    found = []
    for pid in [os.getpid(), *descendants(os.getpid())]:
        role = "soak" if pid == os.getpid() else "mlflow server" if pid in served else role_of(pid)
        with contextlib.suppress(OSError, ValueError, IndexError):
            rss = int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * PAGE / 1e6
            found.append(Sample(pid, role, rss, len(list(Path(f"/proc/{pid}/fd").iterdir()))))
    return found


def shared_memory() -> set[str]:
    """Files of /dev/shm that processes of the soak have open."""
    found = set()
    for pid in descendants(os.getpid()):
        with contextlib.suppress(OSError):
            links = [str(link.readlink()) for link in Path(f"/proc/{pid}/fd").iterdir()]
            found |= {link for link in links if link.startswith("/dev/shm/") and "(deleted)" not in link}
    return found


def end_all(patience_s: float = 20.0) -> None:
    """Kill everything below this process, and bury it."""
    deadline = time.monotonic() + patience_s
    while time.monotonic() < deadline and list(descendants(os.getpid())):
        for pid in living(descendants(os.getpid())):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)
                os.kill(pid, signal.SIGKILL)
        reap(set())
        time.sleep(0.1)
