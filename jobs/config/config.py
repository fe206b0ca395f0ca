"""Every setting of an experiment, checked; the values are in conf/, their ranges in `jobs.config.schema`.

`parse` turns the composed configuration into one frozen `Config`, or raises one `ConfigError`
with a line for each wrong key. Nothing has been started or written by then.
"""

import dataclasses
import itertools
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Annotated, Literal, TypeVar

import pydantic
from pydantic import AfterValidator, Field
from pydantic.dataclasses import dataclass
from pydantic_core import ErrorDetails

from envs.config import STRICT, EnvConfig
from jobs.config.conditions import axis_errors, condition_errors
from jobs.config.env_keys import BESIDE_ENV, ENV_GROUPS, ENV_KEYS, fields_of, flat_env, key_of
from jobs.config.errors import SET_BY_JOBS, ConfigError, nearest, redacted
from jobs.config.plugins import load_plugins
from jobs.config.registry import JOBS
from jobs.config.scenes import scene_errors
from jobs.config.schema import (
    AblationConfig,
    AlgoConfig,
    CalibrateConfig,
    ClusterConfig,
    CollectConfig,
    DemoConfig,
    EvaluateConfig,
    Name,
    PretrainConfig,
    ProbeConfig,
    ReplayConfig,
    ReplayPageConfig,
    SlidingConfig,
    SweepConfig,
    TrackingConfig,
    TradeConfig,
    TradeEncoderConfig,
    TradeSimulatorConfig,
    TrainConfig,
    TuneConfig,
    VideoConfig,
)
from models.kinds import KINDS, Model, model_keys, read_model

__all__ = ["HELD_OUT_SCENE", "Config", "ConfigError", "as_dict", "known_keys", "parse"]

HELD_OUT_SCENE = "poles_eval"  # never trained on: wider, and laid out at random
TRAINED_SCENE = "poles"  # which it is held out of

Part = TypeVar("Part")


def _job(name: str) -> str:
    if name not in JOBS:
        raise ValueError(f"must be one of {', '.join(JOBS)}, got {name!r}")
    return name


@dataclass(frozen=True, config=STRICT)
class Config:
    """One experiment, checked. `env` is the simulation as it is handed on to whatever needs one."""

    job: Annotated[str, AfterValidator(_job)]
    exp: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")]
    budget: Literal["smoke", "short", "paper"]
    seed: Annotated[int, Field(ge=0, lt=2**31)]
    resume: str | None
    runs_dir: Name
    env: EnvConfig
    model: Model
    algo: AlgoConfig
    demo: DemoConfig
    replay: ReplayConfig
    video: VideoConfig
    calibrate: CalibrateConfig
    sliding: SlidingConfig
    replay_page: ReplayPageConfig
    collect: CollectConfig
    pretrain: PretrainConfig
    train: TrainConfig
    evaluate: EvaluateConfig
    sweep: SweepConfig
    trade: TradeConfig
    trade_simulator: TradeSimulatorConfig
    trade_encoder: TradeEncoderConfig
    probe: ProbeConfig
    tune: TuneConfig
    ablation: AblationConfig
    cluster: ClusterConfig
    tracking: TrackingConfig
    plugins: list[Name]


SECTIONS = {
    name: section
    for name, section in fields_of(Config).items()
    if dataclasses.is_dataclass(section) and section is not EnvConfig
}


def parse(values: Mapping[str, object]) -> Config:
    """Check a composed configuration.

    Args:
        values: Plain containers, as `conf/` composes them or `as_dict` returns them.

    Raises:
        ConfigError: With one line per wrong key: the key, the rule, the value received.
    """
    errors: list[str] = []
    load_plugins(values.get("plugins"))
    parts: dict[str, object] = {"env": _env(values, errors)}
    parts |= {name: _section(section, values.get(name), name, errors) for name, section in SECTIONS.items()}
    parts["model"] = _section(read_model, values.get("model"), "model", errors)
    top = {name: value for name, value in values.items() if name not in (*BESIDE_ENV, "name")}
    top |= {} if values.get("name") is None else {"exp": values["name"]}
    wrong = [name for name, part in parts.items() if part is None]
    config = _build(Config, {**top, **parts}, "", errors, skip=wrong)
    if config is not None and not errors:
        errors += [
            *_image_errors(config),
            *axis_errors(config.sweep.axes, config.env),
            *condition_errors("train.conditions", config.train.conditions, config.env),
            *condition_errors("collect.conditions", config.collect.conditions, config.env),
            *_size_errors(config),
            *scene_errors(list(_named_scenes(config)), config.env),
        ]
    if config is None or errors:
        raise ConfigError("\n".join(errors))
    return config


def as_dict(config: Config) -> dict[str, object]:
    """The configuration as plain containers in the groups of conf/, without the tracker's password."""
    tracking = dataclasses.replace(config.tracking, uri=redacted(config.tracking.uri))
    values: dict[str, object] = {}
    for name, value in dataclasses.asdict(dataclasses.replace(config, tracking=tracking)).items():
        values |= flat_env(config.env) if name == "env" else {name: value}
    return values


def known_keys() -> list[str]:
    """Every key that a configuration may have."""
    keys = [*fields_of(Config), "name", *ENV_GROUPS, *ENV_KEYS]
    for name, section in SECTIONS.items():
        keys += [f"{name}.{field}" for field in fields_of(section)]
    return keys + [f"model.{name}" for name in model_keys()]


def _env(values: Mapping[str, object], errors: list[str]) -> EnvConfig | None:
    """The simulation, made of `env` and of the groups that stand beside it."""
    env = values.get("env")
    if not isinstance(env, Mapping):
        return _section(EnvConfig, env, "env", errors)
    parts = {name: _section(group, values.get(name), name, errors) for name, group in ENV_GROUPS.items()}
    misplaced = [name for name in env if name in (*BESIDE_ENV, *SET_BY_JOBS)]
    for name in misplaced:
        errors.append(f"env.{name}: no such key, got {env[name]!r}{nearest(f'env.{name}', [])}")
    fields = {name: value for name, value in env.items() if name not in misplaced}
    valid = {name: part for name, part in parts.items() if part is not None}
    built = _build(EnvConfig, {**fields, **valid, "renderer": values.get("renderer")}, "env", errors)
    return built if len(valid) == len(parts) else None


def _section(section: Callable[..., Part], values: object, name: str, errors: list[str]) -> Part | None:
    """The section made of its values; None if they are wrong, with the reasons added to `errors`."""
    if not isinstance(values, Mapping):
        errors.append(f"{name}: must be a group of settings, got {values!r}")
        return None
    return _build(section, values, name, errors)


def _build(
    section: Callable[..., Part],
    values: Mapping[str, object],
    name: str,
    errors: list[str],
    skip: Collection[str] = (),
) -> Part | None:
    """As `_section`, of a mapping; says nothing about the fields in `skip`."""
    try:
        return section(**{str(key): value for key, value in values.items()})
    except pydantic.ValidationError as error:
        problems = [problem for problem in error.errors() if not {*problem["loc"][:1]} & {*skip}]
        errors += [_line(problem, key_of(name, problem["loc"])) for problem in problems]
        return None


def _line(problem: ErrorDetails, key: str) -> str:
    """What pydantic found, as key, rule and value."""
    if problem["type"] == "unexpected_keyword_argument":
        keys = known_keys()
        hint = "; this kind of model has none" if key in keys else nearest(key, keys)
        return f"{key}: no such key, got {problem['input']!r}{hint}"
    if problem["type"] in ("missing", "missing_argument", "value_error"):
        return f"{key}: {problem['msg'].removeprefix('Value error, ')}"
    return f"{key}: {problem['msg']}, got {problem['input']!r}"


def _named_scenes(config: Config) -> Iterator[tuple[str, str]]:
    """Each scene that the configuration names, behind the key that names it."""
    yield "env.scene", config.env.scene
    yield "sweep.scene", config.sweep.scene
    yield "evaluate", HELD_OUT_SCENE
    for job in ("trade", "trade_simulator", "replay_page", "collect"):
        yield from ((f"{job}.scenes", name) for name in getattr(config, job).scenes)
    for key, conditions in (
        ("train.conditions", config.train.conditions),
        ("collect.conditions", config.collect.conditions),
    ):
        for condition in conditions:
            scenes = condition.get("env.scene", [])
            yield from ((key, scene) for scene in ([scenes] if isinstance(scenes, str) else scenes))
    swept = itertools.chain(*(axis.get("env.scene", []) for axis in config.sweep.axes.values()))
    for scene in dict.fromkeys(swept):
        if isinstance(scene, str):
            yield "sweep.axes", scene


def _size_errors(config: Config) -> Iterator[str]:
    """Lists that are too long, or empty where something is needed."""
    if not config.collect.scenes and not config.collect.recordings:
        yield "collect.scenes: must name a scene where collect.recordings is empty, got []"


def _image_errors(config: Config) -> Iterator[str]:
    """Sides of the sensor's image that are too small for the policy's network."""
    smallest = KINDS[config.model.name].min_side
    for name in ("width", "height"):
        side = getattr(config.env.camera, name)
        if side < smallest:
            rule = f"must be at least {smallest} for the network of {config.model.name}"
            yield f"camera.{name}: {rule}, got {side}"
