"""How a user's words become the words that Hydra composes: experiments, jobs, and names that changed."""

import re
from collections.abc import Mapping, Sequence

from jobs.config.registry import CONF, JOBS

RENAMED_JOBS = {"ship": "publish", "tune": "search"}  # old name -> new
RENAMED_SECTIONS = {"tune": "search", "video": "video_events"}
EXPERIMENT = re.compile(r"\+exp=(\w+)")


def hydra_words(words: Sequence[str], jobs: Mapping[str, object] = JOBS) -> list[str]:
    """Return the words for Hydra.

    A first word NAME stands for +exp=NAME. `+exp=NAME` is the file conf/exp/NAME.yaml or, without one, the
    job of that name. Old names of jobs and of their settings stand for the new ones.
    """
    named = words[0] if words else ""
    known = RENAMED_JOBS.get(named, named) in jobs or (CONF / "exp" / f"{named}.yaml").is_file()
    first = [f"+exp={named}" if known else named] if words else []
    return [_job(_section(word), jobs) for word in [*first, *words[1:]]]


def experiments() -> list[str]:
    """Return all names that `+exp=NAME` takes: files of conf/exp, and jobs that name an experiment."""
    own = [name for name, job in JOBS.items() if "exp" in job.values()]
    return sorted({*own, *(path.stem for path in (CONF / "exp").glob("*.yaml"))})


def _job(word: str, jobs: Mapping[str, object]) -> str:
    """Return `job=NAME` for the experiment that a job is, under its present name; other words as they are."""
    named = EXPERIMENT.fullmatch(word) or re.fullmatch(r"job=(\w+)", word)
    if not named:
        return word
    name = RENAMED_JOBS.get(named[1], named[1])
    is_job = word.startswith("job=") or (name in jobs and not (CONF / "exp" / f"{name}.yaml").is_file())
    return f"job={name}" if is_job else f"+exp={name}"


def _section(word: str) -> str:
    """Return the word with the present name of its section."""
    key = re.match(r"([+~]*)(\w+)(?=[.=]|$)", word)
    if not key or key[2] not in RENAMED_SECTIONS:
        return word
    return f"{key[1]}{RENAMED_SECTIONS[key[2]]}{word[key.end() :]}"
