"""The protocol of a benchmark: a frozen YAML file whose cells become evaluation tasks.

A cell is one corruption at one severity; severity 0 of the corruption "clean" changes nothing. All policies
fly through the same corridors in all cells.
"""

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import yaml

from envs.config import EnvConfig
from jobs.config.conditions import axis_points
from jobs.config.config import ConfigError
from jobs.config.env_keys import env_with
from jobs.rollout.met import was_met
from jobs.rollout.policies import EvaluatedPolicy, with_own_parts
from jobs.rollout.tasks import EvaluationTask, make_task

PROTOCOL = Path(__file__).with_name("eventpolicy_c_v1.yaml")
CLEAN = "clean"
Cell = tuple[str, int]  # corruption and severity


@dataclass(frozen=True)
class Protocol:
    """The content of a protocol's file.

    Attributes:
        name, version: Name and version of the benchmark.
        sha256: SHA-256 of the file.
        split: Split of the corridors, such as "eval".
        corridors: Number of corridors, with seeds from 0.
        env: The simulation of the clean cell.
        reference: The policy whose failures count as 100 %, and its failures: corruption -> number.
        parts: Part -> corruption -> setting -> values of the five severities, or one value for all.
    """

    name: str
    version: int
    sha256: str
    split: Literal["eval", "validation"]
    corridors: int
    env: EnvConfig
    reference: Mapping[str, Any]
    parts: Mapping[str, Mapping[str, Mapping[str, Sequence[Any]]]]

    @property
    def title(self) -> str:
        """Return "EventPolicy-C v1"."""
        return f"{self.name} v{self.version}"

    def cells(self, part: str) -> dict[Cell, dict[str, Any]]:
        """Return cell -> changed settings for all cells of a part, the clean cell first."""
        found: dict[Cell, dict[str, Any]] = {(CLEAN, 0): {}}
        for corruption, axis in self.parts[part].items():
            for severity, point in enumerate(axis_points(axis), 1):
                found[corruption, severity] = dict(point)
        return found


def read_protocol() -> Protocol:
    """Read the protocol from its YAML file."""
    text = PROTOCOL.read_bytes()
    values = yaml.safe_load(text)
    env = env_with(EnvConfig(split=values["split"]), values.pop("env"))
    return Protocol(sha256=hashlib.sha256(text).hexdigest(), env=env, **values)


def tasks_of(
    protocol: Protocol, part: str, policy: EvaluatedPolicy, action: str
) -> dict[Cell, list[EvaluationTask]]:
    """Return the evaluation tasks of each cell; several if its corridors alternate between settings.

    Raises:
        ConfigError: The policy needs a different camera or vehicle than the protocol's.
    """
    base = with_own_parts(policy, protocol.env)
    if base.vehicle != protocol.env.vehicle:
        rule = f"must fly a {protocol.env.vehicle} vehicle, as all policies do"
        raise ConfigError(f"bench.policy: {rule}, got a policy of {base.vehicle}")
    for side in ("width", "height"):
        own, ours = policy.sensor.get(side, 64), getattr(base.camera, side)
        if own != ours:
            raise ConfigError(f"bench.policy: must see {ours} pixels ({side}), got a policy of {own}")
    found = {}
    for cell, changes in protocol.cells(part).items():
        turns = changes_in_turn(changes)
        envs = [env_with(base, turn) for turn in turns]
        tasks = [make_task(cell, policy, action, env, protocol.corridors) for env in envs]
        found[cell] = [
            dataclasses.replace(task, seeds=task.seeds[first :: len(turns)])
            for first, task in enumerate(tasks)
        ]
    return found


def changes_in_turn(changes: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the changes for each group of corridors; a list as value has one entry per group."""
    turns = max((len(value) for value in changes.values() if isinstance(value, list)), default=1)
    return [
        {
            key: value[turn % len(value)] if isinstance(value, list) else value
            for key, value in changes.items()
        }
        for turn in range(turns)
    ]


def met_in_training(protocol: Protocol, part: str, policy: EvaluatedPolicy) -> list[str]:
    """Return the corruptions whose severities a policy's training drew; empty for a foreign policy.

    Settings that are the same at all severities, such as the scatter of a noise, are ignored.
    """
    base = with_own_parts(policy, protocol.env)
    return [name for name in protocol.parts[part] if _has_met(protocol, part, name, policy, base)]


def _has_met(protocol: Protocol, part: str, name: str, policy: EvaluatedPolicy, base: EnvConfig) -> bool:
    fixed = [key for key, values in protocol.parts[part][name].items() if len(values) == 1]
    turns = [
        turn
        for (corruption, _), changes in protocol.cells(part).items() if corruption == name
        for turn in changes_in_turn(changes)
    ]  # fmt: skip
    return any(
        was_met(policy, env_with(base, {key: turn[key] for key in fixed}), env_with(base, turn))
        for turn in turns
    )
