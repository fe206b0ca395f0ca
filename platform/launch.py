"""Compose conf/ and the command line into one checked configuration, and run the job it names.

Run: python -m platform.launch +exp=NAME [group=file] [key=value]; a first word NAME stands for +exp=NAME
Expect: exit status 0 when the job is done, 2 with one message when a value is wrong, 1
when the job fails, 130 after Ctrl+C, 143 after SIGTERM, 129 after SIGHUP.
"""

import contextlib
import errno
import importlib
import importlib.util
import io
import os
import re
import shlex
import signal
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from jobs.config.command_line import experiments, given_keys, hydra_words, once_per_value
from jobs.config.registry import CONF, JOBS
from jobs.run.libraries import hold
from jobs.run.provenance import REPOSITORY as ROOT
from jobs.run.signals import end_on_signals, signal_of
from jobs.run.undo import undo
from jobs.run.variables import variables_set

ENVIRONMENT = "give `make setup`, then `source .venv/bin/activate` and the same command"
# Groups that accept keys that conf/ does not have.
OPEN_GROUPS = ("env.layout", "env.body", "faults.added", "study.axes", "search.space")
UNWRITABLE = {  # error of the operating system: remedy
    errno.ENOSPC: "make room there",
    errno.EDQUOT: "make room there",
    errno.EACCES: "give yourself the right to use it",
    errno.EPERM: "give yourself the right to use it",
    errno.EROFS: "make the file system writable",
}
JOBS_HERE = "  <jobs>"  # placeholder in conf/hydra/help
DONE, FAILED, WRONG_VALUE = 0, 1, 2
ENDED = 128  # plus the number of the signal


def main() -> int:
    """Run the command line; return the exit status."""
    hold()
    end_on_signals()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # an ASCII terminal shows a question mark
    if importlib.util.find_spec("hydra") is None:
        print(
            f"evade: failed: {sys.executable} has not the packages of Evade; {ENVIRONMENT}", file=sys.stderr
        )
        return FAILED
    try:
        values = compose(sys.argv[1:])
        if values is not None:
            run(values)
    except KeyboardInterrupt as error:
        number = signal_of(error)
        ended = "interrupted" if number == signal.SIGINT else f"ended by {signal.Signals(number).name}"
        with contextlib.suppress(OSError):  # the terminal may be closed
            print(f"evade: {ended}; the same command continues where it stopped", file=sys.stderr)
        return ENDED + number
    except Exception as error:
        return report(error)
    return DONE


def command(words: list[str]) -> str:
    """Return this command line for a shell in this folder; outside the clone only `evade` works."""
    started = Path(sys.argv[0])
    evade = started.name == "evade" and started.is_file()
    return shlex.join([*([sys.argv[0]] if evade else [sys.executable, "-m", "platform.launch"]), *words])


def compose(words: list[str]) -> dict[str, object] | None:
    """Compose the configuration as plain containers; return None if Hydra only answered a question.

    Args:
        words: The command line.

    Raises:
        ConfigError: If the command line cannot be composed with conf/.
    """
    import hydra
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    from jobs.config.errors import ConfigError, redacted

    words = hydra_words(words)
    errors = word_errors(words)
    if errors:
        raise ConfigError("\n".join(errors))
    composed: list[Any] = []
    answer = io.StringIO()

    def keep(config: Any) -> None:
        composed.append(OmegaConf.to_container(config, resolve=False))

    given = sys.argv
    sys.argv = [given[0], *words]
    try:
        # The variable makes Hydra raise, instead of printing and exiting.
        with variables_set({"HYDRA_FULL_ERROR": "1"}), contextlib.redirect_stdout(answer):
            hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")(keep)()
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        raise ConfigError(explain(error, words)) from error
    finally:
        sys.argv = given
        print(redacted(with_jobs(answer.getvalue())), end="")
    return composed[0] if composed else None


def with_jobs(answer: str) -> str:
    """Insert the list of jobs into Hydra's help; return other answers unchanged."""
    if JOBS_HERE not in answer:
        return answer
    return answer.replace(JOBS_HERE, "\n".join(f"  {name:<16} {job.summary}" for name, job in JOBS.items()))


def word_errors(words: list[str]) -> list[str]:
    """Return one line for each word that Hydra accepts and this launcher does not support."""
    if not (CONF / "config.yaml").is_file():
        return [f"conf/config.yaml: not found in {str(ROOT)!r}; install from a clone with `pip install -e .`"]
    errors = []
    for word in words:
        if word in ("-m", "--multirun") or re.match(r"\+*hydra\.(mode|sweep)", word):
            errors.append(f"{word}: {once_per_value(words)}")
        elif re.match(r"[+~]*hydra[./=@]|--experimental-rerun", word):
            errors.append(f"{word}: Hydra's own settings are fixed; results go to runs_dir")
    return errors


def explain(error: Exception, words: list[str]) -> str:
    """Return Hydra's error about a command line in one line, with the nearest key or the choices."""
    from jobs.config.config import keys_of_jobs, unknown_key

    text = str(error)
    unknown = re.match(r"Could not override '([^']+)'\.\nTo append to your config use \+(.*)", text)
    if unknown and not unknown[1].startswith(OPEN_GROUPS):
        cause = re.search(r"full_key: (\S+)", str(error.__cause__))
        key = cause[1] if cause and unknown[1] not in keys_of_jobs() else unknown[1]
        return f"{key}: no such key, got {unknown[2]}{unknown_key(key)}"
    choice = re.match(
        r"In '.+': Could not find '([^'/]+)/([^']*)'\n\nAvailable options in .+:\n((\t.+\n)+)", text
    )
    if choice:
        return f"{choice[1]}: must be one of {', '.join(choice[3].split())}, got {choice[2]!r}"
    if text.startswith("Ambiguous value"):
        return f"{text.splitlines()[0]}: write [a,b] for a list; {once_per_value(words)}"
    lines = [line.strip() for line in text.split("\nConfig search path")[0].splitlines()]
    message = " ".join(line for line in lines if line and not line.startswith("See https"))
    return message if any(word in message for word in words) else f"{' '.join(words)}: {message}"


def run(values: dict[str, object]) -> None:
    """Check a composed configuration and run its job.

    Raises:
        ConfigError: If a value is wrong; nothing has been started or written by then.
    """
    from jobs.config.config import ConfigError, parse
    from jobs.config.errors import redacted
    from jobs.run.resumed import check_resumed
    from jobs.tracking.store import of_environment, store_uri

    errors = dict.fromkeys(value_errors(values))
    if errors:
        raise ConfigError("\n".join(errors))
    sys.path.append(str(ROOT))  # for `evade` in another folder: research/ is not installed
    words = hydra_words(sys.argv[1:])
    said = of_environment(values, words, os.environ)
    config = parse(values)
    store_uri(config)
    check_resumed(config, given_keys(words))
    print(
        "\n".join([*said, f"If this is stopped, it continues with: {redacted(command(sys.argv[1:]))}"]),
        flush=True,
    )
    importlib.import_module(JOBS[config.job].module).run(config)


def value_errors(values: object, key: str = "") -> Iterator[str]:
    """Yield one line for each value of a configuration that is missing, or is not plain data."""
    if isinstance(values, dict | list):
        for name, value in values.items() if isinstance(values, dict) else enumerate(values):
            inner = f"{key}.{name}" if key else str(name)
            if re.fullmatch(r"_\w+_", str(name)):
                yield f"{inner}: such keys make Hydra call code; name a job with +exp=NAME, got {value!r}"
            else:
                yield from value_errors(value, inner)
    elif values == "???":
        yield f"exp: not given; name an experiment with +exp=NAME, one of {', '.join(experiments())}"
    elif isinstance(values, str) and "${" in values:
        yield f"{key}: must be the value itself, not a reference to another, got {values!r}"


def report(error: Exception) -> int:
    """Print what went wrong, with a traceback where it helps; return the exit status.

    A ValueError raised by this repository means a wrong value; a RuntimeError or a full disk is a
    documented failure. Their messages suffice; HYDRA_FULL_ERROR=1 also shows their tracebacks.
    Passwords in addresses are never shown.
    """
    from jobs.config.errors import redacted
    from jobs.config.plugins import one_line

    ours = raised_here(error)
    wrong_value = isinstance(error, ValueError) and ours
    if wrong_value:
        undo()
    full = full_disk(error)
    documented = wrong_value or (isinstance(error, RuntimeError) and ours) or full is not None
    if os.environ.get("HYDRA_FULL_ERROR") == "1" or not documented:
        print(redacted("".join(traceback.format_exception(error))), end="", file=sys.stderr)
    message = redacted(full or (str(error) if documented else one_line(error)))
    message = "\n  ".join(["", *message.splitlines()]) if "\n" in message else f" {message}"
    print(f"evade: {'refused' if wrong_value else 'failed'}:{message}", file=sys.stderr)
    return WRONG_VALUE if wrong_value else FAILED


def full_disk(error: Exception) -> str | None:
    """Return the message for an error of the file system that a user can fix; None for another error."""
    if not isinstance(error, OSError) or error.errno not in UNWRITABLE:
        return None
    where = error.filename2 or error.filename  # the second is the target of a copy
    file = f"{where}: " if where else ""
    return f"{file}{os.strerror(error.errno)}; {UNWRITABLE[error.errno]}, and the same command continues"


def raised_here(error: Exception) -> bool:
    """Whether the statement that raised is in this repository's own packages."""
    frames = traceback.extract_tb(error.__traceback__)
    rooms = [ROOT / room for room in ("core", "envs", "models", "jobs", "platform", "research")]
    return bool(frames) and any(Path(frames[-1].filename).is_relative_to(room) for room in rooms)


if __name__ == "__main__":
    sys.exit(main())
