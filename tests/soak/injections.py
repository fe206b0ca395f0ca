"""The faults of a soak: what each does to the running jobs, and what must follow.

A function does harm and ends it again; it returns the lanes whose work must go on, or None where the
fault cannot happen now (no such process, no checkpoint yet).
"""

import dataclasses
import os
import random
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Protocol

from tests.soak.dashboard import Dashboard
from tests.soak.workload import KILLED_S, Lane
from tests.support.faults import command_line, cut, fill, flip

GOES_ON = "the jobs go on"
COMMAND = "the printed command continues"
EITHER = "goes on, or stops with a reason and the printed command continues"
HOG_BYTES, HOG_SHARE = 2 << 30, 0.25  # at most so much memory, and so much of what is free
HOG = "import sys, time; block = b'1' * int(sys.argv[1]); time.sleep(60)"


class Soak(Protocol):
    """What an injection needs of the soak."""

    rng: random.Random
    lanes: dict[str, Lane]
    dashboard: Dashboard
    disk: Path | None
    temp: Path
    findings: list[str]

    def run_for(self, seconds: float) -> None:
        """Look after the jobs for some time [s]."""


Lanes = list[Lane] | None


@dataclasses.dataclass(frozen=True)
class Fault:
    """A fault, the function that injects it, and what must follow."""

    name: str
    inject: Callable[[Soak], Lanes]
    follows: str


def signalled(mark: str, number: signal.Signals) -> Callable[[Soak], Lanes]:
    """A signal to one process, in any lane, whose command line has `mark`."""

    def inject(soak: Soak) -> Lanes:
        found = [(lane, pid) for lane in soak.lanes.values() for pid in lane.processes(mark)]
        if not found:
            return None
        lane, pid = soak.rng.choice(found)
        os.kill(pid, number)
        return [lane]

    return inject


def working(soak: Soak) -> list[Lane]:
    """The lanes with a job at work that has said how it continues."""
    return [lane for lane in soak.lanes.values() if lane.working and "continues with" in lane.job.said]


@contextmanager
def down(soak: Soak, lane: Lane, number: signal.Signals = signal.SIGKILL) -> Iterator[None]:
    """A driver ended by a signal, with all that it started; its command is given again after the block."""
    lane.held = True
    try:
        left = [command_line(pid)[:60].strip() for pid in lane.kill(number)]
        if left:
            what = f"outlive the driver of the {lane.name} by {KILLED_S:.0f} s"
            soak.findings.append(f"{what}: {', '.join(left)}")
        yield
        if lane.job.process.returncode != 0:  # it may have been complete just then
            lane.note_end(lane.job.process.returncode, by_fault=True)
            lane.again()
    finally:
        lane.held = False


def kill_driver(soak: Soak) -> Lanes:
    """SIGKILL to a driver."""
    lane = soak.rng.choice(working(soak) or [None])
    if lane is None:
        return None
    with down(soak, lane):
        return [lane]


def interrupt_driver(soak: Soak) -> Lanes:
    """Ctrl+C to a driver, whose exit status must be 130."""
    lane = soak.rng.choice(working(soak) or [None])
    if lane is None:
        return None
    with down(soak, lane, signal.SIGINT):
        status = lane.job.process.returncode
        if status not in (130, 0):
            soak.findings.append(f"Ctrl+C of the {lane.name} ended with status {status}, not 130")
        return [lane]


def stop_process(soak: Soak) -> Lanes:
    """SIGSTOP to a driver or one of its workers for 20 s, then SIGCONT."""
    found = [
        (lane, pid) for lane in working(soak) for pid in [lane.job.process.pid, *lane.processes("ray::")]
    ]
    if not found:
        return None
    lane, pid = soak.rng.choice(found)
    os.kill(pid, signal.SIGSTOP)
    soak.run_for(20.0)
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGCONT)
    return [lane]


def kill_dashboard(soak: Soak) -> Lanes:
    """The MLflow server killed, and started again after ten seconds."""
    soak.dashboard.kill()
    soak.run_for(10.0)
    soak.dashboard.start()
    return working(soak)


def stop_dashboard(soak: Soak) -> Lanes:
    """The MLflow server stopped for 30 s."""
    soak.dashboard.signal(signal.SIGSTOP)
    soak.run_for(30.0)
    soak.dashboard.signal(signal.SIGCONT)
    return working(soak)


def checkpoint_harmed(harm: Callable[[Path], None]) -> Callable[[Soak], Lanes]:
    """The driver of the training killed, and its two newest checkpoints harmed before it continues."""

    def inject(soak: Soak) -> Lanes:
        lane = soak.lanes["training"]
        if lane not in working(soak) or len(checkpoints(lane)) < 3 or trained(lane):
            return None
        with down(soak, lane):
            if len(checkpoints(lane)) >= 3:  # the kill may have come before the newest was named
                for path in checkpoints(lane)[-2:]:
                    harm(max(path.rglob("*.pkl"), key=lambda file: file.stat().st_size))
            return [lane]

    return inject


def checkpoints(lane: Lane) -> list[Path]:
    """The checkpoints of its training, the newest last."""
    return sorted(lane.place.glob("runs/*/train/PPO*/checkpoint_*"))


def trained(lane: Lane) -> bool:
    """Whether its training has ended, and the evaluation is at work."""
    return any(lane.place.glob("runs/*/stages/train.json"))


def cut_episodes(soak: Soak) -> Lanes:
    """A driver killed, and one of its files of episodes cut before it continues."""
    found = [lane for lane in working(soak) if list(lane.place.glob("runs/*/*/episodes/*.json"))]
    if not found:
        return None
    lane = soak.rng.choice(found)
    with down(soak, lane):
        files = sorted(lane.place.glob("runs/*/*/episodes/*.json"))
        if files:
            cut(soak.rng.choice(files))
        return [lane]


def fill_disk(soak: Soak) -> Lanes:
    """No room for 20 s where the runs are; commands are given again when there is."""
    if soak.disk is None:
        return None
    lanes = working(soak)
    for lane in soak.lanes.values():
        lane.held = True
    filler = fill(soak.disk)
    try:
        soak.run_for(20.0)
    finally:
        filler.unlink()
        for lane in soak.lanes.values():
            lane.held = False
    return lanes


def lock_store(soak: Soak) -> Lanes:
    """The SQLite file behind the dashboard locked for 30 s."""
    lock = sqlite3.connect(soak.dashboard.store, timeout=30.0, isolation_level=None)
    try:
        lock.execute("BEGIN EXCLUSIVE")
        soak.run_for(30.0)
    finally:
        lock.close()
    return working(soak)


def jump_clock(soak: Soak) -> Lanes:
    """The clock jumps by up to a day, to or fro."""
    (soak.temp / "clock").write_text(str(soak.rng.uniform(-86400.0, 86400.0)))
    soak.run_for(5.0)
    return working(soak)


def hog_memory(soak: Soak) -> Lanes:
    """A process beside the jobs takes a quarter of the free memory, at most 2 GiB, for 20 s."""
    meminfo = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
    free = int(meminfo["MemAvailable"].split()[0]) << 10
    size = int(min(HOG_BYTES, HOG_SHARE * free))
    hog = subprocess.Popen([sys.executable, "-c", HOG, str(size)])
    try:
        soak.run_for(20.0)
    finally:
        hog.kill()
        hog.wait()
    return working(soak)


FAULTS = (
    Fault("env runner killed", signalled("ray::PlainEnvRunner", signal.SIGKILL), GOES_ON),
    Fault("sweep worker killed", signalled("ray::ImplicitFunc", signal.SIGKILL), GOES_ON),
    Fault("raylet killed", signalled("/raylet/raylet", signal.SIGKILL), EITHER),
    Fault("gcs_server killed", signalled("/gcs/gcs_server", signal.SIGKILL), EITHER),
    Fault("driver killed", kill_driver, COMMAND),
    Fault("Ctrl+C", interrupt_driver, COMMAND),
    Fault("a process stopped for 20 s", stop_process, GOES_ON),
    Fault("dashboard killed, started again after 10 s", kill_dashboard, GOES_ON),
    Fault("dashboard stopped for 30 s", stop_dashboard, GOES_ON),
    Fault("checkpoints truncated while the driver is down", checkpoint_harmed(cut), COMMAND),
    Fault("a bit of the checkpoints flipped while the driver is down", checkpoint_harmed(flip), COMMAND),
    Fault("stored episodes truncated while the driver is down", cut_episodes, COMMAND),
    Fault("disk full for 20 s", fill_disk, EITHER),
    Fault("SQLite store locked for 30 s", lock_store, GOES_ON),
    Fault("clock jumps", jump_clock, GOES_ON),
    Fault("memory taken for 20 s", hog_memory, GOES_ON),
)
