"""The store of evaluated episodes, from which a stopped job resumes."""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from jobs.rollout.episodes import EPISODE
from jobs.rollout.table import episodes_of
from jobs.rollout.tasks import KEYED_COLUMNS, EvaluationTask, text_of
from jobs.run.files import RunError, read_json, write_json
from jobs.run.progress import console

Stored = TypeVar("Stored")


@dataclass(frozen=True)
class SimulationAccuracy:
    """Accuracy of a simulation: its event error [-], and its renders per control step."""

    event_error: float
    renders_per_step: float


@dataclass(frozen=True)
class PartResult:
    """The result of a part of a task.

    Attributes:
        episodes: EPISODE (n,), one row per seed.
        drift: `drift_metrics` of the policy's encoder; empty without an encoder.
        accuracy: Accuracy of the simulation; None if not measured.
    """

    episodes: np.ndarray
    drift: dict[str, float]
    accuracy: SimulationAccuracy | None = None


@dataclass(frozen=True)
class TaskResult:
    """The stored results of a task.

    Attributes:
        episodes: EPISODE (n,), sorted by seed.
        drift: `drift_metrics` of the policy's encoder in the part with the lowest seeds.
        commits: Commits of the code that evaluated it, sorted.
        restarts: Number of processes that ended before they had evaluated their part of it.
    """

    episodes: np.ndarray
    drift: dict[str, float]
    commits: tuple[str, ...]
    restarts: int


class EpisodeStore:
    """A folder with a JSON file for each task, and one for the accuracy of each simulation.

    A damaged file is renamed to `*.damaged`, and its task is evaluated again.
    """

    def __init__(self, folder: Path) -> None:
        """Store in `folder`, which is created with the first result."""
        self.folder = folder

    def missing(self, task: EvaluationTask) -> EvaluationTask:
        """Return the task, limited to the seeds whose episodes are not stored."""
        stored = self._read(task.key)
        seeds = set() if stored is None else set(stored.episodes["seed"].tolist())
        return dataclasses.replace(task, seeds=tuple(seed for seed in task.seeds if seed not in seeds))

    def add(self, part: EvaluationTask, result: PartResult, commit: str, restarts: int = 0) -> None:
        """Store the result of a part, together with the stored episodes of its task.

        Args:
            part: The evaluated part.
            result: Its result.
            commit: Commit of the code that evaluated it.
            restarts: Number of processes that ended since the last part of this task was stored.
        """
        before, new = self._read(part.key), result.episodes
        merged = TaskResult(new, result.drift, (commit,), restarts)
        if before is not None and before.episodes.size:
            others = before.episodes[~np.isin(before.episodes["seed"], new["seed"])]
            merged = TaskResult(
                np.sort(np.concatenate([others, new]), order="seed"),
                before.drift if before.episodes["seed"].min() < new["seed"][0] else result.drift,
                tuple(sorted({*before.commits, commit})),
                before.restarts + restarts,
            )
        values = {
            "label": [*map(text_of, part.condition), *part.policy.name.split()],
            "commits": merged.commits,
            "encoder": merged.drift,
            "restarts": merged.restarts,
            "columns": list(EPISODE.names or ()),
            "episodes": merged.episodes.tolist(),
        }
        write_json(self._file(part.key), values)
        if result.accuracy is not None:
            write_json(self._accuracy_file(part), dataclasses.asdict(result.accuracy))

    def result(self, task: EvaluationTask) -> TaskResult:
        """Return the stored results of a task, with one episode for each of its seeds, in their order.

        Raises:
            KeyError: If episodes are missing.
        """
        stored = self._read(task.key)
        if stored is None:
            raise KeyError(f"no episodes are stored of {task.name} ({self._file(task.key)})")
        places = {int(seed): place for place, seed in enumerate(stored.episodes["seed"])}
        return dataclasses.replace(stored, episodes=stored.episodes[[places[seed] for seed in task.seeds]])

    def accuracy(self, task: EvaluationTask) -> SimulationAccuracy | None:
        """Return the accuracy of a task's simulation; None if it was not measured or its file is damaged."""
        file = self._accuracy_file(task)
        return self._undamaged(file, lambda values: SimulationAccuracy(**values))

    def _file(self, key: str) -> Path:
        return self.folder / "episodes" / f"{key}.json"

    def _accuracy_file(self, task: EvaluationTask) -> Path:
        return self.folder / "accuracy" / f"{task.simulation}.json"

    def _read(self, key: str) -> TaskResult | None:
        """Return all results stored under a key; None if there are none or the file is damaged."""

        def parse(values: Mapping[str, Any]) -> TaskResult:
            episodes = episodes_of(values["episodes"], values.get("columns", KEYED_COLUMNS))
            return TaskResult(episodes, values["encoder"], tuple(values["commits"]), values["restarts"])

        return self._undamaged(self._file(key), parse)

    def _undamaged(self, file: Path, parse: Callable[[Any], Stored]) -> Stored | None:
        """Read and parse a file; return None if it is missing, or damaged: it is then renamed."""
        if not file.is_file():
            return None
        try:
            return parse(read_json(file))
        except (RunError, KeyError, TypeError, ValueError):
            file.replace(file.with_suffix(".damaged"))
            console.print(f"Damaged and put aside, evaluated again: {file}", markup=False)
            return None
