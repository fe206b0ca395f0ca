"""Every setting of an experiment, checked; the values are in conf/, their ranges in `jobs.config.schema`.

`parse` turns the composed configuration into one frozen `Config`, or raises one
`ConfigError` that lists each refused key with its value and the rule. Nothing has been
started or written by then.
"""

import dataclasses
import itertools
import re
import typing
from collections.abc import Collection, Mapping
from typing import Annotated, Any, Literal

import pydantic
from pydantic import Field
from pydantic.dataclasses import dataclass

from envs.config import STRICT, CameraConfig, EnvConfig, FaultsConfig, FidelityConfig
from jobs.config.conditions import refused_axes, refused_conditions
from jobs.config.errors import JOBS_CHOOSE, explain, nearest, redacted, refused_scenes
from jobs.config.schema import (
    AlgoConfig,
    ClusterConfig,
    CollectConfig,
    EvaluateConfig,
    Name,
    PretrainConfig,
    ProbeConfig,
    SweepConfig,
    TrackingConfig,
    TradeConfig,
    TradeEncoderConfig,
    TradeSimulatorConfig,
    TrainConfig,
)
from models.kinds import KINDS, Model, model_keys, read_model


class ConfigError(ValueError):
    """A configuration that was refused; the message names key, value and rule."""


@dataclass(frozen=True, config=STRICT)
class Config:
    """One experiment, checked."""

    job: Literal[
        "pipeline", "collect", "pretrain", "train", "evaluate", "sweep", "report", "ship",
        "trade", "trade_simulator", "trade_encoder", "probe",
    ]  # fmt: skip
    exp: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")]
    budget: Literal["smoke", "short", "paper"]
    seed: Annotated[int, Field(ge=0, lt=2**31)]
    resume: str | None
    runs_dir: Name
    env: dict[str, Any]
    camera: CameraConfig
    faults: FaultsConfig
    renderer: Literal["auto", "raycast", "pyrender"]
    fidelity: FidelityConfig
    model: Model
    algo: AlgoConfig
    collect: CollectConfig
    pretrain: PretrainConfig
    train: TrainConfig
    evaluate: EvaluateConfig
    sweep: SweepConfig
    trade: TradeConfig
    trade_simulator: TradeSimulatorConfig
    trade_encoder: TradeEncoderConfig
    probe: ProbeConfig
    cluster: ClusterConfig
    tracking: TrackingConfig

    def env_config(self, **changes: Any) -> EnvConfig:
        """The simulation that this experiment flies, with some of its fields replaced."""
        parts = {name: getattr(self, name) for name in ENV_PARTS}
        return EnvConfig(**{**self.env, **parts, **changes})


HELD_OUT_SCENE = "poles_eval"  # never trained on: wider, and laid out at random
ENV_PARTS = ("camera", "faults", "renderer", "fidelity")
ENV_KEYS = [
    part.name
    for part in dataclasses.fields(typing.cast(Any, EnvConfig))
    if part.name not in (*ENV_PARTS, *JOBS_CHOOSE)
]
SECTIONS = {
    part.name: part.type for part in dataclasses.fields(Config) if dataclasses.is_dataclass(part.type)
}


def parse(values: Mapping[str, Any]) -> Config:
    """Check a composed configuration.

    Args:
        values: Plain containers, as `conf/` composes them or `as_dict` returns them.

    Raises:
        ConfigError: With one line per refused key: the key, the rule, the value received.
    """
    refused: list[str] = []
    parts = {name: _build(section, values.get(name), name, refused) for name, section in SECTIONS.items()}
    parts["model"] = _build(read_model, values.get("model"), "model", refused)
    parts["env"] = world = _build(EnvConfig, values.get("env"), "env", refused)
    if world is not None:  # 100 and 100.0 become the same setting, so that they name the same run
        parts["env"] = {name: getattr(world, name) for name in ENV_KEYS}
    refused_parts = [name for name, part in parts.items() if part is None]
    config = _build(Config, {**values, **parts}, "", refused, refused_parts)
    if not refused:
        named = [("env.scene", config.env["scene"]), ("sweep.scene", config.sweep.scene)]
        named += [("evaluate", HELD_OUT_SCENE)]
        named += [("trade_simulator.scenes", name) for name in config.trade_simulator.scenes]
        named += [("collect.scenes", name) for name in config.collect.scenes]
        trained = [condition.get("env.scene") for condition in config.train.conditions]
        named += [("train.conditions", name) for name in trained if isinstance(name, str)]
        swept = itertools.chain(*(axis.get("env.scene", []) for axis in config.sweep.axes.values()))
        named += [("sweep.axes", name) for name in dict.fromkeys(swept) if isinstance(name, str)]
        vehicle = config.env["vehicle_radius_m"], config.env["camera_height_m"]
        refused = _refused_picture(config) + refused_axes(config.sweep.axes, config.env_config())
        refused += refused_conditions(config.train.conditions, config.env_config())
        at_once, wanted = config.algo.num_envs_per_env_runner, len(config.train.conditions)
        if wanted > at_once:
            rule = f"must be at most the {at_once} of algo.num_envs_per_env_runner"
            refused.append(f"train.conditions: {rule}, got {wanted}")
        if not config.collect.scenes and not config.collect.recordings:
            refused.append("collect.scenes: must name a scene where collect.recordings is empty, got []")
        refused += refused_scenes(named, config.env["layout"], vehicle)
    if refused:
        raise ConfigError("\n".join(refused))
    return typing.cast(Config, config)


def known_keys() -> list[str]:
    """Every key that a configuration may have."""
    keys = [field.name for field in dataclasses.fields(Config)]
    for name, section in SECTIONS.items():
        keys += [f"{name}.{field.name}" for field in dataclasses.fields(typing.cast(Any, section))]
    keys += [f"model.{name}" for name in model_keys()]
    return keys + [f"env.{name}" for name in ENV_KEYS]


def as_dict(config: Config) -> dict[str, Any]:
    """The configuration as plain containers, for files and trackers: without the tracker's password."""
    values = dataclasses.asdict(typing.cast(Any, config))
    values["tracking"]["uri"] = redacted(config.tracking.uri)
    return values


def _build(section: Any, values: Any, name: str, refused: list[str], skip: Collection[str] = ()) -> Any:
    """The section made of its values, or None, with the reasons added to `refused`."""
    if not isinstance(values, Mapping):
        refused.append(f"{name}: must be a group of settings, got {values!r}")
        return None
    if section is EnvConfig:
        taken = [key for key in values if key in (*ENV_PARTS, *JOBS_CHOOSE)]
        refused += [
            f"env.{key}: no such key, got {values[key]!r}{nearest(f'env.{key}', [])}" for key in taken
        ]
        values = {key: value for key, value in values.items() if key not in taken}
    try:
        return section(**{str(key): value for key, value in values.items()})
    except pydantic.ValidationError as error:
        refused += [
            line for line in explain(error, name, known_keys()) if re.split("[:.]", line)[0] not in skip
        ]
        return None


def _refused_picture(config: Config) -> list[str]:
    """Sides of the sensor's picture that the policy's network cannot take."""
    smallest = KINDS[config.model.name].min_side
    sides = {name: getattr(config.camera, name) for name in ("width", "height")}
    rule = f"must be at least {smallest} for the network of {config.model.name}"
    return [f"camera.{name}: {rule}, got {side}" for name, side in sides.items() if side < smallest]
