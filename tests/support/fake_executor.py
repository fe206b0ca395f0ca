"""An executor that makes up the results of parts, and notes what it was asked for."""

import numpy as np

from jobs.rollout.episodes import EPISODE
from jobs.rollout.executors import attempt
from jobs.rollout.store import PartResult, SimulationAccuracy


def made_up(part):
    """Episodes of 50 m without success or contact."""
    episodes = np.zeros(len(part.task.seeds), EPISODE)
    episodes["seed"], episodes["distance_m"] = part.task.seeds, 50.0
    return PartResult(episodes, {}, SimulationAccuracy(0.01, 3.0) if part.measures_accuracy else None)


class FakeExecutor:
    """Evaluates by a function; what is broken raises with a reason, or its process ends.

    Attributes:
        broken: Condition, or its axis, -> reason; an empty one ends the process.
        dying: Parts whose process ends.
        evaluated: Key and seed of all episodes so far.
        measured: The parts that measured the accuracy of their simulation.
    """

    def __init__(self, evaluate=made_up):
        self.evaluate = evaluate
        self.broken: dict[object, str] = {}
        self.dying: set[tuple[str, int]] = set()
        self.evaluated: list[tuple[str, int]] = []
        self.measured: list[tuple[str, int]] = []

    def __call__(self, parts, recorder):
        self.measured += [part.task.part_id for part in parts if part.measures_accuracy]
        for part in parts:
            task = part.task
            reason = self.broken.get(task.condition, self.broken.get(task.condition[0]))
            if reason == "" or task.part_id in self.dying:
                recorder.lose(part, "its process ended 3 times", "given up")
            elif reason:
                recorder.finish(part, reason)
            else:
                recorder.finish(part, attempt(lambda: self.evaluate(part)))  # noqa: B023
                self.evaluated += [(task.key, seed) for seed in task.seeds]
