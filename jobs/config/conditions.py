"""Axes and conditions: settings of the simulation that change together, point by point."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import pydantic
from pydantic import Field, PlainValidator

from envs.config import CameraConfig, EnvConfig, FaultsConfig, FidelityConfig
from jobs.config.errors import JOBS_CHOOSE, nearest

GROUPS = {"camera": CameraConfig, "faults": FaultsConfig, "fidelity": FidelityConfig}
PLAIN = ("renderer",)  # named without a group in a configuration
KEYS = [
    *(f"env.{part.name}" for part in dataclasses.fields(EnvConfig)
      if part.name not in (*GROUPS, *PLAIN, *JOBS_CHOOSE, "layout")),
    *(f"{name}.{part.name}" for name, group in GROUPS.items() for part in dataclasses.fields(group)),
    *PLAIN,
]  # fmt: skip
OF_THE_NETWORK = ("camera.width", "camera.height", "env.window_capacity")  # what it is built for


def _number_or_word(value: Any) -> float | str | None:
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


def env_with(config: EnvConfig, changes: Mapping[str, Any]) -> EnvConfig:
    """The simulation with settings replaced together, such as {"camera.memory": "frame"}.

    Raises:
        pydantic.ValidationError: If a setting is unknown or refuses its value.
    """
    groups: dict[str, dict[str, Any]] = {}
    fields: dict[str, Any] = {}
    for key, value in changes.items():
        section, _, name = key.rpartition(".")
        if section in GROUPS:
            groups.setdefault(section, {})[name] = value
        else:
            fields[name if section == "env" else key] = value
    parts = {name: dataclasses.replace(getattr(config, name), **values) for name, values in groups.items()}
    return dataclasses.replace(config, **{**fields, **parts})


def axis_points(settings: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
    """The points of an axis, each as setting -> value: settings have equally many values, or one for all.

    Raises:
        ValueError: If the lengths differ, or two points have the same first value.
    """
    lengths = {key: len(values) for key, values in settings.items()}
    if len({*lengths.values()} - {1}) > 1:
        raise ValueError(f"settings must have equally many values, or one, got {lengths}")
    count = max(lengths.values())
    key, first = next(iter(settings.items()))
    if len(set(first)) < count:
        rule = f"{key} comes first, so it must differ at each of {count} points"
        raise ValueError(f"{rule}, got {list(first)}")
    return [{key: values[place % len(values)] for key, values in settings.items()} for place in range(count)]


def moving_settings(points: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The settings that change along an axis; points by their value as text."""
    every = list(points.values())
    return [key for key in every[0] if len({str(point[key]) for point in every}) > 1]


def axis_numbers(points: Mapping[str, Mapping[str, Any]]) -> dict[str, float] | None:
    """The number that each point of an axis stands for; None for words, or if several settings change."""
    firsts = [next(iter(point.values()), None) for point in points.values()]
    if len(moving_settings(points)) > 1 or not all(isinstance(first, int | float) for first in firsts):
        return None
    return {value: float(first) for value, first in zip(points, firsts, strict=True) if first is not None}


def refused_axes(axes: Mapping[str, Mapping[str, Sequence[Any]]], config: EnvConfig) -> list[str]:
    """One line for each thing that the simulation would refuse of a sweep, hours later."""
    refused = []
    for axis, settings in axes.items():
        refused += [f"sweep.axes.{axis}: {reason}" for reason in _refused_axis(settings, config)]
    return refused


def refused_conditions(conditions: Sequence[Mapping[str, Any]], config: EnvConfig) -> list[str]:
    """One line for each thing that the simulation would refuse of the conditions of a training."""
    refused = []
    for place, condition in enumerate(conditions):
        reasons = _refused_keys(condition) or _refused_point(condition, config)
        reasons += [
            f"{key}: must be the same for all of a training, got {condition[key]!r}"
            for key in OF_THE_NETWORK
            if key in condition
        ]
        refused += [f"train.conditions[{place}]: {reason}" for reason in reasons]
    return refused


def _refused_axis(settings: Mapping[str, Sequence[Any]], config: EnvConfig) -> list[str]:
    unknown = _refused_keys(settings)
    if unknown:
        return unknown
    try:
        points = axis_points(settings)
    except ValueError as error:
        return [str(error)]
    return [reason for point in points for reason in _refused_point(point, config)]


def _refused_keys(settings: Mapping[str, Any]) -> list[str]:
    """One line for each key that is no setting of the simulation."""
    unknown = {key: value for key, value in settings.items() if key not in KEYS}
    return [f"{key}: no such setting, got {value}{nearest(key, KEYS)}" for key, value in unknown.items()]


def _refused_point(point: Mapping[str, Any], config: EnvConfig) -> list[str]:
    """One line for each value that the simulation refuses of settings that are replaced together."""
    try:
        env_with(config, point)
    except pydantic.ValidationError as error:
        named = ", ".join(f"{key}={value!r}" for key, value in point.items())
        return [f"{named}: {problem['msg']}" for problem in error.errors()]
    return []
