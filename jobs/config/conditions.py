"""Axes and conditions: settings of the simulation that change together, point by point."""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated

import pydantic
from pydantic import Field, PlainValidator

from envs.config import EnvConfig
from jobs.config.env_keys import ENV_KEYS, env_with
from jobs.config.errors import nearest

CONDITION_KEYS = [key for key in ENV_KEYS if key != "env.layout"]
NETWORK_KEYS = (
    "camera.width",
    "camera.height",
    "env.window_capacity",
)  # the policy's network is built for them


def _number_or_word(value: object) -> float | str | None:
    """One rule and one message, where a union of types would give several."""
    if value is None or isinstance(value, str):
        return value
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"must be a finite number, a word or null, got {value!r}")
    return value


Setting = Annotated[float | str | None, PlainValidator(_number_or_word)]
AxisName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")]
Values = Annotated[list[Setting], Field(min_length=1)]
Axis = Annotated[dict[str, Values], Field(min_length=1)]
Condition = dict[str, Setting]


def axis_points(axis: Mapping[str, Sequence[Setting]]) -> list[Condition]:
    """The points of an axis, each as setting -> value: settings have equally many values, or one for all.

    Raises:
        ValueError: If the lengths differ, or two points have the same first value.
    """
    lengths = {key: len(values) for key, values in axis.items()}
    if len({*lengths.values()} - {1}) > 1:
        raise ValueError(f"settings must have equally many values, or one, got {lengths}")
    count = max(lengths.values())
    key, first = next(iter(axis.items()))
    if len(set(first)) < count:
        rule = f"{key} comes first, so it must differ at each of {count} points"
        raise ValueError(f"{rule}, got {list(first)}")
    return [{key: values[place % len(values)] for key, values in axis.items()} for place in range(count)]


def moving_settings(points: Mapping[str, Mapping[str, object]]) -> list[str]:
    """The settings that change along an axis; `points` maps each point's value as text to its settings."""
    every = list(points.values())
    return [key for key in every[0] if len({str(point[key]) for point in every}) > 1]


def axis_numbers(points: Mapping[str, Mapping[str, object]]) -> dict[str, float] | None:
    """The number that each point of an axis stands for; None for words, or if several settings change."""
    firsts = {value: next(iter(point.values()), None) for value, point in points.items()}
    numbers = {value: float(first) for value, first in firsts.items() if isinstance(first, int | float)}
    return numbers if len(numbers) == len(firsts) and len(moving_settings(points)) <= 1 else None


def axis_errors(axes: Mapping[str, Mapping[str, Sequence[Setting]]], env: EnvConfig) -> list[str]:
    """One line for each setting of a sweep that the simulation would otherwise reject hours later."""
    return [
        f"sweep.axes.{name}: {reason}" for name, axis in axes.items() for reason in _axis_errors(axis, env)
    ]


def condition_errors(conditions: Sequence[Condition], env: EnvConfig) -> list[str]:
    """One line for each setting that the simulation would reject in the conditions of a training."""
    errors = []
    for place, condition in enumerate(conditions):
        reasons = _key_errors(condition) or _value_errors(condition, env)
        reasons += [
            f"{key}: must be the same for all of a training, got {condition[key]!r}"
            for key in NETWORK_KEYS
            if key in condition
        ]
        errors += [f"train.conditions[{place}]: {reason}" for reason in reasons]
    return errors


def _axis_errors(axis: Mapping[str, Sequence[Setting]], env: EnvConfig) -> list[str]:
    unknown = _key_errors(axis)
    if unknown:
        return unknown
    try:
        points = axis_points(axis)
    except ValueError as error:
        return [str(error)]
    return [reason for point in points for reason in _value_errors(point, env)]


def _key_errors(settings: Mapping[str, object]) -> list[str]:
    """One line for each key that is no setting of the simulation."""
    unknown = {key: value for key, value in settings.items() if key not in CONDITION_KEYS}
    return [
        f"{key}: no such setting, got {value}{nearest(key, CONDITION_KEYS)}" for key, value in unknown.items()
    ]


def _value_errors(point: Condition, env: EnvConfig) -> list[str]:
    """One line for each value that is not valid among settings that are replaced together."""
    try:
        env_with(env, point)
    except pydantic.ValidationError as error:
        named = ", ".join(f"{key}={value!r}" for key, value in point.items())
        return [f"{named}: {problem['msg']}" for problem in error.errors()]
    return []
