"""The steps that imitation has sampled so far, each with the teacher's costs (DAgger's data set)."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from ray.rllib.core.columns import Columns
from torch import Tensor

from envs.kinematics import MIRRORED_ACTIONS
from jobs.training.ppo.losses import TAKEN

SETTINGS = "imitation"  # key among the learner's settings: the fields of `ImitationConfig`, and env_steps
COSTS = "costs"  # column of a step: cost of each action minus the lowest cost, float32 (actions,)
MIRRORED = "mirrored"  # column of a step: its observation with left and right exchanged
NAMES = {"stacks": Columns.OBS, "costs": COSTS, "taken": TAKEN}  # stored name -> column that the loss reads


def mirror_images(settings: Mapping[str, Any]) -> list[int]:
    """Return the mirror image of each action, from the learner's settings; empty without mirroring."""
    mirrored = settings.get(MIRRORED, False)  # True for the kinematic vehicle, a list for another
    return MIRRORED_ACTIONS if mirrored is True else list(mirrored or [])


class LabelledSteps:
    """Labelled steps of all batches; beyond a memory bound, a uniform random sample of them.

    A row is a step, or a window of steps for a recurrent network.
    """

    def __init__(self, most_bytes: float) -> None:
        self.most_bytes, self.seen = most_bytes, 0
        self.columns: dict[str, np.ndarray] = {}

    def __len__(self) -> int:
        return min(self.seen, self._room)

    def add(self, **columns: np.ndarray) -> None:
        """Add rows: stacks (N, ...), costs (N, ..., actions) and, for windows, taken (N, T).

        Beyond the bound, all rows so far have the same chance to stay (reservoir sampling).
        """
        if not self.seen:
            self._allocate(columns)
        numbers = self.seen + np.arange(len(columns["costs"]))
        drawn = (torch.rand(len(numbers), dtype=torch.float64).numpy() * (numbers + 1)).astype(np.int64)
        places = np.where(numbers < self._room, numbers, drawn)
        kept = places < self._room
        for name, column in self.columns.items():
            column[places[kept]] = columns[name][kept]
        self.seen += len(numbers)

    def draw(self, count: int) -> dict[str, Tensor]:
        """Return `count` random rows, with replacement."""
        rows = torch.randint(len(self), (count,))
        return {NAMES[name]: torch.from_numpy(column)[rows] for name, column in self.columns.items()}

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the whole state, for `load`."""
        size = len(self)
        return {name: column[:size] for name, column in self.columns.items()} | {"seen": np.array(self.seen)}

    def load(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Continue from the state of `arrays`."""
        self.seen = int(arrays["seen"])
        if self.seen:
            stored = {name: arrays[name] for name in NAMES if name in arrays}
            self._allocate(stored)
            for name, column in stored.items():
                self.columns[name][: len(column)] = column

    @property
    def _room(self) -> int:
        return len(next(iter(self.columns.values()), ()))

    def _allocate(self, columns: Mapping[str, np.ndarray]) -> None:
        """Reserve as many rows as the bound allows; pages that are never written cost no memory."""
        most = max(1, int(self.most_bytes / sum(column[0].nbytes for column in columns.values())))
        self.columns = {
            name: np.empty((most, *column.shape[1:]), column.dtype) for name, column in columns.items()
        }
