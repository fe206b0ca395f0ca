"""What a sweep flies: one setting changed at a time, each as a cell with an identity of its own."""

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from envs.config import CameraConfig, EnvConfig, FidelityConfig, settings_hash
from jobs.config import Config, ConfigError, env_with
from jobs.evaluate import find_policy
from jobs.flights import check_sensor
from jobs.pilots import BOUNDS
from jobs.runs import Run, named_policy
from models.policy import MANIFEST

SHOWN_BOUNDS = ("straight", "oracle")
CAMERA_SETTINGS = {field.name for field in dataclasses.fields(CameraConfig)}
FIDELITY_SETTINGS = {field.name for field in dataclasses.fields(FidelityConfig)}


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
        differ: Sensor setting -> (the policy's value, which is flown; the configured), if unequal.
        axes: Axis -> (value, cell of the policy), ascending.
        bounds: Pilot that bounds the policy -> its cell, without any change.
    """

    differ: dict[str, tuple[Any, Any]]
    axes: dict[str, list[tuple[float, Cell]]]
    bounds: dict[str, Cell]

    @property
    def identity(self) -> str:
        """Hash of all that decides its figures: policy, conditions and corridors."""
        return settings_hash({"cells": [[*cell.label, cell.key, *cell.seeds] for cell in self.cells()]})

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
    path = named_policy(named)
    if path is None:
        raise ConfigError(
            f"sweep.policy: must be a run folder, a policy folder or one of {BOUNDS}, got {named!r}"
        )
    return str(path)


def plan(config: Config, policy: str) -> Sweep:
    """The cells of a sweep: a policy flies its own sensor, and each axis changes one setting of that."""
    manifest = read_manifest(policy)
    identity = settings_hash(manifest) if manifest else policy
    configured = config.env_config(scene=config.sweep.scene, split="eval")
    differ = check_sensor(manifest, configured, allow_mismatch=True) if manifest else {}
    base = with_sensor(configured, manifest.get("sensor", {}))

    def cell(label: tuple[str, str], pilot: str, name: str, env: EnvConfig) -> Cell:
        action, seeds = config.evaluate.action, tuple(range(config.sweep.trials))
        key = settings_hash({"env": dataclasses.asdict(env), "pilot": name, "action": action})
        return Cell(label, key, pilot, action, env, seeds)

    def point(axis: str, value: float) -> tuple[float, Cell]:
        return value, cell((axis, f"{value:g}"), policy, identity, env_with(base, axis, value))

    axes = {
        axis: [point(axis, value) for value in sorted(set(values))]
        for axis, values in config.sweep.axes.items()
    }
    return Sweep(differ, axes, {name: cell((name, "-"), name, name, base) for name in SHOWN_BOUNDS})


def with_sensor(env: EnvConfig, sensor: Mapping[str, Any]) -> EnvConfig:
    """The simulation with the sensor settings of a manifest, named as `sensor_settings` names them.

    Raises:
        pydantic.ValidationError: If a setting is unknown or refuses its value.
    """
    camera = {name: value for name, value in sensor.items() if name in CAMERA_SETTINGS}
    fidelity = {name: value for name, value in sensor.items() if name in FIDELITY_SETTINGS}
    rest = {name: value for name, value in sensor.items() if name not in camera | fidelity}
    # Together, because some settings of a camera exclude each other.
    return dataclasses.replace(
        env,
        camera=dataclasses.replace(env.camera, **camera),
        fidelity=dataclasses.replace(env.fidelity, **fidelity),
        **rest,
    )


def read_manifest(policy: str) -> dict[str, Any]:
    """What a policy folder says about itself, unique by its SHA-256 sums; of a bound, nothing."""
    if policy in BOUNDS:
        return {}
    manifest: dict[str, Any] = json.loads((Path(policy) / MANIFEST).read_text())
    return manifest
