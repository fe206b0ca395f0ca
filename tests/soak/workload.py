"""What a soak computes again and again, fixed in amount: a training with its evaluation, and a sweep.

A lane repeats one of them. A job of it that ends with an error is given its printed command again, as a
user would; when one is complete, its tables are compared with those of an undisturbed round.
"""

import contextlib
import dataclasses
import hashlib
import json
import shutil
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

from tests.soak.processes import living
from tests.support.faults import Job, command_line, descendants, start

KILLED_S = 150.0  # until nothing of a killed driver is left: Ray's agents look for their server for 60 s
# Reads a jump of the clock from a file, at most once a second.
CLOCK = """
import time
real, looked, jump = time.time, -1.0, 0.0
def jumping():
    global looked, jump
    now = time.monotonic()
    if now - looked > 1.0:
        looked = now
        try:
            with open({file!r}) as file:
                jump = float(file.read())
        except (OSError, ValueError):
            pass
    return real() + jump
time.time = jumping
"""


@dataclasses.dataclass(frozen=True)
class Size:
    """How much a round computes: training steps, episodes of each agent, episodes of each condition."""

    env_steps: int
    episodes: int
    trials: int


SIZES = {"small": Size(10_240, 4, 4), "full": Size(163_840, 10, 20)}


def training(size: Size) -> list[str]:
    """The words of a training that ends with its evaluation; a checkpoint every 1,024 steps."""
    steps = f"train.env_steps={size.env_steps}"
    return [
        "+exp=event_columns", "budget=smoke", steps, "train.checkpoint_every=1", "algo.num_env_runners=1",
        "algo.train_batch_size_per_learner=1024", f"evaluate.episodes={size.episodes}",
        "evaluate.renderers=[raycast]", "evaluate.video=false",
    ]  # fmt: skip


def sweep(size: Size) -> list[str]:
    """The words of a sweep over shipped policies."""
    axis = "+study.axes.sparsity={faults.sparsity:[0.0,0.25,0.5,0.75]}"
    policies = "study.policies=[event_columns,straight]"
    return ["+exp=robustness", "~study.axes", axis, policies, f"study.trials={size.trials}"]


@dataclasses.dataclass(frozen=True)
class Tables:
    """What must repeat to the last digit: whatever was evaluated, and what hangs on the trained policy."""

    evaluated: dict[str, str]
    policy: dict[str, str]

    def differing(self, other: "Tables") -> list[str]:
        """The names of the tables that differ."""
        names = [name for name, text in self.evaluated.items() if other.evaluated.get(name) != text]
        return names if self.policy == other.policy else [*names, "policy"]


def training_tables(run: Path) -> Tables:
    """The evaluation of a training, its policy, and its results without what they took."""
    texts = {name: (run / "eval" / name).read_text() for name in ("table.md", "episodes.csv")}
    rows = [json.loads(line) for line in (run / "train" / "results.jsonl").read_text().splitlines()]
    results = [
        {name: x for name, x in row.items() if not name.startswith(("perf/", "checksum"))} for row in rows
    ]  # without what it took
    digest = hashlib.sha256((run / "policy" / "networks.safetensors").read_bytes()).hexdigest()
    tables = {name: "\n".join(sorted(text.splitlines())) for name, text in texts.items()}
    return Tables(tables, {"results": json.dumps(results), "networks": digest})


def sweep_tables(run: Path) -> Tables:
    """The table of a sweep, and its episodes in order."""
    episodes = sorted((run / "study" / "episodes.csv").read_text().splitlines())
    return Tables(
        {"table.md": (run / "study" / "table.md").read_text(), "episodes.csv": "\n".join(episodes)}, {}
    )


@dataclasses.dataclass(frozen=True)
class Round:
    """A complete round: how long it took [s], how often its command was given, and what differs.

    `policy_equal` is None for a sweep.
    """

    lane: str
    number: int
    seconds: float
    commands: int
    differs: list[str]
    policy_equal: bool | None


@dataclasses.dataclass(frozen=True)
class End:
    """A job that ended without being complete: its status, and what it printed.

    Attributes:
        last_line: The job's last word, or the last line.
        traceback: Whether it printed one.
        by_fault: Whether the fault was to end it, by a signal.
    """

    status: int
    last_line: str
    traceback: bool
    by_fault: bool


class Lane:
    """One kind of job, repeated.

    Attributes:
        name: training or sweep.
        job: The one at work, or the one that has ended last.
        held: Whether commands wait to be given: a fault needs the driver down, or no room on the disk.
        rounds: Those that are complete.
        ends: Of jobs that were not complete.
    """

    def __init__(
        self, name: str, words: list[str], tables: Callable[[Path], Tables], folder: Path, temp: Path
    ) -> None:
        """Work in `folder`, with `temp` for temporary files, the clock and logs; nothing is started yet."""
        self.name, self.words, self.tables, self.folder, self.temp = name, words, tables, folder, temp
        self.held, self.last = False, False
        self.rounds: list[Round] = []
        self.ends: list[End] = []
        self.reference: Tables | None = None
        self.job: Job | None = None
        self.logs: list[Path] = []
        self.commands, self.asked, self.began_s = 0, 0, 0.0

    @property
    def place(self) -> Path:
        """The folder of this round."""
        return self.folder / f"{self.name}-{len(self.rounds)}"

    def begin(self) -> None:
        """Start the next round."""
        self.commands, self.began_s = 0, time.monotonic()
        self.give([sys.executable, "-m", "platform.launch", *self.words, f"runs_dir={self.place / 'runs'}"])

    def give(self, command: list[str]) -> None:
        """Give a command."""
        self.commands += 1
        clock = CLOCK.format(file=str(self.temp / "clock"))
        self.place.mkdir(parents=True, exist_ok=True)
        self.job = start(self.place, command, first=clock, TMPDIR=str(self.temp))
        self.logs.append(self.job.log)
        self.command = command

    def again(self) -> None:
        """Give the command that the job has printed, or the first one if it had not come so far."""
        with contextlib.suppress(ValueError):
            self.command = self.job.printed_command()
        self.give(self.command)

    @property
    def working(self) -> bool:
        """Whether a job is at work."""
        return self.job is not None and self.job.process.poll() is None

    def poll(self) -> None:
        """Notice the end of a job: begin the next round, or give its command again."""
        if self.job is None or self.working or self.held:
            return
        status = self.job.process.returncode
        if status != 0:
            self.note_end(status)
            self.again()
            return
        self.close_round()
        if not self.last:
            self.begin()

    def note_end(self, status: int, by_fault: bool = False) -> None:
        """Remember how a job ended."""
        lines = [line.strip() for line in self.job.said.splitlines() if line.strip()]
        # Ray may print its own lines after the job's last word.
        words = [line for line in lines if line.startswith("evade: ")] or lines
        last = words[-1] if words else ""
        traced = "Traceback (most recent call last)" in self.job.said
        self.ends.append(End(status, last, traced, by_fault))

    def new_ends(self) -> list[End]:
        """The ends since this was last asked."""
        new, self.asked = self.ends[self.asked :], len(self.ends)
        return new

    def close_round(self) -> None:
        """Compare the tables of a complete round, and delete its files."""
        found = self.tables(self.job.run)
        self.reference = self.reference or found
        equal = found.policy == self.reference.policy if found.policy else None
        seconds = time.monotonic() - self.began_s
        differs = self.reference.differing(found)
        place = self.place
        self.rounds.append(Round(self.name, len(self.rounds), seconds, self.commands, differs, equal))
        if differs:
            shutil.copytree(place, self.temp / "differs" / place.name, dirs_exist_ok=True)
        shutil.rmtree(place)
        for log in self.logs:
            log.unlink(missing_ok=True)
        self.logs.clear()
        self.job = None

    def progress(self) -> tuple[int, int]:
        """Rounds, and bytes of results in this one: more when it goes on."""
        patterns = ("train/results.jsonl", "eval/episodes/*.json", "sweep/episodes/*.json", "stages/*.json")
        total = 0
        for pattern in patterns:
            for path in self.place.glob(f"runs/*/{pattern}"):
                with contextlib.suppress(OSError):
                    total += path.stat().st_size
        return len(self.rounds), total

    def processes(self, mark: str) -> list[int]:
        """Its processes whose command line has `mark`, without those that have ended."""
        if not self.working:
            return []
        return [pid for pid in living(descendants(self.job.process.pid)) if mark in command_line(pid)]

    def kill(self, number: signal.Signals = signal.SIGKILL, patience_s: float = KILLED_S) -> list[int]:
        """End the driver by a signal, and wait for all below it; return what is left of it."""
        below = list(descendants(self.job.process.pid))
        with contextlib.suppress(ProcessLookupError):
            self.job.process.send_signal(number)
        self.job.process.wait(300)
        deadline = time.monotonic() + patience_s
        while living(below) and time.monotonic() < deadline:
            time.sleep(0.1)
        return living(below)
