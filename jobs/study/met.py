"""Whether a training met what a sweep evaluates: a robustness that was trained is not one that was found."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from envs.config import EnvConfig
from envs.scene.layouts import LAYOUTS, Layout, with_overrides
from jobs.config.conditions import WEIGHT
from jobs.config.env_keys import ADDED_FAULT, ENV_KEYS, LAYOUT, env_with

NO_CONDITION = (
    "renderer",
    "env.scene",
    "env.layout",
    "env.time_limit_s",
    "env.window_capacity",
    "faults.added",
)
COMPARED = [key for key in ENV_KEYS if key not in NO_CONDITION and not key.startswith("fidelity.")]


def met(
    conditions: Sequence[Mapping[str, Any]], trained: EnvConfig, nominal: EnvConfig, cell: EnvConfig
) -> bool:
    """Whether a training's episodes could have what distinguishes a cell of a sweep from the nominal one.

    One rule for all tables. A word counts as met if a condition may draw it. A number does between the
    smallest and the largest that any of the training's episodes may have, among them those of conditions that
    leave it as it is: where some have 0 and some 0.3, 0.2 is met. One condition must draw all that
    distinguishes the cell; a cell in which nothing changes, or whose scene is a mesh, is not met.

    Args:
        conditions: Of the training, as `TrainConfig`.
        trained: The simulation that they change.
        nominal: The simulation of the sweep with nothing changed.
        cell: That of the cell.
    """
    if not _is_drawn(cell.scene):
        return False
    before, here = settings_of(nominal), settings_of(cell)
    changed = {key: value for key, value in here.items() if before.get(key) != value}
    if any(key.startswith(LAYOUT) for key in changed):  # another world, of which nothing may be new
        changed |= {key: value for key, value in here.items() if key.startswith(LAYOUT)}
    every = [_drawn_settings(condition, trained) for condition in conditions]
    return bool(changed) and any(
        all(_may_be(drawn.get(key, []), value)
            or (key in condition and _lies_between([one for own in every for one in own.get(key, [])], value))
            for key, value in changed.items())
        for condition, drawn in zip(conditions, every, strict=True)
    )  # fmt: skip


def settings_of(env: EnvConfig) -> dict[str, object]:
    """Return the settings that tell conditions apart, by their keys; a scene as the fields of its layout."""
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
    """Return, for each setting, the values that a condition may draw; for a range, its ends."""
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
    """Whether a number lies between the ends of the numbers among `drawn`; False for what is no number."""
    numbers = [one for one in drawn if _is_number(one)]
    return _is_number(value) and bool(numbers) and min(numbers) <= value <= max(numbers)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
