"""What a sweep evaluates: every policy under every condition, each pair as one task."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import pydantic

from envs.config import EnvConfig, settings_hash
from jobs.config.conditions import NOMINAL, Condition, Setting, axis_points, moving_settings
from jobs.config.config import Config, ConfigError
from jobs.config.env_keys import env_with
from jobs.config.schema import SweepConfig
from jobs.evaluation.met import met
from jobs.rollout.policies import Differences, EvaluatedPolicy, own_sensor_differences, with_sensor
from jobs.rollout.tasks import EvaluationTask, make_task

Place = tuple[str, str]  # axis and value of a condition
Axes = dict[str, dict[str, Condition]]  # axis -> value as text -> settings that it changes


@dataclass(frozen=True)
class Sweep:
    """All that a sweep evaluates.

    Attributes:
        policies: Groups together, in the order in which they were named.
        differences: Agent -> where its own sensor, with which it is evaluated, is not the configured one.
        axes: The first axis is `NOMINAL`.
        tasks: One for each policy and condition; two may share a key.
        met: Axis, value and group of those that lie within what a training of the group drew.
        baselines: Condition -> what it is compared with, see `baselines_of`.
        own_baselines: Group -> the same for its own sensor and control rate, where they differ.
        same_as: Condition -> the first one that is the same simulation for every policy.
    """

    policies: tuple[EvaluatedPolicy, ...]
    differences: dict[str, Differences]
    axes: Axes
    tasks: tuple[EvaluationTask, ...]
    met: frozenset[tuple[str, str, str]] = frozenset()
    baselines: Mapping[Place, Place] = field(default_factory=dict)
    own_baselines: Mapping[str, Mapping[Place, Place]] = field(default_factory=dict)
    same_as: Mapping[Place, Place] = field(default_factory=dict)

    @property
    def identity(self) -> str:
        """Hash of all that decides its metrics: policies, conditions and corridors."""
        facts = [[*task.condition, task.key, *task.seeds] for task in self.tasks]
        return settings_hash({"cells": facts})  # the word of earlier versions, whose sweeps go on

    @property
    def groups(self) -> dict[str, list[int | None]]:
        """Group -> its training seeds."""
        found: dict[str, list[int | None]] = {}
        for policy in self.policies:
            found.setdefault(policy.group, []).append(policy.training)
        return found

    @property
    def conditions(self) -> list[tuple[str, str]]:
        """Axis and value of each condition."""
        return [(axis, value) for axis, points in self.axes.items() for value in points]


def plan_sweep(config: Config, policies: Sequence[EvaluatedPolicy]) -> Sweep:
    """The tasks of a sweep: a policy keeps its own sensor, and each condition changes settings of that.

    Raises:
        ConfigError: If a policy's own sensor and a changed setting exclude each other.
    """
    configured = dataclasses.replace(config.env, scene=config.sweep.scene, split=config.sweep.split)
    axes = axes_of(config.sweep)
    tasks = [
        make_task(
            (axis, value),
            policy,
            config.evaluate.action,
            _changed_env(policy, with_sensor(configured, policy.sensor), axis, changes),
            config.sweep.trials,
        )
        for policy in policies
        for axis, points in axes.items()
        for value, changes in points.items()
    ]
    differences = {policy.agent: own_sensor_differences(policy, configured) for policy in policies}
    nominal = {task.policy.name: task.env for task in tasks if task.condition[0] == NOMINAL}
    within = frozenset(
        (*task.condition, task.policy.group)
        for task in tasks
        if was_met(task.policy, nominal[task.policy.name], task.env)
    )
    own = {agent: found for agent, found in differences.items() if found}
    usual = baselines_of(configured, axes)
    # Of each group that of its first training.
    envs = {policy.group: with_sensor(configured, policy.sensor) for policy in reversed(policies)}
    baselines = {group: baselines_of(env, axes) for group, env in envs.items()}
    return Sweep(
        tuple(policies),
        own,
        axes,
        tuple(tasks),
        within,
        baselines=usual,
        own_baselines={group: found for group, found in baselines.items() if found != usual},
        same_as=same_for_all([same_simulations(env, axes) for env in (configured, *envs.values())]),
    )


def axes_of(settings: SweepConfig) -> Axes:
    """The axes of a sweep; the first is `NOMINAL`."""
    axes: Axes = {NOMINAL: {settings.scene: {}}}
    for name, axis in settings.axes.items():
        axes[name] = {value_text(next(iter(point.values()))): point for point in axis_points(axis)}
    return axes


def same_simulations(configured: EnvConfig, axes: Axes) -> dict[Place, Place]:
    """Condition -> the first condition that is the same simulation, often itself."""
    every = {(axis, value): changes for axis, points in axes.items() for value, changes in points.items()}
    envs = {at: env_with(configured, changes) for at, changes in every.items()}
    return {at: next(first for first, other in envs.items() if other == env) for at, env in envs.items()}


def same_for_all(found: Sequence[Mapping[Place, Place]]) -> dict[Place, Place]:
    """Condition -> the first one that is the same simulation in each of several `same_simulations`."""
    first: dict[tuple[Place, ...], Place] = {}
    return {at: first.setdefault(tuple(same[at] for same in found), at) for at in found[0]}


def baselines_of(configured: EnvConfig, axes: Axes) -> dict[Place, Place]:
    """Condition -> the condition that it is compared with, to see what the axis itself changes.

    That is the one in which only those settings are changed that stay the same along the axis: the same
    scene at the usual rate for rates in a dense scene. It is the nominal one where the sweep has none such.
    """
    every = {(axis, value): changes for axis, points in axes.items() for value, changes in points.items()}
    envs = {at: env_with(configured, changes) for at, changes in every.items()}
    nominal = next(iter(every))
    found = {}
    for axis, points in axes.items():
        moving = moving_settings(points) if len(points) > 1 else list(next(iter(points.values())))
        for value, changes in points.items():
            kept = {key: setting for key, setting in changes.items() if key not in moving}
            env = env_with(configured, kept)
            found[axis, value] = next((at for at, other in envs.items() if other == env), nominal)
    return found


def was_met(policy: EvaluatedPolicy, nominal: EnvConfig, cell: EnvConfig) -> bool:
    """Whether a cell lies within what a policy's training drew; of baselines none does."""
    if not policy.conditions:
        return False
    trained = with_sensor(EnvConfig(**policy.world), policy.sensor)
    return met(policy.conditions, trained, nominal, cell)


def _changed_env(
    policy: EvaluatedPolicy, own: EnvConfig, axis: str, changes: Mapping[str, Setting]
) -> EnvConfig:
    try:
        return env_with(own, changes)
    except pydantic.ValidationError as error:
        reason = error.errors()[0]["msg"]
        raise ConfigError(
            f"sweep.axes.{axis}: {dict(changes)} with the sensor of {policy.agent!r}: {reason}"
        ) from None


def value_text(value: Setting) -> str:
    """A value of an axis as text, different for every value."""
    if not isinstance(value, int | float):
        return "null" if value is None else value
    short = f"{value:g}"
    return short if float(short) == value else repr(value)
