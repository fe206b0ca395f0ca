"""Plan a study: every policy under every condition, each pair as one task."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pydantic

from envs.config import EnvConfig, settings_hash
from jobs.config.conditions import NOMINAL, axis_points, moving_settings
from jobs.config.config import Config, ConfigError
from jobs.config.env_keys import env_with
from jobs.rollout.met import was_met
from jobs.rollout.policies import Differences, EvaluatedPolicy, own_sensor_differences, with_sensor
from jobs.rollout.tasks import EvaluationTask, make_task, text_of
from jobs.study.results import Condition, Value

Axes = Mapping[str, Mapping[Value, Mapping[str, Any]]]  # axis -> value -> settings that it changes


@dataclass(frozen=True)
class Plan:
    """All evaluation tasks of a study.

    Attributes:
        policies: The policies of each group side by side, groups in the order in which they were named.
        differences: Agent -> settings in which its own sensor, used to evaluate it, differs from the
            configured one.
        axes: Axis -> its points; the first axis is `NOMINAL`.
        tasks: One for each policy and condition; two may share a key.
        met: Conditions that lie within the training distribution of a group, each with that group.
        baselines: Condition -> the condition it is compared with, see `baselines_of`.
        own_baselines: Group -> `baselines` for its own sensor and control rate, if they differ.
        same_as: Condition -> the first condition that is the same simulation for every policy.
    """

    policies: tuple[EvaluatedPolicy, ...]
    differences: dict[str, Differences]
    axes: Axes
    tasks: tuple[EvaluationTask, ...]
    met: frozenset[tuple[Condition, str]]
    baselines: Mapping[Condition, Condition]
    own_baselines: Mapping[str, Mapping[Condition, Condition]]
    same_as: Mapping[Condition, Condition]

    @property
    def identity(self) -> str:
        """Return the hash of everything that determines the metrics.

        Its format is frozen, so that studies begun by an earlier version can resume.
        """
        facts = [[*map(text_of, task.condition), task.key, *task.seeds] for task in self.tasks]
        return settings_hash({"cells": facts})

    @property
    def groups(self) -> dict[str, list[int | None]]:
        """Return group -> its training seeds."""
        found: dict[str, list[int | None]] = {}
        for policy in self.policies:
            found.setdefault(policy.group, []).append(policy.training)
        return found

    @property
    def conditions(self) -> list[Condition]:
        """Return axis and value of each condition."""
        return conditions_of(self.axes)


def plan_study(config: Config, policies: Sequence[EvaluatedPolicy]) -> Plan:
    """Plan the tasks of a study. Each condition changes settings of the policy's own sensor.

    Raises:
        ConfigError: A policy's own sensor and a changed setting exclude each other.
    """
    study = config.own
    configured = dataclasses.replace(config.env, scene=study.scene, split=study.split)
    axes = axes_of(study.scene, study.axes)
    tasks = [
        make_task(
            (axis, value),
            policy,
            config.evaluate.action,
            _changed_env(policy, with_sensor(configured, policy.sensor), axis, changes),
            study.trials,
        )
        for policy in policies
        for axis, points in axes.items()
        for value, changes in points.items()
    ]
    differences = {policy.agent: own_sensor_differences(policy, configured) for policy in policies}
    usual = baselines_of(configured, axes)
    # One environment for each group, with the sensor of its first training.
    envs = {policy.group: with_sensor(configured, policy.sensor) for policy in reversed(policies)}
    baselines = {group: baselines_of(env, axes) for group, env in envs.items()}
    return Plan(
        tuple(policies),
        {agent: found for agent, found in differences.items() if found},
        axes,
        tuple(tasks),
        _met(tasks),
        baselines=usual,
        own_baselines={group: found for group, found in baselines.items() if found != usual},
        same_as=same_for_all([same_simulations(env, axes) for env in (configured, *envs.values())]),
    )


def axes_of(scene: str, axes: Mapping[str, Mapping[str, Sequence[Any]]]) -> dict[str, dict[Value, Any]]:
    """Return axis -> value -> changed settings; the first axis is `NOMINAL`, with the study's scene."""
    found: dict[str, dict[Value, Any]] = {NOMINAL: {scene: {}}}
    for name, axis in axes.items():
        points = axis_points(axis)
        found[name] = {_value(next(iter(point.values()))): point for point in points}
    return found


def _value(value: object) -> Value:
    return value if isinstance(value, int | float) else text_of(value)


def conditions_of(axes: Axes) -> list[Condition]:
    """Return axis and value of each condition."""
    return [(axis, value) for axis, points in axes.items() for value in points]


def _envs(configured: EnvConfig, axes: Axes) -> dict[Condition, EnvConfig]:
    """Return condition -> its simulation."""
    return {
        (axis, value): env_with(configured, dict(axes[axis][value])) for axis, value in conditions_of(axes)
    }


def same_simulations(configured: EnvConfig, axes: Axes) -> dict[Condition, Condition]:
    """Return condition -> the first condition with the same simulation, often the condition itself."""
    envs = _envs(configured, axes)
    return {at: next(first for first, other in envs.items() if other == env) for at, env in envs.items()}


def same_for_all(found: Sequence[Mapping[Condition, Condition]]) -> dict[Condition, Condition]:
    """Combine several `same_simulations`: conditions are the same only if they are in all of them."""
    first: dict[tuple[Condition, ...], Condition] = {}
    return {at: first.setdefault(tuple(same[at] for same in found), at) for at in found[0]}


def baselines_of(configured: EnvConfig, axes: Axes) -> dict[Condition, Condition]:
    """Return condition -> its baseline, which isolates the effect of the axis.

    The baseline changes only the settings that are constant along the axis. For control rates in a dense
    scene, it is the dense scene at the usual rate. If the study lacks such a condition, the baseline is the
    nominal condition.
    """
    envs = _envs(configured, axes)
    nominal = next(iter(envs))
    found = {}
    for axis, points in axes.items():
        by_text = {text_of(value): changes for value, changes in points.items()}
        moving = moving_settings(by_text) if len(points) > 1 else list(next(iter(points.values())))
        for value, changes in points.items():
            kept = {key: setting for key, setting in changes.items() if key not in moving}
            env = env_with(configured, kept)
            found[axis, value] = next((at for at, other in envs.items() if other == env), nominal)
    return found


def _met(tasks: Sequence[EvaluationTask]) -> frozenset[tuple[Condition, str]]:
    nominal = {task.policy.name: task.env for task in tasks if task.condition[0] == NOMINAL}
    return frozenset(
        (task.condition, task.policy.group)
        for task in tasks
        if was_met(task.policy, nominal[task.policy.name], task.env)
    )


def _changed_env(policy: EvaluatedPolicy, own: EnvConfig, axis: str, changes: Mapping[str, Any]) -> EnvConfig:
    try:
        return env_with(own, dict(changes))
    except pydantic.ValidationError as error:
        reason = error.errors()[0]["msg"]
        raise ConfigError(
            f"study.axes.{axis}: {dict(changes)} with the sensor of {policy.agent!r}: {reason}"
        ) from None
