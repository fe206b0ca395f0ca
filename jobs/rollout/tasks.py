"""Evaluation tasks: one policy under one condition, through corridors that all policies share."""

import dataclasses
import functools
from dataclasses import dataclass
from typing import Any

import numpy as np

from envs.config import EnvConfig, FaultsConfig, hashed_settings, seen_settings, settings_hash
from jobs.rollout.policies import EvaluatedPolicy

# Columns of EPISODE that count in the key of a task. Never extend it: a column that is added to EPISODE would
# otherwise change every key, and every stored episode would be evaluated again.
KEYED_COLUMNS = (
    *("seed", "success", "collision", "truncated", "distance_m", "x_m", "return", "steps"),
    *("events_per_step", "dropped"),
)
MAX_EPISODES = 10  # of a part, in lock-step: more would leave other cores with nothing to do


@dataclass(frozen=True)
class EvaluationTask:
    """One policy or baseline under one condition.

    Attributes:
        condition: Axis and value, or what else tells the conditions apart; several conditions share a
            task where their settings are the same.
        key: Hash of all that decides an episode but its seed: what the agent sees of the simulation,
            the policy, the choice of action.
        policy: What is evaluated.
        action: How a policy chooses: "deterministic" or "stochastic".
        env: The simulation.
        seeds: One corridor each.
        table: Settings of `EncoderTable.from_evae` that the policy's encoder is tabulated with; empty:
            the policy's own.
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
        """Return the hash of what decides how exact the events are: the simulation without its faults."""
        return settings_hash(hashed_settings(dataclasses.replace(self.env, faults=FaultsConfig())))

    @property
    def part_id(self) -> tuple[str, int]:
        """Return what tells the parts of a task apart: its key and the first seed."""
        return self.key, self.seeds[0]


def make_task(
    condition: tuple[str, Any],
    policy: EvaluatedPolicy,
    action: str,
    env: EnvConfig,
    trials: int,
    table: tuple[tuple[str, Any], ...] = (),
) -> EvaluationTask:
    """Return the task of the first `trials` corridors, see `EvaluationTask`, with its key."""
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
    """Return a name or a value of a setting as text, different for every value."""
    if not isinstance(value, int | float):
        return "null" if value is None else str(value)
    short = f"{value:g}"
    return short if float(short) == value else repr(value)


def split(task: EvaluationTask) -> list[EvaluationTask]:
    """Return a task in parts of nearly the same size and at most `MAX_EPISODES`."""
    parts = np.array_split(np.arange(len(task.seeds)), -(-len(task.seeds) // MAX_EPISODES))
    return [dataclasses.replace(task, seeds=task.seeds[part[0] : part[-1] + 1]) for part in parts]
