"""Commands and names on the pages are those of the code."""

import importlib
import re
import shlex
from pathlib import Path

import pytest

from jobs.config.config import parse
from tests.support.configs import compose

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
# `+exp=NAME` and words behind it, up to what ends a command on a page.
WORD = r"(?:'[^']*'|\"[^\"]*\"|[^\s`#|;)'\"])+"
LAUNCHED = re.compile(rf"(?<!\w)(\+exp=[a-z_]+(?:[ \t]+(?=[\w.~'\"]+[=.]){WORD})*)")
MADE = {"bytestream": "+exp=bytestream", "sweep-robustness": "+exp=robustness", "demo": "+exp=demo"}
ARGS = re.compile(r"make (bytestream|sweep-robustness|demo)(?: train=true)? ARGS=\"([^\"]*)\"")
NAMES = re.compile(r"`((?:envs|models|jobs)(?:\.\w+)+)`")


def commands() -> list[str]:
    """The words of each command of the launcher that a page shows, once."""
    found: dict[str, None] = {}
    for page in PAGES:
        text = page.read_text().replace("\\\n", " ")
        found |= dict.fromkeys(match[1].strip() for match in LAUNCHED.finditer(text))
        found |= dict.fromkeys(f"{MADE[target]} {words}" for target, words in ARGS.findall(text))
    return list(found)


def exists(name: str) -> bool:
    """Whether a dotted name is a module, or an attribute that a module leads to."""
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        for attribute in parts[length:]:
            fields = getattr(found, "__dataclass_fields__", {})
            if not hasattr(found, attribute) and attribute not in fields:
                return False
            found = getattr(found, attribute, None)
        return True
    return False


@pytest.mark.parametrize("command", commands())
def test_a_command_on_a_page_makes_a_checked_configuration(command):
    words = [word for word in shlex.split(command) if not word.startswith(("runs_dir=", "resume="))]
    assert parse(compose(*words)).exp


def test_there_are_commands_on_the_pages():
    assert len(commands()) > 30


def test_names_on_the_pages_are_in_the_code():
    names = {name for page in PAGES for name in NAMES.findall(page.read_text())}
    assert len(names) > 20
    assert sorted(name for name in names if not exists(name)) == []
