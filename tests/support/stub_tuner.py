"""A stand-in for Tune: flies nothing, and tells the callback what came of each part."""

from types import SimpleNamespace

import numpy as np

from jobs.rollout.episodes import EPISODE
from jobs.rollout.scheduler import MAX_FAILURES


class StubTuner:
    """Counts what Tune would fly in workers; what is `broken` raises with a reason, or dies without."""

    flown: list[tuple[str, int]] = []  # noqa: RUF012
    measured: list[tuple[str, int]] = []  # noqa: RUF012
    broken: dict[tuple[str, str], str] = {}  # noqa: RUF012
    dying: set[tuple[str, int]] = set()  # noqa: RUF012

    def __init__(self, place, missing, measured, keep):
        self.missing, self.keep = missing, keep
        self.measured += measured

    def fit(self):
        for cell in self.missing:
            result = {"key": cell.key, "label": list(cell.label)}
            if cell.part in self.dying:
                self.die(cell)
                continue
            if cell.label in self.broken:
                if self.broken[cell.label]:
                    self.keep.on_trial_result(1, [], None, {**result, "failed": self.broken[cell.label]})
                else:
                    self.die(cell)
                continue
            rows = np.zeros(len(cell.seeds), EPISODE)
            rows["seed"], rows["distance_m"] = cell.seeds, 50.0
            self.flown += [(cell.key, seed) for seed in cell.seeds]
            accuracy = {"event_error": 0.01, "renders_per_step": 3.0} if cell.part in self.measured else None
            result |= {"simulation": cell.simulation, "accuracy": accuracy}
            self.keep.on_trial_result(1, [], None, {**result, "encoder": {}, "episodes": rows.tolist()})

    def die(self, cell):
        trial = SimpleNamespace(config={"trial": {"cell": cell}})
        for hook in [self.keep.on_trial_recover] * MAX_FAILURES + [self.keep.on_trial_error]:
            self.keep.on_trial_start(1, [], trial)
            hook(1, [], trial)
