"""Decide whether a condition lies within a training distribution: trained robustness is no generalization."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from envs.config import EnvConfig
from envs.scene.layouts import LAYOUTS, Layout, with_overrides
from jobs.config.conditions import WEIGHT
from jobs.config.env_keys import ADDED_FAULT, ENV_KEYS, LAYOUT, env_with
from jobs.rollout.policies import EvaluatedPolicy, with_sensor

NO_CONDITION = (
    "renderer",
    "env.scene",
    "env.layout",
    "env.time_limit_s",
    "env.window_capacity",
    "faults.added",
)
COMPARED = [key for key in ENV_KEYS if key not in NO_CONDITION and not key.startswith("fidelity.")]


def was_met(policy: EvaluatedPolicy, nominal: EnvConfig, env: EnvConfig) -> bool:
    """Whether the condition lies within the policy's training distribution; always False for baselines."""
    if not policy.conditions:
        return False
    trained = with_sensor(EnvConfig(**policy.world), policy.sensor)
    return met(policy.conditions, trained, nominal, env)


def met(
    conditions: Sequence[Mapping[str, Any]], trained: EnvConfig, nominal: EnvConfig, cell: EnvConfig
) -> bool:
    """Whether a training could draw the settings in which a condition differs from the nominal one.

    All tables follow one rule. A word counts as met if a training condition may draw it. A number counts as
    met if it lies between the smallest and the largest value in any training episode, including conditions
    that do not change it: if some have 0 and others 0.3, then 0.2 is met. A single training condition must
    draw all of the differing settings. A condition without differences, or with a mesh as its scene, is not
    met.

    Args:
        conditions: The training's conditions, as in `TrainConfig`.
        trained: The simulation that the training's conditions change.
        nominal: The simulation of the nominal condition.
        cell: The simulation of the condition in question.
    """
    if not _is_drawn(cell.scene):
        return False
    before, here = settings_of(nominal), settings_of(cell)
    changed = {key: value for key, value in here.items() if before.get(key) != value}
    if any(key.startswith(LAYOUT) for key in changed):  # another layout: all of it must be met
        changed |= {key: value for key, value in here.items() if key.startswith(LAYOUT)}
    every = [_drawn_settings(condition, trained) for condition in conditions]
    return bool(changed) and any(
        all(_may_be(drawn.get(key, []), value)
            or (key in condition and _lies_between([one for own in every for one in own.get(key, [])], value))
            for key, value in changed.items())
        for condition, drawn in zip(conditions, every, strict=True)
    )  # fmt: skip


def settings_of(env: EnvConfig) -> dict[str, object]:
    """Return the settings that distinguish conditions: key -> value, a scene as the fields of its layout."""
    values: dict[str, Any] = {}
    for key in COMPARED:
        value: Any = env
        for name in ENV_KEYS[key]:
            value = getattr(value, name)
        values[key] = value
    values |= {ADDED_FAULT + name: amount for name, amount in env.faults.added.items()}
    layout = dataclasses.asdict(with_overrides(LAYOUTS[env.scene], env.layout))
    for name, value in layout.items():
        parts = value if isinstance(value, dict) else {"": value}
        for part, inner in parts.items():
            values[LAYOUT + f"{name}.{part}".rstrip(".")] = inner
    return values


def _is_drawn(scene: str) -> bool:
    """Whether a scene is a layout, not a mesh."""
    return isinstance(LAYOUTS.get(scene), Layout)


def _drawn_settings(condition: Mapping[str, Any], trained: EnvConfig) -> dict[str, list[object]]:
    """Return setting -> values that a condition may draw; of a range only its ends."""
    ends = {key: _ends(value) for key, value in condition.items() if key != WEIGHT}
    scenes = [scene for scene in ends.pop("env.scene", [trained.scene]) if _is_drawn(scene)]
    worlds = [settings_of(env_with(trained, {"env.scene": scene})) for scene in scenes]
    drawn = {key: [world[key] for world in worlds] for key in worlds[0]} if worlds else {}
    return drawn | ends


def _ends(value: Any) -> list[Any]:
    if isinstance(value, Mapping):
        return [value["low"], value["high"]]
    return value if isinstance(value, list) else [value]


def _may_be(drawn: Sequence[Any], value: object) -> bool:
    return value in drawn or _lies_between(drawn, value)


def _lies_between(drawn: Sequence[Any], value: object) -> bool:
    """Whether a value is a number between the smallest and the largest number in `drawn`."""
    numbers = [one for one in drawn if _is_number(one)]
    return _is_number(value) and bool(numbers) and min(numbers) <= value <= max(numbers)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
