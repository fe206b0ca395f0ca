"""Training, sweep and dashboard together for an hour, with a fault every minute.

Run: make test-soak ARGS="minutes=60 seed=0", or python -m tests.soak.soak
Expect: an undisturbed round first (some minutes), then the hour, then the end of the last rounds; a
report and its numbers in `build/soak`; exit status 1 if a table differs, a job does not go on, or anything is
left behind. `size=small` computes less in each round, `every=30` injects a fault every 30 s, and
`only=driver,Ctrl` injects only faults whose names have one of these words.
"""

import contextlib
import dataclasses
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from filelock import FileLock, Timeout

from tests.soak import workload
from tests.soak.dashboard import Dashboard
from tests.soak.injections import EITHER, FAULTS, Fault, down
from tests.soak.processes import adopt_orphans, end_all, living, reap
from tests.soak.report import Event, Summary, markdown
from tests.soak.watch import Watch, size_mb, slope_mb_per_hour
from tests.soak.workload import End, Lane
from tests.support.faults import descendants

GOING_ON_S = 420.0  # after a fault; a server that was away, and a Ray that starts again, take minutes
ROUND_S = 1800.0  # of an undisturbed round, at most, and until the last rounds are complete
DISK_MIB = 256  # of the file system that the runs are on
MAX_SLOPE_MB_PER_HOUR = 60.0  # of the processes that live long
MAX_SOCKETS = 2  # of the last job of each kind; the next Ray that starts removes those of all that have ended
LONG_LIVED = ("driver", "mlflow server", "soak")


class Soak:
    """The jobs, their dashboard, and what is known of them.

    Attributes:
        temp: Temporary files of the jobs, their logs and their clock.
        disk: A small file system for the runs; None where mounting is not permitted.
        findings: What must not be, one line each.
    """

    def __init__(self, folder: Path, size: workload.Size, seed: int, faults: Sequence[Fault]) -> None:
        """Set up everything in `folder`, which is private; nothing runs yet."""
        self.faults = faults
        self.rng, self.findings = random.Random(seed), []
        self.temp, self.runs = folder / "t", folder / "runs"
        self.temp.mkdir(mode=0o700)
        self.runs.mkdir()
        self.disk = self.runs if mounted(self.runs) else None
        self.dashboard = Dashboard(folder / "store")
        words = {
            "training": (workload.training(size), workload.training_tables),
            "sweep": (workload.sweep(size), workload.sweep_tables),
        }
        tracked = f"tracking.uri={self.dashboard.uri}"
        self.lanes = {
            name: Lane(name, [*lane_words, tracked], tables, self.runs, self.temp)
            for name, (lane_words, tables) in words.items()
        }
        folders = {"runs": self.runs, "store": self.dashboard.folder, "temp": self.temp}
        self.watch = Watch(folders, self.dashboard)
        self.events: list[Event] = []
        self.bag: list[Fault] = []

    def run_for(self, seconds: float) -> None:
        """Look after the jobs for some time [s]."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            self.poll()
            time.sleep(0.2)

    def poll(self) -> None:
        """Let each lane notice how its job is."""
        for lane in self.lanes.values():
            lane.poll()

    def undisturbed(self) -> None:
        """One round of each job without faults, side by side: what all others must equal."""
        self.dashboard.start()
        self.dashboard.wait()
        self.last_rounds()
        for lane in self.lanes.values():
            if lane.ends or not lane.rounds:
                raise RuntimeError(f"the {lane.name} fails without faults: {lane.ends or lane.job.said}")

    def last_rounds(self) -> None:
        """Complete the rounds that have begun, or one of each, and begin no more."""
        deadline = time.monotonic() + ROUND_S
        for lane in self.lanes.values():
            lane.last = True
            if lane.job is None:
                lane.begin()
        while any(lane.job is not None for lane in self.lanes.values()):
            self.run_for(0.2)
            if time.monotonic() > deadline:
                unfinished = [name for name, lane in self.lanes.items() if lane.job is not None]
                self.findings.append(f"not complete after {ROUND_S:.0f} s: {', '.join(unfinished)}")
                return

    def disturbed(self, minutes: float, every_s: float) -> None:
        """Repeat the jobs, with a fault every so often; then complete the last rounds."""
        self.watch.start()
        for lane in self.lanes.values():
            lane.last = False
            lane.begin()
        end = time.monotonic() + 60 * minutes
        due = time.monotonic() + every_s / 2
        while due < end:
            self.run_for(max(0.0, due - time.monotonic()))
            event = self.inject_one()
            if event is not None:
                self.events.append(event)
                say(event)
            due = max(due + every_s, time.monotonic()) if event else due + 2.0
        self.run_for(end - time.monotonic())
        self.last_rounds()
        self.judge_late()

    def inject_one(self) -> Event | None:
        """Inject the next fault that can happen now; None if none can."""
        if len(self.bag) <= len(self.faults) // 2:  # each in turn, shuffled
            self.bag += self.rng.sample(self.faults, len(self.faults))
        minute = self.watch.minute()
        self.judge_late()
        for fault in self.bag:
            affected = fault.inject(self)
            if affected is not None:
                self.bag.remove(fault)
                seconds = self.until_going_on(affected)
                outcome, well = judged(fault, self.new_ends(), seconds)
                return Event(minute, fault.name, outcome, seconds, well)
        return None

    def new_ends(self) -> list[End]:
        """The ends of jobs that have not been judged so far."""
        return [end for lane in self.lanes.values() for end in lane.new_ends()]

    def judge_late(self) -> None:
        """Jobs that have ended since the last fault was judged: of that fault, later."""
        ends = self.new_ends()
        if ends and self.events:
            last = self.events[-1]
            outcome, well = judged(self.fault(last.fault), ends, last.seconds)
            later = f"{last.outcome}; later {outcome}"
            self.events[-1] = dataclasses.replace(last, outcome=later, well=well and last.well)
            say(self.events[-1])

    def fault(self, name: str) -> Fault:
        """The fault of a name."""
        return next(fault for fault in self.faults if fault.name == name)

    def until_going_on(self, lanes: list[Lane]) -> float | None:
        """How long it takes until all these lanes have new results [s]; None: too long, so they are ended."""
        began, before = time.monotonic(), {lane.name: lane.progress() for lane in lanes}
        waiting = list(lanes)
        while waiting:
            self.run_for(0.2)
            waiting = [lane for lane in waiting if lane.progress() <= before[lane.name]]
            if time.monotonic() - began > GOING_ON_S:
                for lane in waiting:
                    self.findings.append(f"the {lane.name} does not go on: {lane.job.said[-600:]}")
                    with down(self, lane):
                        pass
                return None
        return time.monotonic() - began

    def closing_findings(self) -> list[str]:
        """What is wrong at the end: differing tables, trends, and everything that is left behind."""
        wrong = [
            f"{one.lane} {one.number}: {', '.join(one.differs)} differ from the undisturbed round"
            for lane in self.lanes.values() for one in lane.rounds if one.differs
        ]  # fmt: skip
        wrong += [
            f"memory of {role} grows by {slope:.0f} MB/h" for role, slope in self.slopes().items()
            if role in LONG_LIVED and slope is not None and slope > MAX_SLOPE_MB_PER_HOUR
        ]  # fmt: skip
        return [*wrong, *self.left_behind()]

    def slopes(self) -> dict[str, float | None]:
        """Role -> trend of the memory within its processes [MB/h]."""
        lives = self.watch.lives
        roles = sorted({role for role, _ in lives})
        return {
            role: slope_mb_per_hour([life for (of, _), life in lives.items() if of == role]) for role in roles
        }

    def left_behind(self) -> list[str]:
        """Processes, held locks, sockets, shared memory and temporary files that outlive the jobs."""
        self.dashboard.kill()
        time.sleep(5.0)
        sockets = [str(path) for path in self.temp.rglob("*") if path.is_socket()]
        kinds = {
            "processes": [str(pid) for pid in living(descendants(os.getpid()))],
            "held locks": [str(path) for path in self.temp.parent.rglob("*.lock") if held(path)],
            "sockets of Ray": sockets if len(sockets) > MAX_SOCKETS else [],
            "files in shared memory": [path for path in self.watch.shared if Path(path).exists()],
            "temporary folders": [path.name for path in self.temp.glob("*") if is_rubbish(path)],
        }  # fmt: skip
        return [f"{len(found)} {kind} left: {', '.join(found[:3])}" for kind, found in kinds.items() if found]


def is_rubbish(path: Path) -> bool:
    """Whether a temporary file is none of those that are kept: logs, the clock, Ray's private folder."""
    return not path.name.startswith(("log-", "clock", "differs", f"evade-{os.getuid()}", "torchinductor_"))


def held(path: Path) -> bool:
    """Whether a process holds a lock file."""
    try:
        with FileLock(path, timeout=0):
            return False
    except Timeout:
        return True


def judged(fault: Fault, ends: list[End], seconds: float | None) -> tuple[str, bool]:
    """What followed a fault, in a few words, and whether that is what must follow."""
    if seconds is None:
        return "does not go on", False
    own = [end for end in ends if not end.by_fault]
    unclear = [end for end in own if end.traceback or not end.last_line.startswith("evade: ")]
    if unclear:
        end = unclear[0]
        return f"stopped (status {end.status}) without a clear reason: {short(end)}", False
    if own:
        what = f"stopped: {short(own[0])}; continued by its command"
        return what, fault.follows == EITHER
    return ("continued by its command" if ends else "went on"), True


def short(end: End) -> str:
    """The last line of a job that fits a cell of a table, without the time that Ray writes before it."""
    line = re.sub(r"^\[\d{4}-[^]]*\] ", "", end.last_line)
    return line.replace("|", "/")[:160]


def say(event: Event) -> None:
    """Print what happened, at once."""
    seconds = "-" if event.seconds is None else f"{event.seconds:.0f} s"
    mark = "" if event.well else "   <-- must not be"
    print(
        f"{event.minute:5.1f} min  {event.fault}: {event.outcome}; going on again after {seconds}{mark}",
        flush=True,
    )


def mounted(folder: Path) -> bool:
    """Put a small file system of its own on a folder, if that is permitted."""
    options = ["-t", "tmpfs", "-o", f"size={DISK_MIB}m,mode=0700", "tmpfs"]
    if subprocess.run(["mount", *options, str(folder)], capture_output=True, check=False).returncode == 0:
        return True
    print(
        "A full disk is left out: it needs a small file system, and mounting one is not permitted", flush=True
    )
    return False


@contextlib.contextmanager
def private_place() -> Iterator[Path]:
    """A private temporary folder, with a short name for the sockets in it; the block leaves nothing."""
    folder = Path(tempfile.mkdtemp(prefix="s-"))
    try:
        yield folder
    finally:
        end_all()
        if (folder / "runs").is_mount():
            subprocess.run(["umount", "--lazy", str(folder / "runs")], check=False)
        shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def burying(soak: Soak) -> Iterator[None]:
    """Bury the processes that this one has adopted, in a thread."""
    end = threading.Event()

    def bury() -> None:
        while not end.wait(0.2):
            jobs = [lane.job.process.pid for lane in soak.lanes.values() if lane.job]
            server = soak.dashboard.process
            reap({*jobs, *([server.pid] if server else [])})

    thread = threading.Thread(target=bury, daemon=True)
    thread.start()
    try:
        yield
    finally:
        end.set()
        thread.join()


def stop(number: int, frame: object) -> None:
    """End by SIGTERM as by Ctrl+C."""
    raise KeyboardInterrupt


def main(words: list[str]) -> int:
    """Run the soak; return the exit status."""
    given = {"minutes": "60", "seed": "0", "size": "full", "every": "60", "out": "build/soak", "only": ""}
    unknown = [word for word in words if word.partition("=")[0] not in given]
    if unknown:
        print(f"{unknown[0]}: no such word; known: {', '.join(given)}", file=sys.stderr)
        return 2
    given |= dict(word.split("=", 1) for word in words)
    faults = [fault for fault in FAULTS if any(part in fault.name for part in given["only"].split(","))]
    out = Path(given["out"])
    out.mkdir(parents=True, exist_ok=True)
    signal.signal(signal.SIGTERM, stop)
    adopt_orphans()
    with private_place() as folder:
        soak = Soak(folder, workload.SIZES[given["size"]], int(given["seed"]), faults)
        with burying(soak):
            soak.undisturbed()
            took = {name: f"{lane.rounds[0].seconds:.0f} s" for name, lane in soak.lanes.items()}
            print("Undisturbed:", took, flush=True)
            soak.disturbed(float(given["minutes"]), float(given["every"]))
            soak.watch.stop()
            return close(soak, out, given)


def close(soak: Soak, out: Path, given: dict[str, str]) -> int:
    """Write the report; return 1 if anything is as it must not be."""
    facts = [
        f"The dashboard did not serve its page at {soak.watch.unanswered} of {len(soak.watch.disk)} moments.",
        f"At the end the temporary files of the jobs take {size_mb(soak.temp):.0f} MB.",
    ]
    findings = [*soak.findings, *soak.closing_findings()]
    rounds = [one for lane in soak.lanes.values() for one in lane.rounds]
    summary = Summary(
        float(given["minutes"]), int(given["seed"]), soak.events, rounds, soak.slopes(), findings, facts
    )
    text = markdown(summary)
    soak.watch.write(out)
    (out / "report.md").write_text(text)
    print(text, flush=True)
    wrong = bool(findings) or not all(event.well for event in soak.events)
    return int(wrong)


if __name__ == "__main__":
    if sys.platform != "linux":
        sys.exit("the soak reads /proc and adopts processes by prctl, so it runs on Linux alone")
    try:
        sys.exit(main(sys.argv[1:]))
    except KeyboardInterrupt:
        print("interrupted; everything that was started has been ended", file=sys.stderr)
        sys.exit(130)
