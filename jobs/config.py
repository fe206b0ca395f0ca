"""Every setting of an experiment: names, units and ranges; the values are in conf/.

`parse` turns the composed configuration into one frozen `Config`, or raises one
`ConfigError` that lists each refused key with its value and the rule. Nothing has been
started or written by then.
"""

import dataclasses
import itertools
import typing
from collections.abc import Collection, Mapping
from typing import Annotated, Any, Literal

import pydantic
from pydantic import Field
from pydantic.dataclasses import dataclass

from envs.config import STRICT, CameraConfig, EnvConfig, FaultsConfig, FidelityConfig, Fraction, Positive
from jobs.axes import Axis, AxisName, refused_axes
from jobs.refusals import JOBS_CHOOSE, explain, nearest, refused_scenes
from models.kinds import KINDS, SMALLEST_IMAGE

Count = Annotated[int, Field(ge=1)]
NonNegative = Annotated[float, Field(ge=0)]
Name = Annotated[str, Field(min_length=1)]


class ConfigError(ValueError):
    """A configuration that was refused; the message names key, value and rule."""


@dataclass(frozen=True, config=STRICT)
class ModelConfig:
    """The policy's representation and network (appendix A.1, D.1.2).

    The settings of the event VAE (`EVAE_SETTINGS`) are None for a policy without one, `hidden`
    for one whose network has fixed sizes.
    """

    name: str
    context: Annotated[int, Field(ge=8, le=8192, multiple_of=2)] | None
    latent: Annotated[int, Field(ge=1, le=256)] | None
    norm: Literal["batch", "none"] | None
    target: Literal["signed", "occupancy"] | None
    time_bins: Annotated[int, Field(ge=2, le=65536)] | None
    stack: Annotated[int, Field(ge=1, le=32)]
    hidden: list[Count] | None

    @pydantic.model_validator(mode="after")
    def _fits_its_kind(self) -> "ModelConfig":
        if self.name not in KINDS:
            raise ValueError(f"name must be one of {', '.join(KINDS)}, got {self.name!r}")
        kind = KINDS[self.name]
        wanted = {**dict.fromkeys(EVAE_SETTINGS, kind.encoder), "hidden": kind.network == "mlp"}
        for setting, wants in wanted.items():
            value = getattr(self, setting)
            if wants != (value is not None):
                rule = f"be given for {self.name}" if wants else f"be null: {self.name} has no such part"
                raise ValueError(f"{setting} must {rule}, got {value!r}")
        return self


@dataclass(frozen=True, config=STRICT)
class AlgoConfig:
    """PPO, each word as RLlib spells it (appendix D.1.2)."""

    lr: Positive
    lr_schedule: Literal["constant", "linear"]
    gamma: Fraction
    lambda_: Fraction
    clip_param: Positive
    num_epochs: Count
    minibatch_size: Count
    train_batch_size_per_learner: Count
    vf_loss_coeff: NonNegative
    entropy_coeff: NonNegative
    grad_clip: Positive
    reward_scale: Positive
    num_envs_per_env_runner: Count
    num_env_runners: Annotated[int, Field(ge=0, le=10_000)]

    @pydantic.model_validator(mode="after")
    def _minibatch_fits(self) -> "AlgoConfig":
        if self.minibatch_size > self.train_batch_size_per_learner:
            raise ValueError("minibatch_size must not exceed train_batch_size_per_learner")
        return self


@dataclass(frozen=True, config=STRICT)
class CollectConfig:
    """Which flights fill the data set of the event VAE."""

    scenes: Annotated[list[Name], Field(min_length=1)]
    num_steps: Count
    num_validation_steps: Count
    policy: str | None
    policy_share: Fraction


@dataclass(frozen=True, config=STRICT)
class PretrainConfig:
    """How the event VAE is trained (appendix B.2)."""

    encoder: str | None
    iterations: Count
    batch_windows: Count
    window_events: Count
    windows: Literal["mixed", "count"]
    lr: Positive
    weight_decay: NonNegative
    beta: NonNegative
    beta_schedule: Literal["appendix", "constant"]
    validate_every: Count
    checkpoint_every: Count


@dataclass(frozen=True, config=STRICT)
class TrainConfig:
    """How long the policy is trained and how often it is saved."""

    env_steps: Count
    checkpoint_every: Count


@dataclass(frozen=True, config=STRICT)
class EvaluateConfig:
    """On how many held-out corridors, and drawn by which renderers."""

    episodes: Count
    renderers: Annotated[list[Literal["raycast", "pyrender"]], Field(min_length=1)]
    pyrender_episodes: Count
    action: Literal["deterministic", "stochastic"]
    video: bool


@dataclass(frozen=True, config=STRICT)
class SweepConfig:
    """Which policies fly through which changes, `trials` corridors for each training.

    Attributes:
        scene: Where they fly unless an axis changes it.
        policies: Each "pretrained" (all of models/pretrained), "newest", a bound, or a path.
        axes: Name -> setting -> values. The first setting names the points of the axis; others
            have as many values, or one that stays.
        reference: The group that paired differences are taken against.
    """

    scene: Name
    policies: Annotated[list[Name], Field(min_length=1)]
    axes: dict[AxisName, Axis]
    trials: Count
    reference: Name


@dataclass(frozen=True, config=STRICT)
class TradeConfig:
    """What the simulator's accuracy is measured on, and how often its cost."""

    scenes: Annotated[list[Name], Field(min_length=1)]
    control_hz: Annotated[list[Positive], Field(min_length=1)]
    flights: Count
    steps: Count
    rounds: Count


@dataclass(frozen=True, config=STRICT)
class TradeEncoderConfig:
    """How long the encoders that are compared are trained, and on what they are measured."""

    iterations: Count
    seeds: Count
    windows: Annotated[int, Field(ge=4)]
    rounds: Count


@dataclass(frozen=True, config=STRICT)
class ClusterConfig:
    """Where Ray runs."""

    name: Literal["local", "ray"]
    address: str | None
    num_cpus: Count | None


@dataclass(frozen=True, config=STRICT)
class TrackingConfig:
    """Where results are recorded."""

    uri: Name
    experiment: Name


@dataclass(frozen=True, config=STRICT)
class Config:
    """One experiment, checked."""

    job: Literal[
        "pipeline",
        "collect",
        "pretrain",
        "train",
        "evaluate",
        "sweep",
        "report",
        "trade_simulator",
        "trade_encoder",
    ]
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
    model: ModelConfig
    algo: AlgoConfig
    collect: CollectConfig
    pretrain: PretrainConfig
    train: TrainConfig
    evaluate: EvaluateConfig
    sweep: SweepConfig
    trade: TradeConfig
    trade_encoder: TradeEncoderConfig
    cluster: ClusterConfig
    tracking: TrackingConfig

    def env_config(self, **changes: Any) -> EnvConfig:
        """The simulation that this experiment flies, with some of its fields replaced."""
        parts = {name: getattr(self, name) for name in ENV_PARTS}
        return EnvConfig(**{**self.env, **parts, **changes})


EVAE_SETTINGS = ("context", "latent", "norm", "target", "time_bins")
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
    parts["env"] = world = _build(EnvConfig, values.get("env"), "env", refused)
    if world is not None:  # 100 and 100.0 become the same setting, so that they name the same run
        parts["env"] = {name: getattr(world, name) for name in ENV_KEYS}
    refused_parts = [name for name, part in parts.items() if part is None]
    config = _build(Config, {**values, **parts}, "", refused, refused_parts)
    if not refused:
        named = [("env.scene", config.env["scene"]), ("sweep.scene", config.sweep.scene)]
        named += [("evaluate", HELD_OUT_SCENE)]
        named += [("trade.scenes", name) for name in config.trade.scenes]
        named += [("collect.scenes", name) for name in config.collect.scenes]
        swept = itertools.chain(*(axis.get("env.scene", []) for axis in config.sweep.axes.values()))
        named += [("sweep.axes", name) for name in dict.fromkeys(swept) if isinstance(name, str)]
        vehicle = config.env["vehicle_radius_m"], config.env["camera_height_m"]
        refused = _refused_picture(config) + refused_axes(config.sweep.axes, config.env_config())
        refused += refused_scenes(named, config.env["layout"], vehicle)
    if refused:
        raise ConfigError("\n".join(refused))
    return typing.cast(Config, config)


def known_keys() -> list[str]:
    """Every key that a configuration may have."""
    keys = [field.name for field in dataclasses.fields(Config)]
    for name, section in SECTIONS.items():
        keys += [f"{name}.{field.name}" for field in dataclasses.fields(typing.cast(Any, section))]
    return keys + [f"env.{name}" for name in ENV_KEYS]


def as_dict(config: Config) -> dict[str, Any]:
    """The configuration as plain containers, for files and trackers."""
    return dataclasses.asdict(typing.cast(Any, config))


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
        refused += [line for line in explain(error, name, known_keys()) if line.partition(":")[0] not in skip]
        return None


def _refused_picture(config: Config) -> list[str]:
    """Sides of the sensor's picture that the policy's network cannot take."""
    if KINDS[config.model.name].network != "cnn" and config.model.name != "eivae":
        return []
    sides = {name: getattr(config.camera, name) for name in ("width", "height")}
    rule = f"must be at least {SMALLEST_IMAGE} for the network of {config.model.name}"
    return [f"camera.{name}: {rule}, got {side}" for name, side in sides.items() if side < SMALLEST_IMAGE]
