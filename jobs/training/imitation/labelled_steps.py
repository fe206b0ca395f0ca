"""The steps that imitation has sampled so far, each with the teacher's costs (DAgger's data set)."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from ray.rllib.core.columns import Columns
from torch import Tensor

from envs.kinematics import MIRRORED_ACTIONS

SETTINGS = "imitation"  # key among the learner's settings: the fields of `ImitationConfig`, and env_steps
COSTS = "costs"  # column of a step: cost of each action minus that of the cheapest, float32 (actions,)
MIRRORED = "mirrored"  # column of a step: its observation with left and right exchanged


def mirror_images(settings: Mapping[str, Any]) -> list[int]:
    """Return the mirrored action of each action, from the learner's settings; none if nothing is mirrored."""
    mirrored = settings.get(MIRRORED, False)  # True: of the kinematic vehicle; a list: of another one
    return MIRRORED_ACTIONS if mirrored is True else list(mirrored or [])


class LabelledSteps:
    """Steps with their labels, of all batches; beyond a bound, a uniform random sample of them."""

    def __init__(self, most_bytes: float) -> None:
        self.most_bytes, self.seen = most_bytes, 0
        self.stacks, self.costs = np.empty(0), np.empty(0)

    def __len__(self) -> int:
        return min(self.seen, len(self.stacks))

    def add(self, stacks: np.ndarray, costs: np.ndarray) -> None:
        """Add steps (N, ...) and costs (N, actions); each step so far has the same chance to stay."""
        if not self.seen:
            self._allocate(stacks, costs)
        numbers = self.seen + np.arange(len(stacks))
        drawn = (torch.rand(len(stacks), dtype=torch.float64).numpy() * (numbers + 1)).astype(np.int64)
        places = np.where(numbers < len(self.stacks), numbers, drawn)
        kept = places < len(self.stacks)
        self.stacks[places[kept]], self.costs[places[kept]] = stacks[kept], costs[kept]
        self.seen += len(stacks)

    def draw(self, count: int) -> dict[str, Tensor]:
        """Return `count` random rows, with replacement."""
        rows = torch.randint(len(self), (count,))
        columns = {Columns.OBS: self.stacks, COSTS: self.costs}
        return {name: torch.from_numpy(column)[rows] for name, column in columns.items()}

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the whole state, for `load`."""
        size = len(self)
        return {"stacks": self.stacks[:size], "costs": self.costs[:size], "seen": np.array(self.seen)}

    def load(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Continue from the state of `arrays`."""
        self.seen, size = int(arrays["seen"]), len(arrays["stacks"])
        if size:
            self._allocate(arrays["stacks"], arrays["costs"])
            self.stacks[:size], self.costs[:size] = arrays["stacks"], arrays["costs"]

    def _allocate(self, stacks: np.ndarray, costs: np.ndarray) -> None:
        """Reserve as many rows as the bound allows; pages that are never written cost no memory."""
        most = max(1, int(self.most_bytes / (stacks[0].nbytes + costs[0].nbytes)))
        self.stacks = np.empty((most, *stacks.shape[1:]), stacks.dtype)
        self.costs = np.empty((most, *costs.shape[1:]), costs.dtype)
