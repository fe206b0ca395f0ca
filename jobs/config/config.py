"""Check every setting of an experiment; the values are in conf/, their ranges in `jobs.config.schema`.

`parse` turns the composed configuration into one frozen `Config`, or raises one `ConfigError`
with a line for each wrong key. Nothing has been started or written by then.
"""

import dataclasses
import itertools
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Annotated, Any, Literal, TypeVar

import pydantic
from pydantic import AfterValidator, Field, InstanceOf
from pydantic.dataclasses import dataclass
from pydantic_core import ErrorDetails

from envs.config import STRICT, EnvConfig
from jobs.config.algorithms import Algo, algo_keys, read_algo
from jobs.config.conditions import axis_errors, condition_errors
from jobs.config.env_keys import BESIDE_ENV, ENV_GROUPS, ENV_KEYS, fields_of, flat_env, key_of
from jobs.config.errors import SET_BY_JOBS, ConfigError, nearest, redacted
from jobs.config.plugins import kind_errors, load_plugins
from jobs.config.registry import JOBS
from jobs.config.scenes import scene_errors
from jobs.config.schema import (
    ClusterConfig,
    CollectConfig,
    EvaluateConfig,
    Name,
    PretrainConfig,
    RecordingConfig,
    TrackingConfig,
    TrainConfig,
)
from models.kinds import KINDS, Model, PolicySpec, model_keys, read_model

__all__ = ["HELD_OUT_SCENE", "Config", "ConfigError", "as_dict", "known_keys", "parse"]

HELD_OUT_SCENE = "poles_eval"  # never trained on: wider, and laid out at random
TRAINED_SCENE = "poles"  # scene of trainings, from which it is held out

Part = TypeVar("Part")


def _job(name: str) -> str:
    if name not in JOBS:
        raise ValueError(f"must be one of {', '.join(JOBS)}, got {name!r}")
    return name


@dataclass(frozen=True, config=STRICT)
class Config:
    """A checked experiment: the settings that all jobs share, and those of its own job.

    Attributes:
        env: The simulation, with camera, faults, fidelity and renderer.
        own: The job's own settings, a `Settings` of its module; None if it has none.
    """

    job: Annotated[str, AfterValidator(_job)]
    exp: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")]
    budget: Literal["smoke", "short", "paper"]
    seed: Annotated[int, Field(ge=0, lt=2**31)]
    resume: str | None
    runs_dir: Name
    env: EnvConfig
    model: InstanceOf[Model]
    algo: Algo
    recording: RecordingConfig
    collect: CollectConfig
    pretrain: PretrainConfig
    train: TrainConfig
    evaluate: EvaluateConfig
    cluster: ClusterConfig
    tracking: TrackingConfig
    plugins: list[Name]
    own: Any = None


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
    parts["algo"] = _section(read_algo, values.get("algo"), "algo", errors)
    job = str(values.get("job"))
    parts |= {"own": _own(job, values, errors)} if has_own(job) else {}
    top = {name: value for name, value in values.items() if name not in (*BESIDE_ENV, "name", job)}
    top |= {} if values.get("name") is None else {"exp": values["name"]}
    wrong = [name for name, part in parts.items() if part is None]
    config = _section(Config, {**top, **parts}, "", errors, skip=wrong)
    if config is not None and not errors:
        errors += [
            *_image_errors(config),
            *kind_errors(PolicySpec(config.model, config.env.camera.width, config.env.camera.height)),
            *axis_errors(getattr(config.own, "axes", {}), config.env),
            *condition_errors("train.conditions", config.train.conditions, config.env),
            *condition_errors("collect.conditions", config.collect.conditions, config.env),
            *_size_errors(config),
            *_vehicle_errors(config),
            *scene_errors(list(_named_scenes(config)), config.env),
        ]
    if config is None or errors:
        raise ConfigError("\n".join(errors))
    return config


def as_dict(config: Config) -> dict[str, object]:
    """Return the configuration as plain containers in the groups of conf/, without the tracker's password."""
    tracking = dataclasses.replace(config.tracking, uri=redacted(config.tracking.uri))
    values: dict[str, object] = {}
    for name, value in dataclasses.asdict(dataclasses.replace(config, tracking=tracking)).items():
        values |= flat_env(config.env) if name == "env" else {name: value}
    own = values.pop("own")
    return values if own is None else {**values, config.job: own}


def known_keys() -> list[str]:
    """Return the keys that the configurations of all jobs share."""
    core = [name for name in fields_of(Config) if name != "own"]
    keys = [*core, "name", *ENV_GROUPS, *ENV_KEYS]
    for name, section in SECTIONS.items():
        keys += [f"{name}.{field}" for field in fields_of(section)]
    return [*keys, *(f"model.{name}" for name in model_keys()), *(f"algo.{name}" for name in algo_keys())]


def has_own(job: str) -> bool:
    """Whether a job has settings of its own, in a section with the job's name."""
    return job in JOBS and bool(JOBS[job].own_keys())


def keys_of_jobs() -> dict[str, str]:
    """Return the keys that only one job has: key -> job."""
    return {f"{name}.{key}": name for name, job in JOBS.items() for key in job.own_keys()}


def _own(job: str, values: Mapping[str, object], errors: list[str]) -> object:
    """Return the job's own section; None if it is wrong, with the reasons added to `errors`."""
    section = JOBS[job].settings()
    if section is None:
        errors.append(f"job: conf/job/{job}.yaml has settings, and {JOBS[job].module} has no class Settings")
        return None
    if values.get(job) is None:
        rule = f"needs its settings, which an experiment adds by `- override /job: {job}` in its defaults"
        errors.append(f"job: {job} {rule}")
        return None
    return _section(section, values[job], job, errors)


def _env(values: Mapping[str, object], errors: list[str]) -> EnvConfig | None:
    """Build the simulation from `env` and the groups camera, faults, fidelity and renderer."""
    env = values.get("env")
    if not isinstance(env, Mapping):
        return _section(EnvConfig, env, "env", errors)
    parts = {name: _section(group, values.get(name), name, errors) for name, group in ENV_GROUPS.items()}
    misplaced = [name for name in env if name in (*BESIDE_ENV, *SET_BY_JOBS)]
    for name in misplaced:
        errors.append(f"env.{name}: no such key, got {env[name]!r}{nearest(f'env.{name}', [])}")
    fields = {name: value for name, value in env.items() if name not in misplaced}
    valid = {name: part for name, part in parts.items() if part is not None}
    built = _section(EnvConfig, {**fields, **valid, "renderer": values.get("renderer")}, "env", errors)
    return built if len(valid) == len(parts) else None


def _vehicle_errors(config: Config) -> list[str]:
    """Return a line if the vehicle is invalid, has no discrete actions, or forbids algo.teacher_sight_m."""
    env = config.env
    if env.vehicle == "kinematic" and not env.body:
        return []
    from envs.vehicles.dynamics import make_dynamics  # loads numba, which takes long

    try:
        space = make_dynamics(env).action_space
    except ValueError as error:
        return [f"env.{error}"]
    if str(space).startswith("Discrete("):
        sight_m = getattr(config.algo, "teacher_sight_m", None)
        rule = f"must be null for vehicle {env.vehicle!r}, whose teacher plans to the goal line"
        return [] if sight_m is None else [f"algo.teacher_sight_m: {rule}, got {sight_m}"]
    rule = "must have discrete actions, among which policies choose, such as +env.body.primitives=15"
    return [f"env.vehicle: {rule}; the actions of {env.vehicle!r} are {space}"]


def _section(
    section: Callable[..., Part], values: object, name: str, errors: list[str], skip: Collection[str] = ()
) -> Part | None:
    """Build a section from its values; return None if they are wrong, and add the reasons to `errors`.

    Args:
        section: Class or function that is called with the values.
        values: A mapping.
        name: Name of the section, "" for the whole configuration.
        errors: Gets a line for each wrong value.
        skip: Fields whose errors are not reported.
    """
    if not isinstance(values, Mapping):
        errors.append(f"{name}: must be a group of settings, got {values!r}")
        return None
    try:
        return section(**{str(key): value for key, value in values.items()})
    except pydantic.ValidationError as error:
        problems = [problem for problem in error.errors() if not {*problem["loc"][:1]} & {*skip}]
        errors += [_line(problem, key_of(name, problem["loc"])) for problem in problems]
        return None
    except ValueError as error:
        errors.append(f"{name}.{error}")
        return None


def _line(problem: ErrorDetails, key: str) -> str:
    """Return an error of pydantic as key, rule and value."""
    if problem["type"] == "unexpected_keyword_argument":
        kind = f"; this kind of {key.partition('.')[0]} has none"
        hint = kind if key in known_keys() else unknown_key(key)
        return f"{key}: no such key, got {problem['input']!r}{hint}"
    if problem["type"] in ("missing", "missing_argument", "value_error"):
        return f"{key}: {problem['msg'].removeprefix('Value error, ')}"
    return f"{key}: {problem['msg']}, got {problem['input']!r}"


def unknown_key(key: str) -> str:
    """Return the remedy for a key that the configuration does not have: the nearest key, or the key's job."""
    of_jobs = keys_of_jobs()
    job = of_jobs.get(key) or (key if has_own(key) else None)
    return f"; a setting of the job {job}" if job else nearest(key, [*known_keys(), *of_jobs])


def _named_scenes(config: Config) -> Iterator[tuple[str, str]]:
    """Yield the key and the name of each scene in the configuration."""
    yield "env.scene", config.env.scene
    yield "evaluate", HELD_OUT_SCENE
    yield from (("collect.scenes", name) for name in config.collect.scenes)
    yield from ((f"{config.job}.scenes", name) for name in getattr(config.own, "scenes", ()))
    if hasattr(config.own, "scene"):
        yield f"{config.job}.scene", config.own.scene
    for key, conditions in (
        ("train.conditions", config.train.conditions),
        ("collect.conditions", config.collect.conditions),
    ):
        for condition in conditions:
            scenes = condition.get("env.scene", [])
            yield from ((key, scene) for scene in ([scenes] if isinstance(scenes, str) else scenes))
    swept = itertools.chain(*(axis.get("env.scene", []) for axis in getattr(config.own, "axes", {}).values()))
    for scene in dict.fromkeys(swept):
        if isinstance(scene, str):
            yield "study.axes", scene


def _size_errors(config: Config) -> Iterator[str]:
    """Yield one line if neither scenes nor recordings are given to `collect`."""
    if not config.collect.scenes and not config.collect.recordings:
        yield "collect.scenes: must name a scene where collect.recordings is empty, got []"


def _image_errors(config: Config) -> Iterator[str]:
    """Yield one line for each side of the sensor's image that is too small for the policy's network."""
    smallest = KINDS[config.model.name].min_side
    for name in ("width", "height"):
        side = getattr(config.env.camera, name)
        if side < smallest:
            rule = f"must be at least {smallest} for the network of {config.model.name}"
            yield f"camera.{name}: {rule}, got {side}"
