"""Axes and conditions: settings of the simulation that change together.

A study evaluates the points of an axis one by one. A training or a data set draws for each episode one of a
list of conditions, by their `weight` (default 1), and then each value of the condition. A number or a word is
used unchanged. A list gives one of its values. A range {low: 50, high: 500} gives a uniform number, whose
logarithm is uniform with `log: true`; if both ends are whole numbers, so is the number.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Annotated, Any

import numpy as np
import pydantic
from pydantic import Field, PlainValidator

from envs.config import EnvConfig
from jobs.config.env_keys import ENV_KEYS, OPEN_KEYS, env_with
from jobs.config.errors import nearest
from jobs.config.scenes import scene_errors

CONDITION_KEYS = [key for key in ENV_KEYS if f"{key}." not in OPEN_KEYS]
# The policy's network, its window or its actions are built for them.
NETWORK_KEYS = (
    *("camera.width", "camera.height", "env.window_capacity", "env.filter_support", "env.filter_tau_us"),
    *("env.vehicle", "env.body.command", "env.body.primitives"),
)
WEIGHT = "weight"


def _number_or_word(value: object) -> float | str | None:
    """Check and return a number, a word or null; a union of types would give several messages."""
    if value is None or isinstance(value, str):
        return value
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"must be a finite number, a word or null, got {value!r}")
    return value


def _settings(value: object) -> Any:
    """Check and return a value, a list of values to draw from, or a range."""
    if isinstance(value, Mapping):
        low, high, log = value.get("low"), value.get("high"), value.get("log", False)
        known = value.keys() <= {"low", "high", "log"} and isinstance(log, bool)
        numbers = all(isinstance(end, int | float) and math.isfinite(end) for end in (low, high))
        if not known or not numbers or not low < high or (log and low <= 0):  # type: ignore[operator]
            rule = "must be {low: number, high: greater one}, for log: true above 0"
            raise ValueError(f"{rule}, got {value!r}")
        return dict(value)
    if isinstance(value, list):
        if not value:
            raise ValueError("must name a value at least, got []")
        return [_number_or_word(one) for one in value]
    return _number_or_word(value)


def _searched(value: object) -> Any:
    """Check and return a list of values, or a range."""
    if isinstance(value, list) and value:
        return value
    if not isinstance(value, Mapping):
        raise ValueError(f"must be a list of values, or a range {{low: number, high: number}}, got {value!r}")
    return _settings(value)


Setting = Annotated[float | str | None, PlainValidator(_number_or_word)]
NOMINAL = "nominal"  # the axis of the condition that changes nothing
AxisName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")]
Values = Annotated[list[Setting], Field(min_length=1)]
Axis = Annotated[dict[str, Values], Field(min_length=1)]
Condition = dict[str, Setting]
Searched = Annotated[Any, PlainValidator(_searched)]
Drawn = Annotated[Any, PlainValidator(_settings)]
Conditions = Annotated[list[dict[str, Drawn]], Field(min_length=1)]


def axis_points(axis: Mapping[str, Sequence[Setting]]) -> list[Condition]:
    """Return the points of an axis, each as setting -> value; a single value applies to all points.

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
    """Return the settings that change along an axis; `points` maps a point's value to its settings."""
    every = list(points.values())
    return [key for key in every[0] if len({str(point[key]) for point in every}) > 1]


def axis_numbers(points: Mapping[str, Mapping[str, object]]) -> dict[str, float] | None:
    """Return the number of each point of an axis; None for words, or if several settings change."""
    firsts = {value: next(iter(point.values()), None) for value, point in points.items()}
    numbers = {value: float(first) for value, first in firsts.items() if isinstance(first, int | float)}
    return numbers if len(numbers) == len(firsts) and len(moving_settings(points)) <= 1 else None


def axis_errors(axes: Mapping[str, Mapping[str, Sequence[Setting]]], env: EnvConfig) -> list[str]:
    """Return one line for each setting of a study that the simulation would otherwise reject hours later."""
    rule = "must have another name, this one is of the condition that changes nothing; rename the axis"
    taken = [f"study.axes.{NOMINAL}: {rule}, got {dict(axes[NOMINAL])!r}"] if NOMINAL in axes else []
    return taken + [
        f"study.axes.{name}: {reason}" for name, axis in axes.items() for reason in _axis_errors(axis, env)
    ]


def condition_errors(name: str, conditions: Sequence[Mapping[str, Any]], env: EnvConfig) -> list[str]:
    """Return one line for each setting in the conditions of the key `name` that the simulation rejects."""
    errors = []
    for place, condition in enumerate(conditions):
        weight, settings = condition.get(WEIGHT, 1), _without_weight(condition)
        reasons = _key_errors(settings) or [
            reason for point in _extremes(settings) for reason in _value_errors(point, env)
        ]
        if not isinstance(weight, int | float) or not weight > 0:
            reasons.append(f"weight: must be a number > 0, got {weight!r}")
        reasons += [
            f"{key}: must be the same for all of a training, got {settings[key]!r}"
            for key in NETWORK_KEYS
            if key in settings
        ]
        errors += [f"{name}[{place}]: {reason}" for reason in dict.fromkeys(reasons)]
    return errors


def episode_draw(
    conditions: Sequence[Mapping[str, Any]],
) -> Callable[[EnvConfig, np.random.Generator], EnvConfig] | None:
    """Return the function that draws an episode's settings, for `CorridorEnv`; None without conditions."""
    return None if list(conditions) == [{}] else partial(_drawn_env, conditions)


def _drawn_env(
    conditions: Sequence[Mapping[str, Any]], env: EnvConfig, rng: np.random.Generator
) -> EnvConfig:
    weights = np.cumsum([condition.get(WEIGHT, 1) for condition in conditions])
    chosen = conditions[int(np.searchsorted(weights, rng.random() * weights[-1], side="right"))]
    return env_with(env, {key: _drawn(value, rng) for key, value in _without_weight(chosen).items()})


def _drawn(value: Any, rng: np.random.Generator) -> Any:
    """Draw one value of a setting, a list or a range."""
    if isinstance(value, list):
        return value[int(rng.integers(len(value)))]
    if not isinstance(value, Mapping):
        return value
    low, high = value["low"], value["high"]
    if isinstance(low, int) and isinstance(high, int) and not value.get("log"):
        return int(rng.integers(low, high, endpoint=True))
    drawn = math.exp(rng.uniform(*np.log([low, high]))) if value.get("log") else rng.uniform(low, high)
    drawn = min(max(drawn, low), high)
    return round(drawn) if isinstance(low, int) and isinstance(high, int) else float(drawn)


def _extremes(settings: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield conditions that together contain every value of each list and both ends of each range."""
    ends = {
        key: [value["low"], value["high"]] if isinstance(value, Mapping) else value
        for key, value in settings.items()
    }
    several = {key: value if isinstance(value, list) else [value] for key, value in ends.items()}
    for place in range(max(map(len, several.values()), default=1)):
        yield {key: values[place % len(values)] for key, values in several.items()}


def _without_weight(condition: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in condition.items() if key != WEIGHT}


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
    """Return one line for each key that is no setting of the simulation."""
    return [
        f"{key}: no such setting, got {value}{nearest(key, CONDITION_KEYS)}"
        for key, value in settings.items()
        if key not in CONDITION_KEYS and not key.startswith(OPEN_KEYS)
    ]


def _value_errors(point: Condition, env: EnvConfig) -> list[str]:
    """Return one line for each value that is not valid among settings that are replaced together."""
    try:
        changed = env_with(env, point)
    except pydantic.ValidationError as error:
        named = ", ".join(f"{key}={value!r}" for key, value in point.items())
        return [f"{named}: {problem['msg']}" for problem in error.errors()]
    return scene_errors([("env.scene", changed.scene)], changed) if changed.layout != env.layout else []
