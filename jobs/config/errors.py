"""What a refused configuration says: the key, the rule, the value received, the nearest key; no password."""

import difflib
import re
from collections.abc import Mapping, Sequence
from typing import Any

import pydantic

JOBS_CHOOSE = ("observation", "split")  # of `env`: training must never fly the corridors of evaluation
HIDDEN = "***"
# Up to the last @: SQLAlchemy takes a password with a slash in it as it stands.
USER_AND_PASSWORD = re.compile(r"""(?<=://)(?:[^\s/'"@:]*:[^\s'"]*|[^\s/'"]+)@""")
SECRET_PARAMETER = re.compile(
    r"""([?&][^\s=&]*(?:pass|secret|token|api_?key)[^\s=&]*=)[^\s&'"]+""", re.IGNORECASE
)


def redacted(text: str) -> str:
    """The text with `***` for the user, password and secret parameters of each address in it."""
    return SECRET_PARAMETER.sub(rf"\1{HIDDEN}", USER_AND_PASSWORD.sub(f"{HIDDEN}@", text))


def explain(error: pydantic.ValidationError, section: str, keys: Sequence[str]) -> list[str]:
    """One line per refused key.

    Args:
        error: What pydantic found.
        section: Where in the configuration it looked; "" at the top.
        keys: Every key that a configuration may have, to choose the nearest from.
    """
    lines = []
    for problem in error.errors():
        key = ".".join([section] * bool(section) + [str(part) for part in problem["loc"]])
        if problem["type"] == "unexpected_keyword_argument":
            hint = "; this kind of model has none" if key in keys else nearest(key, keys)
            lines.append(f"{key}: no such key, got {problem['input']!r}{hint}")
        elif problem["type"] in ("missing", "missing_argument", "value_error"):
            lines.append(f"{key}: {problem['msg'].removeprefix('Value error, ')}")
        else:
            lines.append(f"{key}: {problem['msg']}, got {problem['input']!r}")
    return lines


def nearest(key: str, keys: Sequence[str]) -> str:
    """What to do instead of an unknown key, after a semicolon: the nearest key, or where to look."""
    if key.removeprefix("env.") in JOBS_CHOOSE:
        return "; every job chooses it itself"
    by_last_word = {known.rpartition(".")[2]: known for known in reversed(keys)}
    near = difflib.get_close_matches(key, keys, n=1, cutoff=0.75)
    if not near:
        words = difflib.get_close_matches(key.rpartition(".")[2], by_last_word, n=1, cutoff=0.7)
        near = [by_last_word[word] for word in words]
    return f"; did you mean {near[0]}?" if near else "; --cfg job shows every key"


def refused_scenes(
    named: Sequence[tuple[str, str]], layout: Mapping[str, Any], vehicle: tuple[float, float]
) -> list[str]:
    """One line per scene that cannot be, be it by its name, its file or the layout's values.

    Args:
        named: Keys and the scenes they name; each takes the layout's values.
        layout: Values that replace those of every scene.
        vehicle: Radius and height of what has to get through [m].
    """
    # Imported here because they take a second, which a refusal of anything else can do without.
    import numpy as np

    from envs.scene import make_scene

    refused: dict[str, str] = {}
    for key, name in named:
        try:
            make_scene(name, np.random.default_rng(0), *vehicle, **layout)
        except ValueError as error:
            about_layout = str(error).startswith("layout")
            key = "env.layout" if about_layout else key
            refused.setdefault(
                f"{key} {name}", f"{key}: {str(error).removeprefix('layout: ').removeprefix('scene ')}"
            )
    return list(dict.fromkeys(refused.values()))
