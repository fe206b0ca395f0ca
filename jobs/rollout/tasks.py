"""Evaluation tasks: one policy under one condition, in the same corridors for all policies."""

import dataclasses
import functools
from dataclasses import dataclass
from typing import Any

import numpy as np

from envs.config import EnvConfig, FaultsConfig, hashed_settings, seen_settings, settings_hash
from jobs.rollout.policies import EvaluatedPolicy

# Columns of EPISODE that are hashed into the key of a task. Never extend it, not even if EPISODE gets another
# column: every key would change, and every stored episode would be evaluated again.
KEYED_COLUMNS = (
    *("seed", "success", "collision", "truncated", "distance_m", "x_m", "return", "steps"),
    *("events_per_step", "dropped"),
)
MAX_EPISODES = 10  # most episodes of a part: what is stored, retried and rolled out by one process


@dataclass(frozen=True)
class EvaluationTask:
    """One policy or baseline under one condition.

    Attributes:
        condition: Axis and value, or another label; conditions with the same settings share a task.
        key: Hash of everything that determines an episode except its seed: the settings of the simulation
            that affect the agent, the policy, `action` and `table`.
        policy: The policy or baseline.
        action: How a policy chooses: "deterministic" or "stochastic".
        env: The simulation.
        seeds: One corridor each.
        table: Settings of `EncoderTable.from_evae` for tabulating the policy's encoder; empty for the
            policy's own settings.
    """

    condition: tuple[str, Any]
    key: str
    policy: EvaluatedPolicy
    action: str
    env: EnvConfig
    seeds: tuple[int, ...]
    table: tuple[tuple[str, Any], ...] = ()

    @property
    def name(self) -> str:
        """Return condition and policy: "rate 100 bytestream s0"."""
        return " ".join((*map(text_of, self.condition), self.policy.name))

    @functools.cached_property
    def simulation(self) -> str:
        """Return the hash of the settings that determine the event error: the simulation without faults."""
        return settings_hash(hashed_settings(dataclasses.replace(self.env, faults=FaultsConfig())))

    @property
    def part_id(self) -> tuple[str, int]:
        """Return the identity of a part of a task: its key and first seed."""
        return self.key, self.seeds[0]


def make_task(
    condition: tuple[str, Any],
    policy: EvaluatedPolicy,
    action: str,
    env: EnvConfig,
    trials: int,
    table: tuple[tuple[str, Any], ...] = (),
) -> EvaluationTask:
    """Return a task in the first `trials` corridors, with its key; arguments as in `EvaluationTask`."""
    seen = seen_settings(env, policy.observation)
    facts: dict[str, object] = {
        "env": hashed_settings(seen),
        "agent": policy.identity,
        "action": action,
        "kept": list(KEYED_COLUMNS),
    }
    key = settings_hash(facts | ({"table": dict(table)} if table else {}))
    return EvaluationTask(condition, key, policy, action, env, tuple(range(trials)), table)


def text_of(value: object) -> str:
    """Return a name or a setting's value as text; different numbers give different texts."""
    if not isinstance(value, int | float):
        return "null" if value is None else str(value)
    short = f"{value:g}"
    return short if float(short) == value else repr(value)


def split(task: EvaluationTask) -> list[EvaluationTask]:
    """Split a task into parts of nearly equal size, of at most `MAX_EPISODES` episodes each."""
    parts = np.array_split(np.arange(len(task.seeds)), -(-len(task.seeds) // MAX_EPISODES))
    return [dataclasses.replace(task, seeds=task.seeds[part[0] : part[-1] + 1]) for part in parts]
