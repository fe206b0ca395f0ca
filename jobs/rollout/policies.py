"""Policies by name: find the folder of a name, read its manifest, apply its sensor settings."""

import hashlib
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from envs.config import EnvConfig, sensor_differences, settings_hash
from jobs.config.config import Config, ConfigError
from jobs.config.env_keys import ENV_KEYS, env_with
from jobs.config.plugins import changed_plugins, load_plugins, one_line, plugin_digests
from jobs.rollout.agents import BASELINES, ONNX, make_agent
from jobs.run.folder import Run, latest_policies, named_policy
from jobs.run.progress import console
from models.kinds import find_kind, needed_plugins
from models.policy.policy import (
    MANIFEST,
    PRETRAINED,
    Policy,
    PolicyFileError,
    load_policy,
    read_policy_manifest,
)

SENSOR_KEYS = {path[-1]: key for key, path in ENV_KEYS.items() if path[0] != "faults"}  # setting -> its key
FILTER = ("filter_support", "filter_tau_us")
KINEMATIC: dict[str, Any] = {"vehicle": "kinematic", "body": {}}
Differences = dict[str, tuple[object, object]]  # sensor setting -> (the policy's value, the environment's)


@dataclass(frozen=True)
class EvaluatedPolicy:
    """A policy or a baseline that is evaluated.

    Attributes:
        agent: Path of a policy folder, or what else `make_agent` takes.
        group: Name of the experiment; policies of one group differ only in their training seed.
        training: The training seed; None for a baseline and a policy that was not trained here.
        identity: Hash of its manifest, which holds the SHA-256 sums of its files.
        sensor: Sensor settings of its training; empty for a baseline and a policy that was not trained here.
        observation: The observation that it needs, as `EnvConfig.observation`.
        world: Scene, layout and faults of its training; empty if the manifest lacks them.
        conditions: Conditions that its training drew from, as in `jobs.config.schema.TrainConfig`.
    """

    agent: str
    group: str
    training: int | None
    identity: str
    sensor: Mapping[str, Any]
    observation: str
    world: Mapping[str, Any] = field(default_factory=dict)
    conditions: Sequence[Mapping[str, Any]] = ()

    @property
    def name(self) -> str:
        """Return group and training: "bytestream s0"."""
        return self.group if self.training is None else f"{self.group} s{self.training}"


def read_policy(agent: str) -> EvaluatedPolicy:
    """Read a policy folder's manifest; a baseline has only its name.

    Raises:
        ConfigError: If the manifest is damaged, or lacks the name, the seed or the sensor.
    """
    if agent in BASELINES:
        return EvaluatedPolicy(agent, agent, None, agent, {}, "none")
    try:
        manifest = read_policy_manifest(Path(agent) / MANIFEST)
    except PolicyFileError as error:
        raise ConfigError(f"policy: {error}") from None
    missing = [name for name in ("name", "seed", "sensor") if name not in manifest]
    if missing:
        raise ConfigError(f"policy: the manifest of {agent!r} lacks {missing}; train it again")
    changed = changed_plugins(manifest.get("plugins") or {})
    if changed:
        said = f"{', '.join(changed)} changed since the training of {agent}; its results may differ from then"
        console.print(f"Plug-in {said}", markup=False)
    group = str(manifest.get("exp", manifest["name"]))
    try:
        identity, observation = settings_hash(manifest), find_kind(manifest["name"]).observation
    except ValueError as error:
        raise ConfigError(f"policy: {agent!r}: {error}{needed_plugins(manifest)}") from None
    # Manifests of earlier versions have the conditions among the settings of their training, or have none:
    # those policies were trained in the unchanged simulation.
    named = manifest.get("conditions") or manifest.get("train", {}).get("conditions")
    seed, sensor, world = int(manifest["seed"]), manifest["sensor"], manifest.get("world", {})
    return EvaluatedPolicy(agent, group, seed, identity, sensor, observation, world, named or [{}])


def read_foreign(name: str) -> EvaluatedPolicy:
    """Return a policy that was not trained here: an ONNX file, or a function "file.py:attribute".

    A package's folder may replace the Python file. All its files, weights too, are sent to the workers and
    hashed into the identity.

    Raises:
        ConfigError: There is no such file, module or attribute, or it cannot be loaded.
    """
    place, _, attribute = name.rpartition(":")
    if name.endswith(ONNX):
        path = Path(name).resolve()
        if not path.is_file():
            raise ConfigError(f"policy: must be an ONNX file that exists, got {name!r}")
        agent, identity = str(path), hashlib.sha256(path.read_bytes()).hexdigest()[:12]
    else:
        load_plugins([place])
        module = Path(place).resolve().stem if place.endswith(".py") or os.sep in place else place
        agent, identity = f"{module}:{attribute}", plugin_digests()[module]
    try:
        observation = make_agent(agent).observation
    except Exception as error:
        raise ConfigError(f"policy: {name!r} cannot be loaded: {one_line(error)}") from error
    group = Path(name).stem if name.endswith(ONNX) else attribute
    return EvaluatedPolicy(agent, group, None, identity, {}, observation)


def find_policy(config: Config, run: Run) -> EvaluatedPolicy:
    """Return the policy of a run folder, or else the newest policy of its model in `runs_dir`.

    Raises:
        ConfigError: If there is none; the message names the models that have a trained policy.
    """
    if (run.policy / MANIFEST).is_file():
        return read_policy(str(run.policy))
    name, newest = run.config.model.name, latest_policies(config.runs_dir)
    if name not in newest:
        where = f"no trained policy of {name} in {str(Path(config.runs_dir).resolve())!r}"
        others = f" (there is one of {', '.join(sorted(newest))}: take model=)" if newest else ""
        train = "run python -m platform.launch +exp=bytestream"
        raise ConfigError(f"{where}{others}: {train} model={name}")
    return read_policy(str(newest[name]))


def find_policies(key: str, name: str, config: Config, run: Run) -> list[EvaluatedPolicy]:
    """Return the policies and baselines that a name stands for.

    The name of a group of published policies, such as bytestream, means all its trainings: bytestream-s0,
    bytestream-s1, ...

    Args:
        key: Key of the name in the configuration, for messages.
        name: "pretrained", "newest", a baseline, a folder, or a name in models/pretrained.
        config: Configuration of the experiment.
        run: Its run folder.

    Raises:
        ConfigError: If there is no such policy.
    """
    published = sorted(path.parent for path in PRETRAINED.glob(f"*/{MANIFEST}"))
    if name == "pretrained":
        if not published:
            raise ConfigError(
                f"{key}: 'pretrained' means the policies in {str(PRETRAINED)!r}, which holds none; "
                f"train one (python -m platform.launch +exp=bytestream) and name it: {key}=[newest]"
            )
        return [read_policy(str(path)) for path in published]
    if name == "newest":
        return [find_policy(config, run)]
    if name in BASELINES:
        return [read_policy(name)]
    path = named_policy(name) or named_policy(str(PRETRAINED / name))
    group = [path for path in published if re.fullmatch(re.escape(name) + r"-s\d+", path.name)]
    trainings = group if path is None else [path]
    if not trainings:
        places = "a name or a group in models/pretrained, a policy folder or a run folder"
        raise ConfigError(
            f"{key}: must be 'pretrained', 'newest', one of {tuple(BASELINES)}, {places}, got {name!r}"
        )
    return [read_policy(str(path)) for path in trainings]


def find_one_policy(key: str, name: str, config: Config, run: Run) -> EvaluatedPolicy:
    """Return the one trained policy that a name stands for; arguments as `find_policies`.

    Raises:
        ConfigError: If there is none; the message names the published policies.
    """
    published = sorted(path.parent.name for path in PRETRAINED.glob(f"*/{MANIFEST}"))
    if name != "newest" and name not in published and named_policy(name) is None:
        names = ", ".join(published)
        raise ConfigError(
            f"{key}: must be one trained policy: newest, a path, or in models/pretrained one of {names}, "
            f"got {name!r}"
        )
    return find_policies(key, name, config, run)[0]


def find_study_policies(config: Config, run: Run) -> tuple[EvaluatedPolicy, ...]:
    """Return the policies that `study.policies` names, without duplicates, sorted by group and seed.

    Groups are in the order of the names.

    Raises:
        ConfigError: If there is no such policy, or two have the same group and training seed.
    """
    named = [
        policy
        for name in config.own.policies
        for policy in find_policies("study.policies", name, config, run)
    ]
    policies = list({policy.identity: policy for policy in named}.values())
    first: dict[str, EvaluatedPolicy] = {}
    for policy in policies:
        other = first.setdefault(policy.name, policy)
        if other is not policy:
            raise ConfigError(
                f"study.policies: two policies are {policy.group} with training seed {policy.training}, got "
                f"{other.agent!r} and {policy.agent!r}; leave one out, or train one with another seed"
            )
    order = list(dict.fromkeys(policy.group for policy in policies))
    return tuple(sorted(policies, key=lambda policy: (order.index(policy.group), policy.training or 0)))


def load_trained(key: str, name: str, env: EnvConfig) -> tuple[Path, Policy]:
    """Load the policy that a key of the configuration names; return its folder and the policy.

    Raises:
        ConfigError: The policy is missing, is damaged, or was trained with another sensor.
    """
    path = named_policy(name)
    if path is None:
        raise ConfigError(f"{key}: must be a run folder or a policy folder, got {name!r}")
    try:
        policy = load_policy(path)
        check_sensor(policy.manifest["sensor"], env)
    except ValueError as error:
        raise ConfigError(f"{key}: {error}") from error
    return path, policy


def with_sensor(env: EnvConfig, sensor: Mapping[str, Any]) -> EnvConfig:
    """Return the simulation with a manifest's sensor settings, which have the names of `sensor_settings`.

    If the manifest names no vehicle, it is the kinematic one. If the vehicle differs from the configured one,
    the time limit is scaled so that the vehicle can cover the same distance at its own speed.

    Raises:
        pydantic.ValidationError: If a setting is unknown or its value is out of range.
    """
    usual = replace(env, **KINEMATIC) if sensor else env
    own = env_with(usual, {SENSOR_KEYS.get(name, name): value for name, value in sensor.items()})
    if own.vehicle == env.vehicle:
        return own
    return replace(own, time_limit_s=env.time_limit_s * env.speed_mps / own.speed_mps)


def with_own_parts(policy: EvaluatedPolicy, env: EnvConfig) -> EnvConfig:
    """Return the simulation with a policy's neighbour filter and vehicle.

    Both are parts of the policy. If the simulation already has the vehicle, its body stays unchanged.
    """
    own = {name: policy.sensor[name] for name in FILTER if name in policy.sensor}
    vehicle = {name: policy.sensor.get(name, usual) for name, usual in KINEMATIC.items()}
    same = not policy.sensor or vehicle["vehicle"] == env.vehicle
    return replace(env, **own, **({} if same else vehicle))


def own_sensor_differences(policy: EvaluatedPolicy, env: EnvConfig) -> Differences:
    """Return the sensor settings in which training and environment differ; none for a baseline."""
    return sensor_differences(policy.sensor, env) if policy.sensor else {}


def check_sensor(sensor: Mapping[str, Any], env: EnvConfig) -> None:
    """Check that the environment has the sensor settings of a policy's training.

    Raises:
        ValueError: If a setting differs; the message names both values.
    """
    differ = sensor_differences(sensor, env)
    if differ:
        got = "; ".join(f"{key} = {ours!r} instead of {theirs!r}" for key, (theirs, ours) in differ.items())
        raise ValueError(f"the sensor must be the policy's, got {got}; the study job evaluates such changes")
