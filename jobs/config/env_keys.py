"""Translate between `EnvConfig` and the keys of a user: env.*, camera.*, faults.*, fidelity.*, renderer.

`EnvConfig` has the fields camera, faults, fidelity and renderer. On the command line, in conf/ and
in the files of a run they are separate groups. Only this file knows both forms.
"""

import dataclasses
import functools
import typing
from collections.abc import Mapping, Sequence

from envs.config import EnvConfig
from jobs.config.errors import SET_BY_JOBS

if typing.TYPE_CHECKING:
    from _typeshed import DataclassInstance

BESIDE_ENV = ("camera", "faults", "renderer", "fidelity")  # users write these fields without `env.`


def fields_of(section: "type[DataclassInstance]") -> dict[str, type]:
    """Return the fields of a dataclass of settings: name -> type."""
    return {part.name: typing.cast(type, part.type) for part in dataclasses.fields(section)}


ENV_GROUPS = {name: fields_of(EnvConfig)[name] for name in BESIDE_ENV if name != "renderer"}
ENV_FIELDS = [name for name in fields_of(EnvConfig) if name not in (*BESIDE_ENV, *SET_BY_JOBS)]
ENV_KEYS = {  # key -> the fields of EnvConfig that lead to its value
    **{f"env.{name}": (name,) for name in ENV_FIELDS},
    **{f"{group}.{name}": (group, name) for group, cls in ENV_GROUPS.items() for name in fields_of(cls)},
    "renderer": ("renderer",),
}


def key_of(section: str, path: Sequence[int | str]) -> str:
    """Return the key of a field of a section, as users write it: env.scene, camera.width, renderer."""
    beside = section == "env" and path[:1] and path[0] in BESIDE_ENV
    return ".".join([*([section] if section and not beside else []), *map(str, path)])


LAYOUT = "env.layout."  # prefix of the keys of a layout, such as env.layout.ground_texture.pattern
BODY = "env.body."  # prefix of the keys of a vehicle, such as env.body.tau_s
ADDED_FAULT = "faults.added."  # prefix of the keys of plug-in faults
OPEN_FIELDS = {LAYOUT: ("layout",), BODY: ("body",), ADDED_FAULT: ("faults", "added")}  # as in `ENV_KEYS`
OPEN_KEYS = tuple(OPEN_FIELDS)


def env_with(env: EnvConfig, changes: Mapping[str, object]) -> EnvConfig:
    """Return the simulation's settings with some replaced together, such as {"camera.memory": "frame"}.

    Raises:
        pydantic.ValidationError: If a setting is unknown or its value is not valid.
    """
    values: dict[tuple[str, ...], typing.Any] = {}
    for key, value in changes.items():
        start = next((one for one in OPEN_KEYS if key.startswith(one)), None)
        if start is None:
            values[ENV_KEYS.get(key, (key,))] = value  # pydantic rejects an unknown key
            continue
        path = OPEN_FIELDS[start]
        whole = values.get(path, functools.reduce(getattr, path, env))
        values[path] = _with_part(whole, key.removeprefix(start).split("."), value)
    fields = {path[0]: value for path, value in values.items() if len(path) == 1}
    for group in dict.fromkeys(path[0] for path in values if len(path) == 2):
        own = {path[1]: value for path, value in values.items() if path[0] == group}
        fields[group] = dataclasses.replace(getattr(env, group), **own)
    return dataclasses.replace(env, **fields)


def _with_part(values: Mapping[str, object], path: Sequence[str], value: object) -> dict[str, object]:
    """Return nested mappings with one value replaced."""
    name, *rest = path
    if not rest:
        return {**values, name: value}
    inner = values.get(name, {})
    return {**values, name: _with_part(inner if isinstance(inner, Mapping) else {}, rest, value)}


def flat_env(env: EnvConfig) -> dict[str, object]:
    """Return the settings as plain containers: env, camera, faults, fidelity and renderer, as in conf/."""
    values = dataclasses.asdict(env)
    beside = {name: values[name] for name in BESIDE_ENV}
    return {"env": {name: values[name] for name in ENV_FIELDS}, **beside}
