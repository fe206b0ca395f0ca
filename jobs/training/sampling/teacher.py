"""Env runners with a teacher: a planner that knows the geometry and returns the cost of each action."""

import math
from collections import defaultdict
from typing import Any

import numpy as np
from ray.rllib.env.single_agent_episode import SingleAgentEpisode

from envs.vehicles.planning import Planner
from jobs.training.sampling.env_runner import PlainEnvRunner, Step
from jobs.training.sampling.snapshots import Snapshot

# Key of an info: cost of the cheapest way (`envs.scene.planning`) to the goal line, from where the next
# action takes effect.
COST_TO_GO = "cost_to_go"
SIGHT_M = "teacher_sight_m"  # the learner's own setting: length of the plans [m]; missing: to the goal line


class TeacherEnvRunner(PlainEnvRunner):
    """A `PlainEnvRunner` with a planner for each environment."""

    def __init__(self, **settings: Any) -> None:
        self._planners: dict[int, Planner] = defaultdict(Planner)  # row of the environment -> its planner
        super().__init__(**settings)

    def costs(self) -> np.ndarray:
        """Return the cost of each action where it takes effect, float64 (N, actions)."""
        sight_m = self.config.learner_config_dict.get(SIGHT_M, math.inf)
        envs = self.env.unwrapped.envs
        return np.stack([self._planners[row].costs(env, sight_m) for row, env in enumerate(envs)])


class PricedEnvRunner(TeacherEnvRunner):
    """A `PlainEnvRunner` whose infos have `COST_TO_GO`; policies never see infos."""

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

    Costs are about 1 where the way is free and 1000 where there is none; the results are 0.7 and 7.
    """
    return np.log1p(episode.get_infos()[COST_TO_GO])
