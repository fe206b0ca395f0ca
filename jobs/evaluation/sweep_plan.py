"""What a sweep flies: policies and conditions, each pair as a cell with an identity of its own."""

import dataclasses
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pydantic

from envs.config import CameraConfig, EnvConfig, FidelityConfig, settings_hash
from jobs.config.conditions import axis_points, env_with
from jobs.config.config import Config, ConfigError
from jobs.evaluation.evaluate import find_policy
from jobs.rollout.agents import BOUNDS
from jobs.rollout.episodes import check_sensor
from jobs.rollout.tasks import Cell, Entry, make_cell
from jobs.run.folder import Run, named_policy
from jobs.run.provenance import REPOSITORY
from models.kinds import find_kind
from models.policy.policy import MANIFEST

PRETRAINED = REPOSITORY / "models" / "pretrained"
CAMERA_SETTINGS = {field.name for field in dataclasses.fields(CameraConfig)}
FIDELITY_SETTINGS = {field.name for field in dataclasses.fields(FidelityConfig)}
NOMINAL = "nominal"  # the axis of the one condition that changes nothing


@dataclass(frozen=True)
class Sweep:
    """All that a sweep flies.

    Attributes:
        entries: Who flies, groups together in the order in which they were named.
        differ: Agent -> sensor setting -> (its own value, which is flown; the configured), if unequal.
        axes: Axis -> value as text -> settings that it changes; the first axis is `NOMINAL`.
        cells: One for each condition and entry; two may share a key.
    """

    entries: tuple[Entry, ...]
    differ: dict[str, dict[str, tuple[Any, Any]]]
    axes: dict[str, dict[str, dict[str, Any]]]
    cells: tuple[Cell, ...]

    @property
    def identity(self) -> str:
        """Hash of all that decides its figures: policies, conditions and corridors."""
        return settings_hash({"cells": [[*cell.label, cell.key, *cell.seeds] for cell in self.cells]})

    @property
    def groups(self) -> dict[str, list[int | None]]:
        """Group -> its trainings."""
        names = dict.fromkeys(entry.group for entry in self.entries)
        return {name: [entry.training for entry in self.entries if entry.group == name] for name in names}

    @property
    def conditions(self) -> list[tuple[str, str]]:
        """Axis and value of each condition."""
        return [(axis, value) for axis, points in self.axes.items() for value in points]


def find_entries(config: Config, folder: Run, pretrained: Path = PRETRAINED) -> tuple[Entry, ...]:
    """Who flies: what `sweep.policies` names, each once.

    Raises:
        ConfigError: If there is no such policy, or two have the same group and training seed.
    """
    names = config.sweep.policies
    paths = [
        path for name in names for path in find_agents("sweep.policies", name, config, folder, pretrained)
    ]
    entries = list({entry.identity: entry for entry in map(read_entry, paths)}.values())
    held: dict[tuple[str, int | None], Entry] = {}
    for entry in entries:
        other = held.setdefault((entry.group, entry.training), entry)
        if other is not entry:
            raise ConfigError(
                f"sweep.policies: two policies are {entry.group} with training seed {entry.training}, got "
                f"{other.agent!r} and {entry.agent!r}; leave one out, or train one with another seed"
            )
    order = list(dict.fromkeys(entry.group for entry in entries))
    return tuple(sorted(entries, key=lambda entry: (order.index(entry.group), entry.training or 0)))


def find_agents(key: str, name: str, config: Config, folder: Run, pretrained: Path = PRETRAINED) -> list[str]:
    """Paths and bounds that a name stands for, which a configuration has under `key`.

    A group of shipped policies, such as bytestream, stands for all its trainings: bytestream-s0, -s1, ..

    Raises:
        ConfigError: If there is no such policy.
    """
    if name == "pretrained":
        found = sorted(str(path.parent) for path in pretrained.glob(f"*/{MANIFEST}"))
        if not found:
            raise ConfigError(
                f"{key}: 'pretrained' means the policies in {str(pretrained)!r}, which holds none; "
                f"train one (python -m platform.launch +exp=bytestream) and name it: {key}=[newest]"
            )
        return found
    if name == "newest":
        return [str(find_policy(config, folder))]
    if name in BOUNDS:
        return [name]
    path = named_policy(name) or named_policy(str(pretrained / name))
    if path is not None:
        return [str(path)]
    shipped = (file.parent for file in pretrained.glob(f"*/{MANIFEST}"))
    trainings = [str(place) for place in shipped if re.fullmatch(re.escape(name) + r"-s\d+", place.name)]
    if not trainings:
        places = "a name or a group in models/pretrained, a policy folder or a run folder"
        raise ConfigError(f"{key}: must be 'pretrained', 'newest', one of {BOUNDS}, {places}, got {name!r}")
    return sorted(trainings)


def read_entry(agent: str) -> Entry:
    """What a policy folder says about itself; of a bound, its name.

    Raises:
        ConfigError: If the folder's manifest lacks what tells one training from another.
    """
    if agent in BOUNDS:
        return Entry(agent, agent, None, agent, {}, "none")
    manifest: dict[str, Any] = json.loads((Path(agent) / MANIFEST).read_text())
    missing = [name for name in ("name", "seed", "sensor") if name not in manifest]
    if missing:
        raise ConfigError(f"sweep.policies: the manifest of {agent!r} lacks {missing}; train it anew")
    group = str(manifest.get("exp", manifest["name"]))
    identity, observation = settings_hash(manifest), find_kind(manifest["name"]).observation
    return Entry(agent, group, int(manifest["seed"]), identity, manifest["sensor"], observation)


def plan(config: Config, entries: Sequence[Entry]) -> Sweep:
    """The cells of a sweep: a policy flies its own sensor, and each condition changes settings of that.

    Raises:
        ConfigError: If a policy's own sensor and a changed setting exclude each other.
    """
    configured = dataclasses.replace(config.env, scene=config.sweep.scene, split="eval")
    axes: dict[str, dict[str, dict[str, Any]]] = {NOMINAL: {config.sweep.scene: {}}}
    for axis, settings in config.sweep.axes.items():
        axes[axis] = {text(next(iter(point.values()))): point for point in axis_points(settings)}
    differ = {entry.agent: _differences(entry, configured) for entry in entries}
    cells = []
    for entry in entries:
        own = with_sensor(configured, entry.sensor)
        for axis, points in axes.items():
            for value, point in points.items():
                cells.append(_cell(config, entry, (axis, value), own, point))
    return Sweep(
        tuple(entries), {agent: found for agent, found in differ.items() if found}, axes, tuple(cells)
    )


def _cell(
    config: Config, entry: Entry, label: tuple[str, str], own: EnvConfig, point: Mapping[str, Any]
) -> Cell:
    try:
        env = env_with(own, point)
    except pydantic.ValidationError as error:
        reason = error.errors()[0]["msg"]
        raise ConfigError(
            f"sweep.axes.{label[0]}: {dict(point)} with the sensor of {entry.agent!r}: {reason}"
        ) from None
    return make_cell(label, entry, config.evaluate.action, env, config.sweep.trials)


def _differences(entry: Entry, configured: EnvConfig) -> dict[str, tuple[Any, Any]]:
    """Where a policy's own sensor is not the configured one."""
    if not entry.sensor:
        return {}
    return check_sensor({"sensor": entry.sensor}, configured, allow_mismatch=True)


def text(value: float | str | None) -> str:
    """A value of an axis as its label."""
    if not isinstance(value, int | float):
        return "null" if value is None else value
    short = f"{value:g}"
    return short if float(short) == value else repr(value)


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
