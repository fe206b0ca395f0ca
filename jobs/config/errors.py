"""Format configuration errors: suggest the nearest key, and hide passwords."""

import difflib
import re
from collections.abc import Mapping, Sequence

SET_BY_JOBS = ("observation", "split")  # of `env`: training must never see the corridors of evaluation
HIDDEN = "***"
# Up to the last @: SQLAlchemy accepts an unescaped slash in a password.
USER_AND_PASSWORD = re.compile(r"""(?<=://)(?:[^\s/'"@:]*:[^\s'"]*|[^\s/'"]+)@""")
SECRET_PARAMETER = re.compile(
    r"""([?&][^\s=&]*(?:pass|secret|token|api_?key)[^\s=&]*=)[^\s&'"]+""", re.IGNORECASE
)


class ConfigError(ValueError):
    """A configuration that cannot be used; each line of the message names a key, the rule and the value."""


def differences(there: Mapping[str, object], here: Mapping[str, object]) -> str:
    """Return the differences of two settings, such as "stack: 3 there, 2 here"; empty if there are none."""
    names = [name for name in {**there, **here} if there.get(name) != here.get(name)]
    return ", ".join(f"{name}: {there.get(name)!r} there, {here.get(name)!r} here" for name in names)


def redacted(text: str) -> str:
    """Return the text with `***` for the user, password and secret parameters of each address in it."""
    return SECRET_PARAMETER.sub(rf"\1{HIDDEN}", USER_AND_PASSWORD.sub(f"{HIDDEN}@", text))


def nearest(key: str, keys: Sequence[str]) -> str:
    """Return the remedy for an unknown key, after a semicolon: the nearest key, or where to look."""
    if key.removeprefix("env.") in SET_BY_JOBS:
        return "; every job chooses it itself"
    by_last_word = {known.rpartition(".")[2]: known for known in reversed(keys)}
    near = difflib.get_close_matches(key, keys, n=1, cutoff=0.75)
    if not near:
        words = difflib.get_close_matches(key.rpartition(".")[2], by_last_word, n=1, cutoff=0.7)
        near = [by_last_word[word] for word in words]
    return f"; did you mean {near[0]}?" if near else "; --cfg job shows every key"
