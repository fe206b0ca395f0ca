"""Executors compute parts of evaluation tasks; here is what they share, and the one without Ray."""

import functools
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from envs.event_error import measure_event_error
from jobs.config.plugins import one_line
from jobs.rollout.agents import Agent, make_agent
from jobs.rollout.diagnostics import DriftSampler
from jobs.rollout.episodes import EPISODE, roll_out
from jobs.rollout.store import EpisodeStore, PartResult, SimulationAccuracy
from jobs.rollout.tasks import EvaluationTask
from jobs.run.progress import console
from jobs.run.provenance import git_commit
from jobs.run.torch_threads import torch_threads


@dataclass(frozen=True)
class Part:
    """Some seeds of a task, evaluated in lock-step by one process.

    Attributes:
        task: With these seeds alone.
        measures_accuracy: Whether the accuracy of its simulation is measured too.
    """

    task: EvaluationTask
    measures_accuracy: bool = False


class Recorder:
    """Takes what an executor finishes or loses: stores results, prints failures, advances the progress bar.

    It lives in the process that has the run folder.
    """

    def __init__(self, store: EpisodeStore, advance: Callable[..., None]) -> None:
        """Store results in `store`, and call `advance` with the number of episodes."""
        self._store, self._advance, self._commit = store, advance, git_commit()
        self._failed: dict[str, str] = {}  # key of a task -> why it raised
        self._lost: dict[str, str] = {}  # key -> how its process ended
        self._restarts: Counter[str] = Counter()  # since something of the task was stored

    def finish(self, part: Part, outcome: PartResult | str) -> None:
        """Take the result of a part, or the reason why it failed."""
        task = part.task
        if isinstance(outcome, str):
            if self._failed.get(task.key) != outcome:
                console.print(f"Not evaluated: {task.name}: {outcome}", markup=False)
            self._failed[task.key] = outcome
            return
        self._store.add(task, outcome, self._commit, self._restarts.pop(task.key, 0))
        self._advance(len(outcome.episodes), note=task.name)

    def lose(self, part: Part, reason: str, consequence: str) -> None:
        """Note that the process of a part ended before its result, and what is done about it."""
        self._lost[part.task.key] = reason
        self._restarts[part.task.key] += 1
        console.print(f"{reason}, {consequence}: {part.task.name}", markup=False)

    def reason(self, part: Part) -> str:
        """Return why a part has no result."""
        key = part.task.key
        return self._failed.get(key) or self._lost.get(key, "its process ended")


Executor = Callable[[Sequence[Part], Recorder], None]


def run_serially(parts: Sequence[Part], recorder: Recorder) -> None:
    """Evaluate one part after the other in this process, with one thread as a worker has."""
    with torch_threads(1):
        for part in parts:
            recorder.finish(part, attempt(functools.partial(evaluate_part, part)))


def attempt(evaluation: Callable[[], PartResult]) -> PartResult | str:
    """Return the result of an evaluation, or, if it raises, the error in one line: it must stop no other."""
    try:
        return evaluation()
    except Exception as error:
        return one_line(error)


def evaluate_part(part: Part) -> PartResult:
    """Return the episodes of a part, the drift of its policy's encoder, and the accuracy of its simulation.

    Raises:
        ValueError: If a number of an episode is NaN or infinite.
    """
    task = part.task
    drift = DriftSampler(task.policy.agent)
    agent = cached_agent(task.policy.agent, task.action, task.table)
    episodes = roll_out(agent, task.env, task.seeds, len(task.seeds), drift.add)
    bad = [name for name in EPISODE.names or () if not np.isfinite(episodes[name]).all()]
    if bad:
        raise ValueError(f"episodes must be finite, got NaN or infinity in {', '.join(bad)}")
    accuracy = None
    if part.measures_accuracy:
        found = measure_event_error(task.env)
        accuracy = SimulationAccuracy(found.error, found.renders)
    return PartResult(episodes, drift.metrics(), accuracy)


@functools.lru_cache(maxsize=2)
def cached_agent(agent: str, action: str, table: tuple[tuple[str, object], ...] = ()) -> Agent:
    """Return `make_agent`'s result, cached per process: an agent forgets its episodes when it is reset."""
    return make_agent(agent, action, table)
