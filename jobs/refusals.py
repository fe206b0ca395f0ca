"""What a refused configuration says: the key, the rule, the value received, the nearest key."""

import difflib
from collections.abc import Sequence

import pydantic


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
            lines.append(f"{key}: no such key, got {problem['input']!r}{nearest(key, keys)}")
        elif problem["type"] in ("missing", "missing_argument", "value_error"):
            lines.append(f"{key}: {problem['msg'].removeprefix('Value error, ')}")
        else:
            lines.append(f"{key}: {problem['msg']}, got {problem['input']!r}")
    return lines


def nearest(key: str, keys: Sequence[str]) -> str:
    """The words "did you mean KEY?" after a semicolon, or nothing if no key is near."""
    by_last_word = {known.rpartition(".")[2]: known for known in reversed(keys)}
    near = difflib.get_close_matches(key, keys, n=1, cutoff=0.75)
    if not near:
        words = difflib.get_close_matches(key.rpartition(".")[2], by_last_word, n=1, cutoff=0.7)
        near = [by_last_word[word] for word in words]
    return f"; did you mean {near[0]}?" if near else "; --cfg job shows every key"
