"""Episodes: roll out an agent through corridors in lock-step, and record results and trajectories."""

import dataclasses
from collections import defaultdict
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from envs.config import EnvConfig
from envs.corridor import CorridorEnv, CorridorVectorEnv, Info
from envs.scene import Scene
from jobs.rollout.agents import Agent

EPISODE = np.dtype(
    [
        ("seed", "i8"),
        ("success", "?"),
        ("collision", "?"),
        ("truncated", "?"),
        ("distance_m", "f8"),
        ("x_m", "f8"),
        ("return", "f8"),
        ("steps", "i8"),
        ("events_per_step", "f8"),
        ("dropped", "i8"),
    ]
)
# Columns that were added later -> default for older episodes.
ADDED: dict[str, object] = {}
# Called after each step with the environment, the seed and the observation.
Watch = Callable[[CorridorEnv, int, np.ndarray], None]


class Flight(NamedTuple):
    """An episode to roll out.

    Attributes:
        config: The simulation; its observation is replaced by the one that the agent needs.
        seed: Seed of the corridor.
        watch: Called after each step.
    """

    config: EnvConfig
    seed: int
    watch: Watch | None = None


def roll_out(
    agent: Agent,
    config: EnvConfig,
    seeds: Sequence[int],
    num_envs: int = 8,
    watch: Watch | None = None,
) -> np.ndarray:
    """Roll out one episode per seed, in batches.

    Args:
        agent: Chooses the actions.
        config: See `Flight`.
        seeds: One corridor each, shape (n,).
        num_envs: Most episodes of a batch.
        watch: Called after each step of each episode.

    Returns:
        As `roll_out_together`.
    """
    flights = [Flight(config, int(seed), watch) for seed in seeds]
    batches = [flights[first : first + num_envs] for first in range(0, len(flights), num_envs)]
    return np.concatenate([np.empty(0, EPISODE), *(roll_out_together(agent, batch) for batch in batches)])


def roll_out_together(agent: Agent, flights: Sequence[Flight]) -> np.ndarray:
    """Roll out episodes in lock-step, so that the agent chooses in batches.

    Finished episodes take no more time. An episode depends only on its simulation and seed, not on the other
    episodes of its batch.

    Args:
        agent: Chooses the actions.
        flights: At least one; their observations have one shape, their vehicles the same actions.

    Returns:
        EPISODE (n,), in the order of the flights. `distance_m` is the progress along y without
        collision [m], `x_m` the x at which the episode ended [m], `dropped` the number of events beyond
        the limits of pixel and window.

    Raises:
        ValueError: The flights differ in their observations or actions; or as for `CorridorVectorEnv.step`.
    """
    configs = {id(flight.config): flight.config for flight in flights}  # each is validated once
    seen = {key: dataclasses.replace(one, observation=agent.observation) for key, one in configs.items()}
    env = CorridorVectorEnv(len(flights), [seen[id(flight.config)] for flight in flights])
    try:
        return _roll_out_batch(agent, env, flights)
    finally:
        env.close()


def _roll_out_batch(agent: Agent, env: CorridorVectorEnv, flights: Sequence[Flight]) -> np.ndarray:
    """Roll out one episode per environment until all have ended."""
    seeds = [flight.seed for flight in flights]
    observations, _ = env.reset(seed=list(seeds))
    agent.reset(env.envs, seeds)
    totals = np.zeros((len(seeds), 4))
    episodes = np.zeros(len(seeds), EPISODE)
    episodes["seed"] = seeds
    running = np.arange(len(seeds))
    while running.size:
        observations, *results, infos = env.step_some(agent(observations), running)
        rewards, terminated, truncated = results
        ones = np.ones(running.size)
        totals[running] += np.stack((rewards, ones, infos["num_events"], infos["dropped_events"]), axis=1)
        for row, observation in zip(running.tolist(), observations, strict=True):
            watch = flights[row].watch
            if watch is not None:
                watch(env.envs[row], seeds[row], observation)
        over = terminated | truncated
        if over.any():
            for row, late in zip(running[over], truncated[over], strict=True):
                _record(episodes[row], totals[row], late, env.envs[row].info())
            going_on = np.flatnonzero(~over)
            running, observations = running[going_on], _those(observations, going_on)
            agent.keep(going_on)
    return episodes


def _those(observations: Any, places: np.ndarray) -> Any:
    """Select observations from a batch, an array or a tuple, by their indices."""
    return tuple(observations[k] for k in places) if isinstance(observations, tuple) else observations[places]


def _record(episode: np.void, totals: np.ndarray, truncated: bool, info: Info) -> None:
    """Fill in the EPISODE row of a finished episode; `totals`: return, steps, events, dropped events."""
    episode["success"], episode["collision"] = info["success"], info["collision"]
    episode["distance_m"], episode["x_m"] = info["distance_m"], info["x_m"]
    episode["truncated"] = truncated
    episode["return"], episode["steps"], events, episode["dropped"] = totals
    episode["events_per_step"] = events / episode["steps"]


@dataclass(frozen=True)
class Trajectory:
    """The path of one episode.

    Attributes:
        agent: Name of the agent.
        seed: Seed of the corridor.
        scene: The corridor.
        xy_m: Position after each control step, float64 (T, 2) [m].
        outcome: "goal", "collision" or "time limit".
        height_m: Height of the vehicle above the ground [m].
    """

    agent: str
    seed: int
    scene: Scene
    xy_m: np.ndarray
    outcome: str
    height_m: float


class TrajectoryRecorder:
    """Records the trajectories of some episodes during a rollout."""

    def __init__(self, seeds: Collection[int]) -> None:
        """Record the episodes of the given seeds."""
        self.seeds = seeds
        self._points: dict[int, list[tuple[float, float]]] = defaultdict(list)
        self._scenes: dict[int, Scene] = {}
        self._height_m = 0.0

    def add(self, env: CorridorEnv, seed: int, observation: np.ndarray) -> None:
        """Record the position after a step (a `Watch`)."""
        if seed in self.seeds:
            self._points[seed].append(env.camera_pose()[:2])
            self._scenes[seed] = env.scene
            self._height_m = env.config.camera_height_m

    def trajectories(self, agent: str, episodes: np.ndarray) -> list[Trajectory]:
        """Return the trajectories, with the outcomes of their EPISODE rows."""
        outcomes = {int(episode["seed"]): outcome_of(episode) for episode in episodes}
        return [
            Trajectory(agent, seed, self._scenes[seed], np.array(points), outcomes[seed], self._height_m)
            for seed, points in self._points.items()
        ]


def outcome_of(episode: np.void) -> str:
    """Return the outcome of an EPISODE (): "goal", "collision" or "time limit"."""
    if episode["success"]:
        return "goal"
    return "collision" if episode["collision"] else "time limit"
