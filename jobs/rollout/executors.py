"""Executors, which compute parts of evaluation tasks: their shared code, and the executor without Ray."""

import functools
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from envs.event_error import measure_event_error
from jobs.config.plugins import one_line
from jobs.rollout.agents import Agent, make_agent
from jobs.rollout.diagnostics import DriftSampler
from jobs.rollout.episodes import EPISODE, Flight, roll_out_together
from jobs.rollout.store import EpisodeStore, PartResult, SimulationAccuracy
from jobs.rollout.tasks import EvaluationTask
from jobs.run.progress import console
from jobs.run.provenance import git_commit
from jobs.run.torch_threads import torch_threads


@dataclass(frozen=True)
class Part:
    """Some seeds of a task, evaluated in lock-step by one process.

    Attributes:
        task: The task, limited to these seeds.
        measures_accuracy: Whether the accuracy of its simulation is measured too.
    """

    task: EvaluationTask
    measures_accuracy: bool = False


class Recorder:
    """Receives an executor's results and failures: stores, prints, and advances the progress bar.

    It runs in the driver, the process that has the run folder.
    """

    def __init__(self, store: EpisodeStore, advance: Callable[..., None]) -> None:
        """Store results in `store`, and call `advance` with the number of finished episodes."""
        self._store, self._advance, self._commit = store, advance, git_commit()
        self._failed: dict[str, str] = {}  # key of a task -> its error
        self._lost: dict[str, str] = {}  # key of a task -> how its process ended
        self._restarts: Counter[str] = Counter()  # key of a task -> restarts since it last stored a part

    def finish(self, part: Part, outcome: PartResult | str) -> None:
        """Store the result of a part, or note and print the reason why it failed."""
        task = part.task
        if isinstance(outcome, str):
            if self._failed.get(task.key) != outcome:
                console.print(f"Not evaluated: {task.name}: {outcome}", markup=False)
            self._failed[task.key] = outcome
            return
        self._store.add(task, outcome, self._commit, self._restarts.pop(task.key, 0))
        self._advance(len(outcome.episodes), note=task.name)

    def lose(self, part: Part, reason: str, consequence: str) -> None:
        """Note that a part's process ended without a result; print the reason and the consequence."""
        self._lost[part.task.key] = reason
        self._restarts[part.task.key] += 1
        console.print(f"{reason}, {consequence}: {part.task.name}", markup=False)

    def reason(self, part: Part) -> str:
        """Return why a part has no result."""
        key = part.task.key
        return self._failed.get(key) or self._lost.get(key, "its process ended")


Executor = Callable[[Sequence[Part], Recorder], None]
Result = TypeVar("Result")


def run_serially(parts: Sequence[Part], recorder: Recorder) -> None:
    """Evaluate one part after the other in this process, with one torch thread, like a worker."""
    with torch_threads(1):
        for part in parts:
            recorder.finish(part, attempt(functools.partial(evaluate_part, part)))


def attempt(evaluation: Callable[[], Result]) -> Result | str:
    """Return the result of an evaluation or, if it raises, its error in one line; the others can continue."""
    try:
        return evaluation()
    except Exception as error:
        return one_line(error)


def evaluate_together(parts: Sequence[Part]) -> list[PartResult | str]:
    """Return the result of each part of a batch (`batches_of`), or the reason why it failed.

    An error ends the episodes of the whole batch. Each part is then evaluated again, alone.
    """
    found = attempt(functools.partial(_evaluate, parts)) if len(parts) > 1 else "alone"
    if isinstance(found, str):
        return [attempt(functools.partial(evaluate_part, part)) for part in parts]
    return list(found)


def evaluate_part(part: Part) -> PartResult:
    """Return the episodes of a part, the drift of its policy's encoder, and the accuracy of its simulation.

    Raises:
        ValueError: If a value of an episode is NaN or infinite.
    """
    (result,) = _evaluate([part])
    return result


def _evaluate(parts: Sequence[Part]) -> list[PartResult]:
    """Return the results of parts that share a policy; all their episodes are rolled out in one batch."""
    tasks = [part.task for part in parts]
    drifts = [DriftSampler(task.policy.agent) for task in tasks]
    agent = cached_agent(tasks[0].policy.agent, tasks[0].action, tasks[0].table)
    flights = [
        Flight(task.env, seed, drift.add)
        for task, drift in zip(tasks, drifts, strict=True)
        for seed in task.seeds
    ]
    episodes = roll_out_together(agent, flights)
    bad = [name for name in EPISODE.names or () if not np.isfinite(episodes[name]).all()]
    if bad:
        raise ValueError(f"episodes must be finite, got NaN or infinity in {', '.join(bad)}")
    own = np.split(episodes, np.cumsum([len(task.seeds) for task in tasks])[:-1])
    return [
        PartResult(rows, drift.metrics(), _accuracy(part))
        for part, rows, drift in zip(parts, own, drifts, strict=True)
    ]


def _accuracy(part: Part) -> SimulationAccuracy | None:
    """Measure the accuracy of a part's simulation if `part.measures_accuracy`, else return None."""
    if not part.measures_accuracy:
        return None
    found = measure_event_error(part.task.env)
    return SimulationAccuracy(found.error, found.renders)


@functools.lru_cache(maxsize=2)
def cached_agent(agent: str, action: str, table: tuple[tuple[str, object], ...] = ()) -> Agent:
    """Return `make_agent`'s result, cached per process; agents are reusable, since `reset` clears them."""
    return make_agent(agent, action, table)
