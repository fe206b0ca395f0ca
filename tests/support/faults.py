"""Runs the launcher as a user does, injects a fault into its processes, and keeps the table of outcomes.

A fault is code in a `sitecustomize.py` on the path of the launcher, which every process of its
Ray inherits: it is run after the module that it names is imported, in whichever process.
"""

import contextlib
import csv
import dataclasses
import functools
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from jobs.config.config import parse
from jobs.rollout.executors import run_serially
from jobs.rollout.policies import find_study_policies
from jobs.rollout.scheduler import evaluate_tasks
from jobs.rollout.store import EpisodeStore
from jobs.run.folder import locate_run
from jobs.study.plan import plan_study
from tests.support.configs import compose

ROOT = Path(__file__).resolve().parents[2]
DEADLINE_S = 1200.0  # of one step of a test: a starved machine starts Ray in minutes
TABLE: list[tuple[str, str, str]] = []

# The smallest training: two flights at once, cut after seven steps, 64 steps to a checkpoint.
TRAIN = (
    "+exp=event_columns",
    "job=train",
    "budget=smoke",
    "algo.num_env_runners=1",
    "algo.num_envs_per_env_runner=2",
    "algo.train_batch_size_per_learner=64",
    "algo.minibatch_size=64",
    "algo.num_epochs=1",
    "env.time_limit_s=0.035",
)
SWEEP = (
    "+exp=robustness",
    "budget=smoke",
    "env.time_limit_s=0.2",
    "study.reference=straight",
    "study.trials=2",
)
# Both policies see events, so that each sparsity is a task of its own for each; with two episodes a
# task they are more than a job evaluates without Ray.
SEEING = (
    *SWEEP,
    "~study.axes",
    "+study.axes.sparsity={faults.sparsity:[0.0,0.25,0.5,0.75]}",
    "study.policies=[bytestream-s0,event_set-s0]",
)
TASKS = 4 * 2  # the nominal condition is that of sparsity 0

HOOK = """
import importlib.abc, importlib.machinery, sys, threading
AFTER = {after!r}


class Loader(importlib.abc.Loader):
    def __init__(self, inner):
        self.inner = inner

    def create_module(self, spec):
        return self.inner.create_module(spec)

    def exec_module(self, module):
        self.inner.exec_module(module)
        exec(AFTER[module.__name__], module.__dict__)


class Finder(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name not in AFTER:
            return None
        spec = importlib.machinery.PathFinder.find_spec(name, path)
        spec.loader = Loader(spec.loader)
        return spec


sys.meta_path.insert(0, Finder())
exec({first!r})
"""


def outcome(fault: str, what: str, lost: str) -> None:
    """Add a row to the table that is printed at the end."""
    TABLE.append((fault, what, lost))


@dataclasses.dataclass
class Job:
    """A launcher that is running in a folder of the test's own, or has ended."""

    process: subprocess.Popen
    log: Path
    runs: Path

    @property
    def said(self) -> str:
        """What it has printed so far."""
        return self.log.read_text()

    @property
    def run(self) -> Path:
        """Its run folder."""
        (folder,) = self.runs.iterdir()
        return folder

    def rows(self) -> list[dict]:
        """The results of its training, whole lines."""
        files = list(self.runs.glob("*/train/results.jsonl"))
        lines = files[0].read_text().split("\n")[:-1] if files else []
        return [json.loads(line) for line in lines]

    def steps(self) -> int:
        """How many environment steps its training has reported."""
        rows = self.rows()
        return rows[-1]["env_steps"] if rows else 0

    def kept(self) -> dict[str, list]:
        """The episodes of its sweep that are kept, by cell."""
        files = self.runs.glob("*/study/episodes/*.json")
        return {path.stem: json.loads(path.read_text())["episodes"] for path in files}

    def wait(self, condition: Callable[[], object]) -> None:
        """Wait until something has become true; the job must not end before."""
        deadline = time.monotonic() + DEADLINE_S
        while not condition():
            assert self.process.poll() is None, self.said
            assert time.monotonic() < deadline, self.said
            time.sleep(0.05)

    def end(self) -> int:
        """Wait for its end; the exit status."""
        return self.process.wait(DEADLINE_S)

    def kill_alone(self) -> None:
        """End the launcher by SIGKILL; what it started may live on for some seconds."""
        self.process.kill()
        self.process.wait()

    def kill(self) -> None:
        """End the launcher by SIGKILL, and wait until all that it started has gone with it."""
        below = list(descendants(self.process.pid))
        self.kill_alone()
        deadline = time.monotonic() + DEADLINE_S
        while any(Path(f"/proc/{pid}").exists() for pid in below):
            assert time.monotonic() < deadline, below
            time.sleep(0.1)

    def workers(self, title: str) -> list[int]:
        """Its Ray workers whose title begins so."""
        return [pid for pid in descendants(self.process.pid) if command_line(pid).startswith(title)]

    def printed_command(self) -> list[str]:
        """The command that it said continues it."""
        (line,) = re.findall(r"^If this is stopped, it continues with: (.*)$", self.said, re.MULTILINE)
        return shlex.split(line)


def launch(
    folder: Path, *words: str, first: str = "", after: dict[str, str] | None = None, **variables: str
) -> Job:
    """Start the launcher, with code to run first and after modules are imported, and variables set."""
    place = [f"runs_dir={folder / 'runs'}"]
    return start(folder, [sys.executable, "-m", "platform.launch", *words, *place], first, after, **variables)


def start(
    folder: Path, command: list[str], first: str = "", after: dict[str, str] | None = None, **variables: str
) -> Job:
    """The same from a whole command."""
    path = write_hook(folder, first, after)
    log = Path(variables.get("TMPDIR", folder)) / f"log-{time.monotonic_ns()}"  # not on a disk that fills up
    with log.open("w") as file:
        process = subprocess.Popen(
            command,
            cwd=ROOT,
            env={**environment_for(command), "PYTHONPATH": path, **variables},
            stdout=file,
            stderr=subprocess.STDOUT,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )
    return Job(process, log, folder / "runs")


def environment_for(command: list[str]) -> dict[str, str]:
    """This process's environment, without the token of its cluster for a job that does not join one."""
    joins = "cluster=ray" in command
    return {name: value for name, value in os.environ.items() if joins or not name.startswith("RAY_AUTH")}


def write_hook(folder: Path, first: str = "", after: dict[str, str] | None = None) -> str:
    """Write code for processes to run; the PYTHONPATH with which they run it."""
    hook = folder / "hook"
    hook.mkdir(parents=True, exist_ok=True)
    (hook / "sitecustomize.py").write_text(HOOK.format(after=after or {}, first=first))
    return os.pathsep.join([str(hook), str(ROOT)])


def descendants(pid: int) -> Iterator[int]:
    """All processes below one."""
    parents: dict[int, list[int]] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            text = stat.read_text()
        except OSError:
            continue
        parents.setdefault(int(text.rpartition(")")[2].split()[1]), []).append(int(stat.parent.name))
    below = parents.get(pid, [])
    while below:
        child = below.pop()
        yield child
        below += parents.get(child, [])


@contextlib.contextmanager
def standing_still(pids: Iterable[int]) -> Iterator[list[int]]:
    """Stop processes by SIGSTOP for the length of a block, and continue them."""
    stopped = [pid for pid in pids if signalled(pid, signal.SIGSTOP)]
    assert stopped
    try:
        yield stopped
    finally:
        for pid in stopped:
            signalled(pid, signal.SIGCONT)


def signalled(pid: int, number: int) -> bool:
    """Whether a process was there to be sent a signal."""
    try:
        os.kill(pid, number)
    except ProcessLookupError:
        return False
    return True


def command_line(pid: int) -> str:
    """The command line of a process, which Ray's workers make their title; empty if it has gone."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " ")
    except OSError:
        return ""


# Writes down each episode that a process evaluates, and takes its time.
NOTED = """
import time
whole = evaluate_part
def evaluate_part(part):
    result = whole(part)
    with open({file!r}, "a") as notes:
        for seed in part.task.seeds:
            notes.write(f"{{part.task.key}} {{seed}}\\n")
    time.sleep(1.0)
    return result
"""
# Lets a process take memory until the kernel ends it, in a group whose memory is limited; where no
# such group can be made, the process ends as the kernel would end it.
OUTGROW = """
import os, pathlib
def outgrow():
    group, held = pathlib.Path({group!r}), []
    if not group.is_dir():
        os.kill(os.getpid(), 9)
    (group / "cgroup.procs").write_text(str(os.getpid()))
    while True:
        held.append(bytearray(1 << 24))
"""


def noting(folder: Path) -> dict[str, str]:
    """Code that notes each evaluated episode in a file of a folder."""
    return {"jobs.rollout.executors": NOTED.format(file=str(folder / "episodes"))}


@functools.cache
def expected_episodes() -> dict[str, list]:
    """What a sweep of `SEEING` keeps: evaluated in this process, one task after the other."""
    with tempfile.TemporaryDirectory() as folder:
        config = parse({**compose(*SEEING), "runs_dir": folder})
        store = EpisodeStore(Path(folder) / "study")
        tasks = plan_study(config, find_study_policies(config, locate_run(config))).tasks
        evaluate_tasks(tasks, store, run_serially, measure_accuracy=False)
        files = (Path(folder) / "study" / "episodes").iterdir()
        return {path.stem: json.loads(path.read_text())["episodes"] for path in files}


def check_once(job: Job, notes: Path, again_at_most: int) -> None:
    """The sweep `SEEING` ended well: all episodes, each once, and hardly one evaluated twice.

    Args:
        job: The sweep that ended.
        notes: The folder of `noting`.
        again_at_most: How many episodes may have been evaluated again: those under way at the fault.
    """
    assert job.end() == 0, job.said
    with (job.run / "study" / "episodes.csv").open() as file:
        rows = [tuple(row.values()) for row in csv.DictReader(file)]
    assert len(rows) == len(set(rows))
    assert len(expected_episodes()) == TASKS
    assert job.kept() == expected_episodes()
    evaluated = Counter((notes / "episodes").read_text().splitlines())
    assert len(evaluated) == TASKS * 2
    assert sum(evaluated.values()) - len(evaluated) <= again_at_most


def check_ended_by_kernel(group: Path, times: int) -> None:
    """The kernel has ended so many processes of a group for lack of memory."""
    counters = [group / name for name in ("memory.events", "memory.oom_control")]
    for file in counters:
        if file.is_file():
            assert f"oom_kill {times}" in file.read_text().splitlines()


FINE = ("train.env_steps=960", "train.checkpoint_every=1")
# An hour to and fro, every two seconds.
JUMPS = """
import time
real, begun = time.time, time.monotonic()
time.time = lambda: real() + (3600.0, -3600.0, 0.0)[int(time.monotonic() - begun) // 2 % 3]
"""


def check_second_refused(folder: Path, job: Job) -> None:
    """A second driver of a job's run folder says which process works there, and stops."""
    refused = start(folder, job.printed_command())
    assert refused.end() == 1
    assert f"{job.run}: process {job.process.pid} of " in refused.said
    assert "works there; wait until it has ended" in refused.said


def check_complete(job):
    """A training that has ended well: each step reported once, all there, and a policy that flies."""
    assert job.end() == 0, job.said
    steps = [row["env_steps"] for row in job.rows()]
    assert steps == sorted(set(steps))
    assert steps[-1] >= 960
    from models.policy import load_policy

    load_policy(job.run / "policy")


def forked(folder: Path, *words: str, first: Callable[[], object] = lambda: None) -> tuple[int, str]:
    """Run the launcher in a fork of this process, which has imported most of it: status, and what it says.

    `first` is called in the fork before it. A status below 0 is the signal that ended it.
    """
    with tempfile.TemporaryFile("w+") as log:
        pid = os.fork()
        if pid == 0:
            status = 70
            try:
                for number in (1, 2):
                    os.dup2(log.fileno(), number)
                sys.stdout = sys.stderr = os.fdopen(os.dup(log.fileno()), "w", buffering=1)
                sys.argv = ["launch", *words, f"runs_dir={folder / 'runs'}"]
                first()
                from platform.launch import main

                status = main()
            except BaseException:
                traceback.print_exc()
            finally:
                sys.stdout.flush()
                os._exit(status)
        _, status = os.waitpid(pid, 0)
        log.seek(0)
        return os.waitstatus_to_exitcode(status), log.read()


def leave_room(disk: Path, room: int) -> Path:
    """Fill a small disk so that `room` bytes are left; the file that does."""
    filler = disk / "filler"
    filler.unlink(missing_ok=True)
    state = os.statvfs(disk)
    with filler.open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, max(1, state.f_bavail * state.f_frsize - room))
    return filler


def fill(disk: Path) -> Path:
    """Take all the room of a small disk while others write to it; the file that does."""
    filler = disk / "filler"
    with filler.open("wb", buffering=0) as stream, contextlib.suppress(OSError):
        while True:
            stream.write(b"\0" * (1 << 20))
    return filler


def cut(file: Path) -> None:
    """Take away the last 100 bytes, as a full disk does."""
    file.write_bytes(file.read_bytes()[:-100])


def flip(file: Path) -> None:
    """Change one bit in the middle."""
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
