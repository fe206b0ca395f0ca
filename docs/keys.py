"""Generate the tables of docs/keys.md, with every key of a configuration.

Allowed values come from the schema; defaults, units, meanings and sources from conf/ and its comments.
"""

import dataclasses
import inspect
import re
import types
import typing
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

import hydra
from omegaconf import OmegaConf

from jobs.config.algorithms import AlgoConfig
from jobs.config.config import Config
from jobs.config.env_keys import ENV_KEYS, fields_of
from jobs.config.registry import JOBS, Job
from models.kinds import EncoderModel

CONF = Path(__file__).resolve().parents[1] / "conf"
FILES = {  # files with comments: the section of their top level
    "config.yaml": "", "budget/short.yaml": "", "env/corridor.yaml": "env", "camera/paper.yaml": "camera",
    "faults/none.yaml": "faults", "fidelity/tolerance.yaml": "fidelity", "model/bytestream.yaml": "model",
    "algo/ppo.yaml": "algo", "algo/imitation.yaml": "algo",
    "cluster/local.yaml": "cluster", "tracking/local.yaml": "tracking",
}  # fmt: skip
LINE = re.compile(r"^(\s*)(\w+):\s*(.*?)(?:(?:^|\s+)# (.*))?$")
UNIT = re.compile(r"\s*\[([^\]]*[a-zA-Z][^\]]*)\]")
SOURCE = re.compile(
    r"\s*\(((?:appendi|equation|eq\.|the paper|AirSim|Stable|N_max|DAgger|not stated)[^()]*)\)"
)
WORDS = {int: "whole number", float: "number", str: "text", bool: "true or false", type(None): "null"}
HEAD = ("key", "default", "allowed", "unit", "meaning", "source")
BOUNDS = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}


class Row(typing.NamedTuple):
    """A row of a table: the texts about one key."""

    key: str
    default: str
    allowed: str
    unit: str
    meaning: str
    source: str


def allowed(kind: object) -> str:
    """Return the values that a type allows, in words: "whole number, at least 1, or null"."""
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Annotated:
        limits = [limit for part in inner[1:] for limit in _limits(part)]
        return ", ".join([allowed(inner[0]), *limits])
    if origin is typing.Literal:
        return " or ".join(f"`{value}`" for value in inner)
    if origin in (typing.Union, types.UnionType):
        return ", or ".join(dict.fromkeys(allowed(part) for part in inner))
    if origin is list:
        return f"list: each {allowed(inner[0])}"
    if origin is dict or dataclasses.is_dataclass(kind):
        return "mapping"
    return WORDS.get(kind, "any value")  # type: ignore[call-overload, no-any-return]


def _limits(part: object) -> Iterator[str]:
    """Yield the bounds that a part of a pydantic annotation sets."""
    for rule in getattr(part, "metadata", None) or ([part] if not hasattr(part, "metadata") else []):
        for name, text in BOUNDS.items():
            if (bound := getattr(rule, name, None)) is not None:
                yield f"{text} {bound:,.0f}" if bound == int(bound) else f"{text} {bound:g}"


def comments(file: Path, section: str) -> dict[str, str]:
    """Return key -> comment on the same line, for each key of a YAML file that has one."""
    found, path = {}, [(-1, section)]
    for line in file.read_text().splitlines():
        match = LINE.match(line)
        if match is None or line.lstrip().startswith("#"):
            continue
        indent = len(match[1])
        path = [step for step in path if step[0] < indent]
        path.append((indent, match[2]))
        found[".".join(name for _, name in path if name)] = match[4] or ""
    return {key: text for key, text in found.items() if text}


def documented(cls: type) -> dict[str, str]:
    """Return field -> text about it in the docstring of a dataclass."""
    listed = inspect.cleandoc(cls.__doc__ or "").partition("Attributes:\n")[2]
    entries = re.findall(r"^    (\w[\w, ]*): (.*(?:\n {8}.*)*)", listed, re.MULTILINE)
    return {name: " ".join(text.split()) for names, text in entries for name in names.split(", ")}


@cache
def _said() -> Mapping[str, str]:
    """Return key -> first comment about it in conf/."""
    found: dict[str, str] = {}
    files = FILES | {f"job/{name}.yaml": "" for name in JOBS}
    for name, section in files.items():
        found = comments(CONF / name, section) | found
    return found


@cache
def _defaults() -> Mapping[str, object]:
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        composed = OmegaConf.to_container(hydra.compose("config", ["+exp=bytestream"]), resolve=True)
    flat: dict[str, object] = {}
    for name, job in JOBS.items():
        flat |= {f"{name}.{key}": value for key, value in job.values().get(name, {}).items()}
    for name, value in typing.cast(Mapping[str, object], composed).items():
        inner = value.items() if isinstance(value, Mapping) else ()
        flat |= {f"{name}.{key}": own for key, own in inner} or {name: value}
    return flat


def row(key: str, kind: object, fallback: str = "") -> Row:
    """Return the row of a key; `fallback` is its meaning if conf/ has no comment on it."""
    said = _said().get(key, "")
    unit, source = (", ".join(rule.findall(said)) for rule in (UNIT, SOURCE))
    meaning = SOURCE.sub("", UNIT.sub("", said)).strip(" ;,") or fallback
    value = _defaults().get(key, "")
    default = _as_yaml(value)
    return Row(f"`{key}`", f"`{default}`" if default else "", allowed(kind), unit, meaning, source)


def _as_yaml(value: object) -> str:
    """Return a value as written on the command line."""
    if value is None or isinstance(value, bool):
        return "null" if value is None else str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value).replace("'", "")


def kinds() -> dict[str, dict[str, tuple[object, str]]]:
    """Return type and documentation of all keys, by section; section "" has the keys outside of sections."""
    hints = typing.get_type_hints(Config, include_extras=True)
    del hints["own"]
    found: dict[str, dict[str, tuple[object, str]]] = {
        name: {} for name in ("", "env", "camera", "faults", "fidelity")
    }
    for key, path in ENV_KEYS.items():
        owner = hints["env"]
        for field in path[:-1]:
            owner = typing.get_type_hints(owner, include_extras=True)[field]
        found[key.rpartition(".")[0]][key] = _field(owner, path[-1])
    for name, kind in hints.items():
        owner = {"model": EncoderModel, "algo": AlgoConfig}.get(name, kind)
        if name != "env" and dataclasses.is_dataclass(owner):
            found[name] = {f"{name}.{field}": _field(owner, field) for field in fields_of(owner)}  # type: ignore[arg-type]
        elif name != "env":
            found[""][name] = kind, ""
    found[""]["name"] = str | None, ""
    return found | {name: _own(name, job) for name, job in JOBS.items() if job.own_keys()}


def _own(name: str, job: Job) -> dict[str, tuple[object, str]]:
    """Return type and documentation of the keys that only this job has."""
    return {f"{name}.{key}": _field(job.settings(), key) for key in job.own_keys()}


def _field(owner: typing.Any, name: str) -> tuple[object, str]:
    return typing.get_type_hints(owner, include_extras=True)[name], documented(owner).get(name, "")


def tables() -> str:
    """Return all tables as Markdown."""
    text = []
    for section, keys in kinds().items():
        text += [
            f"## {section or 'Outside of any section'}",
            "",
            f"| {' | '.join(HEAD)} |",
            "|---" * len(HEAD) + "|",
        ]
        rows = (row(key, *about) for key, about in keys.items())
        text += [f"| {' | '.join(cell.replace('|', '&#124;') for cell in cells)} |" for cells in rows]
        text.append("")
    return "\n".join(text)
