"""Env runners beside which a planner stands that knows the geometry, and says what each place costs."""

import math
from collections import defaultdict
from typing import Any

import numpy as np
from ray.rllib.env.single_agent_episode import SingleAgentEpisode

from envs.vehicles.planning import Planner
from jobs.training.sampling.env_runner import PlainEnvRunner, Step
from jobs.training.sampling.snapshots import Snapshot

# In an info: of the cheapest way (`envs.scene.planning`) to the goal line from where the next action acts.
COST_TO_GO = "cost_to_go"
SIGHT_M = (
    "teacher_sight_m"  # of the learner's own settings: how far the plans look, without it to the goal line
)


class TeacherEnvRunner(PlainEnvRunner):
    """As `PlainEnvRunner`, with a plan of each environment's scene."""

    def __init__(self, **settings: Any) -> None:
        self._planners: dict[int, Planner] = defaultdict(Planner)  # of each environment
        super().__init__(**settings)

    def costs(self) -> np.ndarray:
        """Return the cost of each action where it takes effect, float64 (N, actions)."""
        sight_m = self.config.learner_config_dict.get(SIGHT_M, math.inf)
        envs = self.env.unwrapped.envs
        return np.stack([self._planners[row].costs(env, sight_m) for row, env in enumerate(envs)])


class PricedEnvRunner(TeacherEnvRunner):
    """As `PlainEnvRunner`; each info has `COST_TO_GO`. The policy never sees an info."""

    def _reset_all(self) -> None:
        super()._reset_all()
        self._infos = self._priced(self._infos)

    def _step(self) -> Step:
        step = super()._step()
        return step._replace(infos=self._priced(step.infos))

    def _replay(self, snapshot: Snapshot) -> str:
        problem = super()._replay(snapshot)
        if not problem:
            self._infos = self._priced(self._infos)
        return problem

    def _priced(self, infos: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {**infos, COST_TO_GO: self.costs().min(axis=1)}


def log_costs(episode: SingleAgentEpisode) -> np.ndarray:
    """Return log(1 + `COST_TO_GO`) of the steps of an episode, float64 (T + 1,).

    Costs are about 1 where a way is free, and 1000 where none is left; logarithms are 0.7 and 7.
    """
    return np.log1p(episode.get_infos()[COST_TO_GO])
