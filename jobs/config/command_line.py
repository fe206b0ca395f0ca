"""Translate the words of a command line for Hydra: experiments, jobs, and names that have changed."""

import re
import shlex
from collections.abc import Sequence
from pathlib import Path

from jobs.config.flat import flat
from jobs.config.registry import CONF, JOBS

RENAMED_JOBS = {"ship": "publish", "tune": "search"}  # old name -> new
RENAMED_SECTIONS = {"tune": "search", "video": "video_events"}
TAKE_A_WORD = (  # options of Hydra whose value is the next word
    *("--cfg", "-c", "--package", "-p", "--info", "-i"),
    *("--config-path", "-cp", "--config-name", "-cn", "--config-dir", "-cd"),
)


def hydra_words(words: Sequence[str]) -> list[str]:
    """Return the words for Hydra.

    A first word NAME stands for +exp=NAME. `+exp=NAME` is the file conf/exp/NAME.yaml or, without one, the
    job of that name; NAME VERB is the job NAME_VERB. After the name of a job, words without = are its own
    settings in the order of its file: `evade demo bytestream-s1` is `evade demo demo.policy=bytestream-s1`.
    Old names of jobs and of their settings are replaced by the new ones.
    """
    words = list(words)
    if len(words) > 1 and f"{words[0]}_{words[1]}" in JOBS:
        words[:2] = [f"{words[0]}_{words[1]}"]
    named = words[0] if words else ""
    words[1:] = _placed(words[1:], RENAMED_JOBS.get(named, named))
    known = RENAMED_JOBS.get(named, named) in JOBS or (CONF / "exp" / f"{named}.yaml").is_file()
    first = [f"+exp={named}" if known else named] if words else []
    return [_job(_section(word)) for word in [*first, *words[1:]]]


def _placed(words: Sequence[str], name: str) -> list[str]:
    """Return the words; each word without = becomes the next of the job's own settings."""
    keys = iter(JOBS[name].own_keys() if name in JOBS else ())
    placed = []
    for before, word in zip(["", *words], words, strict=False):
        alone = "=" not in word and not word.startswith(("-", "+", "~")) and before not in TAKE_A_WORD
        key = next(keys, None) if alone else None
        placed.append(word if key is None else f"{name}.{key}={_quoted(word)}")
    return placed


def _quoted(word: str) -> str:
    """Quote a word as a value in Hydra's grammar, in which a backslash escapes only before a quote."""
    if re.fullmatch(r"[\w./:@-]+", word):
        return word
    inner = re.sub(r"(\\*)('|$)", lambda found: found[1] * 2 + ("\\'" if found[2] else ""), word)
    return f"'{inner}'"


def given_keys(words: Sequence[str]) -> set[str]:
    """Return the keys that the words for Hydra set, including every key of a group's file."""
    keys: set[str] = set()
    for word in words:
        match = re.match(r"[+~]*([\w./]+)(?:@[\w.]*)?(?:=(.*))?$", word, re.DOTALL)
        if match is None or match[1] == "job":
            continue
        file = CONF / match[1] / f"{match[2]}.yaml"
        if match[1] == "exp":
            keys |= _experiment(file)
        else:
            keys |= _leaves(file) if file.is_file() else {"exp" if match[1] == "name" else match[1]}
    return keys


def _experiment(file: Path) -> set[str]:
    """Return {"exp"} for the experiment of a policy; stages and studies use the experiment of the run."""
    text = file.read_text() if file.is_file() else ""
    return {"exp"} if f"\nexp: {file.stem}\n" in text and "/job:" not in text else set()


def _leaves(file: Path) -> set[str]:
    """Return the keys of a file of a group, as the command line spells them."""
    import yaml

    text = file.read_text(encoding="utf-8")
    package = "" if "@package _global_" in text else f"{file.parent.name}."
    return {f"{package}{key}" for key, _ in flat(yaml.safe_load(text) or {}) if key != "defaults"}


def once_per_value(words: Sequence[str]) -> str:
    """Return the remedy for a command line that asks for several runs: a loop over the first list."""
    plain = [word for word in words if word not in ("-m", "--multirun") and not word.startswith("hydra.")]
    several = next(
        (word for word in plain if re.fullmatch(r"\+*[\w.]+=[^\[\]{}\"']+,[^\[\]{}\"']+", word)), None
    )
    rule = "one command is one run"
    if several is None:
        return f"{rule}; give it once per value, or name conditions of an evaluation in study.axes"
    key, _, values = several.partition("=")
    kept = shlex.join(word for word in plain if word is not several)
    loop = f'for value in {shlex.join(values.split(","))}; do evade {kept} {key}="$value"; done'
    return f"{rule}; give it once per value: {loop}"


def experiments() -> list[str]:
    """Return all names that `+exp=NAME` takes: files of conf/exp, and jobs that name an experiment."""
    own = [name for name, job in JOBS.items() if "exp" in job.values()]
    return sorted({*own, *(path.stem for path in (CONF / "exp").glob("*.yaml"))})


def _job(word: str) -> str:
    """Return `job=NAME` with the job's current name if the word names a job; otherwise return the word."""
    named = re.fullmatch(r"(?:\+exp|job)=(\w+)", word)
    if not named:
        return word
    name = RENAMED_JOBS.get(named[1], named[1])
    is_job = word.startswith("job=") or (name in JOBS and not (CONF / "exp" / f"{name}.yaml").is_file())
    return f"job={name}" if is_job else f"+exp={name}"


def _section(word: str) -> str:
    """Return the word with the current name of its section."""
    key = re.match(r"([+~]*)(\w+)(?=[.=]|$)", word)
    if not key or key[2] not in RENAMED_SECTIONS:
        return word
    return f"{key[1]}{RENAMED_SECTIONS[key[2]]}{word[key.end() :]}"
