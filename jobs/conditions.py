"""What a sweep flies: one setting changed at a time, each as a cell with an identity of its own."""

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from envs.config import EnvConfig, settings_hash
from jobs.config import Config, ConfigError, env_with
from jobs.evaluate import find_policy
from jobs.pilots import BOUNDS
from jobs.runs import Run
from models.policy import MANIFEST

SHOWN_BOUNDS = ("straight", "oracle")

Value = int | float | str


@dataclass(frozen=True)
class Cell:
    """One pilot under one condition, through corridors that all conditions share.

    Attributes:
        label: Axis and value; several axes share a cell where they hold the same value.
        key: Hash of all that decides an episode but its seed: simulation, policy, choice of action.
        seeds: One corridor each.
    """

    label: tuple[str, str]
    key: str
    pilot: str
    action: str
    env: EnvConfig
    seeds: tuple[int, ...]


@dataclass(frozen=True)
class Sweep:
    """All cells of a sweep.

    Attributes:
        axes: Axis -> (value, cell of the policy), ascending.
        bounds: Pilot that bounds the policy -> its cell, without any change.
    """

    axes: dict[str, list[tuple[Value, Cell]]]
    bounds: dict[str, Cell]

    def cells(self) -> list[Cell]:
        """Every cell; two may share a key."""
        return [cell for points in self.axes.values() for _, cell in points] + list(self.bounds.values())


def swept_policy(config: Config, folder: Run) -> str:
    """What is swept: the policy that `sweep.policy` names, else the run's own or the newest one.

    A policy is named by its folder, its run folder, or as a bound ("oracle").

    Raises:
        ConfigError: If there is no such policy.
    """
    named = config.sweep.policy
    if named is None:
        return str(find_policy(config, folder))
    if named in BOUNDS:
        return named
    for path in (Path(named), Path(named) / "policy"):
        if (path / MANIFEST).is_file():
            return str(path.resolve())
    raise ConfigError(
        f"sweep.policy: must be a run folder, a policy folder or one of {BOUNDS}, got {named!r}"
    )


def plan(config: Config, policy: str) -> Sweep:
    """The cells of a sweep."""
    identity = policy if policy in BOUNDS else settings_hash(read_manifest(policy))
    base = config.env_config(scene=config.sweep.scene, split="eval")

    def cell(label: tuple[str, str], pilot: str, name: str, env: EnvConfig) -> Cell:
        action, seeds = config.evaluate.action, tuple(range(config.sweep.trials))
        key = settings_hash({"env": dataclasses.asdict(env), "pilot": name, "action": action})
        return Cell(label, key, pilot, action, env, seeds)

    def point(axis: str, value: Value) -> tuple[Value, Cell]:
        return value, cell((axis, shown(value)), policy, identity, env_with(base, axis, value))

    axes = {
        axis: [point(axis, value) for value in ordered(values)] for axis, values in config.sweep.axes.items()
    }
    return Sweep(axes, {name: cell((name, "-"), name, name, base) for name in SHOWN_BOUNDS})


def ordered(values: Sequence[Value]) -> list[Value]:
    """Numbers ascending, each once; words as they are given."""
    once = list(dict.fromkeys(values))
    return once if any(isinstance(value, str) for value in once) else sorted(once)


def shown(value: Value) -> str:
    """A value as tables and figures show it."""
    return value if isinstance(value, str) else f"{value:g}"


def read_manifest(policy: str) -> dict[str, Any]:
    """What a policy folder says about itself; its SHA-256 sums make it unique."""
    manifest: dict[str, Any] = json.loads((Path(policy) / MANIFEST).read_text())
    return manifest
