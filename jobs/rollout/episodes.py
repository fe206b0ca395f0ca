"""Flights: one episode per held-out corridor, several at once, and what is kept of them."""

import csv
import dataclasses
import io
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from envs.config import EnvConfig, sensor_differences
from envs.corridor import CorridorEnv
from envs.scene import Scene
from jobs.rollout.agents import Agent
from jobs.run.files import write_atomic

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


@dataclass(frozen=True)
class Trajectory:
    """Where one episode went, float64 (T, 2): x and y [m]."""

    agent: str
    seed: int
    scene: Scene
    way_m: np.ndarray
    outcome: str  # goal, collision or time limit
    height_m: float = 2.0  # above the ground


Advance = Callable[[int], None]
Watch = Callable[[CorridorEnv, int, np.ndarray, Mapping[str, Any]], None]


def fly(
    agent: Agent,
    config: EnvConfig,
    seeds: Sequence[int],
    num_envs: int = 8,
    watch: Watch | None = None,
    advance: Advance | None = None,
) -> np.ndarray:
    """Fly one episode per seed, several in lock-step so that the agent chooses in batches.

    An episode depends on its seed, not on the others of its batch.

    Args:
        agent: Chooses the actions.
        config: The simulation; its observation is the one that the agent sees.
        seeds: One corridor each, shape (n,).
        num_envs: Most episodes at once.
        watch: Called after each step with the environment, the seed, the observation and the info.
        advance: Told 1 at the end of each episode.

    Returns:
        EPISODE (n,), in the order of the seeds. `distance_m` is the way along y without
        collision [m], `x_m` where across the corridor it ended [m], `dropped` what neither
        pixel nor window could hold.
    """
    config = dataclasses.replace(config, observation=agent.observation)
    envs = [CorridorEnv(config) for _ in range(min(num_envs, len(seeds)))]
    parts = [np.empty(0, EPISODE)]
    try:
        for first in range(0, len(seeds), num_envs):
            batch = [int(seed) for seed in seeds[first : first + num_envs]]
            parts.append(_fly_batch(agent, envs[: len(batch)], batch, watch or _ignore, advance or _ignore))
    finally:
        for env in envs:
            env.close()
    return np.concatenate(parts)


def _ignore(*values: Any) -> None:
    """Watch nothing."""


def _fly_batch(
    agent: Agent, envs: Sequence[CorridorEnv], seeds: Sequence[int], watch: Watch, advance: Advance
) -> np.ndarray:
    """One episode per environment, until the last one ends."""
    started = [env.reset(seed=seed) for env, seed in zip(envs, seeds, strict=True)]
    observations = np.stack([observation for observation, _ in started])
    infos = [info for _, info in started]
    agent.reset(envs, seeds)
    totals = [np.zeros(4) for _ in envs]
    episodes = np.zeros(len(envs), EPISODE)
    episodes["seed"] = seeds
    flying = list(range(len(envs)))
    while flying:
        actions = agent(observations, infos)
        for row in tuple(flying):
            observation, reward, terminated, truncated, info = envs[row].step(int(actions[row]))
            observations[row], infos[row] = observation, info
            totals[row] += reward, 1, info["num_events"], info["dropped_events"]
            watch(envs[row], seeds[row], observation, info)
            if terminated or truncated:
                _note(episodes[row], totals[row], truncated, info)
                advance(1)
                flying.remove(row)
                observations[row] = 0  # an empty window costs the agent nothing
    return episodes


def _note(episode: np.void, totals: np.ndarray, truncated: bool, info: Mapping[str, Any]) -> None:
    """Write down an episode that ended; `totals` are its return, steps, events and dropped events."""
    for name in ("success", "collision", "distance_m", "x_m"):
        episode[name] = info[name]
    episode["truncated"] = truncated
    episode["return"], episode["steps"], events, episode["dropped"] = totals
    episode["events_per_step"] = events / episode["steps"]


def check_sensor(
    manifest: Mapping[str, Any], config: EnvConfig, allow_mismatch: bool = False
) -> dict[str, tuple[Any, Any]]:
    """Compare the sensor that a policy was trained with to the environment's.

    Returns:
        Setting -> (policy's value, environment's value), where they differ.

    Raises:
        ValueError: If they differ and that is not allowed; both values are named.
    """
    differ = sensor_differences(manifest["sensor"], config)
    if differ and not allow_mismatch:
        got = "; ".join(f"{key} = {ours!r} instead of {theirs!r}" for key, (theirs, ours) in differ.items())
        raise ValueError(f"the sensor must be the policy's, got {got}; the sweep job flies such changes")
    return differ


class Ways:
    """Collects the ways of flights while they are flown."""

    def __init__(self, seeds: Collection[int]) -> None:
        """Collect those of the given seeds."""
        self.seeds = seeds
        self.points: dict[int, list[tuple[float, float]]] = defaultdict(list)
        self.scenes: dict[int, Any] = {}
        self.height_m = 0.0

    def add(self, env: CorridorEnv, seed: int, observation: np.ndarray, info: Mapping[str, Any]) -> None:
        """Note where a flight is now."""
        if seed in self.seeds:
            self.points[seed].append((info["x_m"], info["y_m"]))
            self.scenes[seed] = env.scene
            self.height_m = env.config.camera_height_m

    def tracks(self, agent: str, episodes: np.ndarray) -> list[Trajectory]:
        """The ways with their outcomes."""
        outcome = {int(episode["seed"]): _outcome(episode) for episode in episodes}
        return [
            Trajectory(agent, seed, self.scenes[seed], np.array(points), outcome[seed], self.height_m)
            for seed, points in self.points.items()
        ]


def _outcome(episode: np.void) -> str:
    if episode["success"]:
        return "goal"
    return "collision" if episode["collision"] else "time limit"


def write_episodes(path: Path, labels: Sequence[str], flown: Mapping[Any, np.ndarray]) -> None:
    """Every episode as one row of a CSV file, behind what was flown: one word per label."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*labels, *(EPISODE.names or ())])
    for label, episodes in flown.items():
        writer.writerows([*label, *episode.item()] for episode in episodes)
    write_atomic(path, text.getvalue())
