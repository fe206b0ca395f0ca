"""Read event files by the keys `recording.*`, as every command does, and print the reader's warnings."""

import contextlib
import dataclasses
import math
import re
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from envs.recordings import read_events, read_parts
from envs.recordings.event_file import EventFile
from jobs.config.config import ConfigError
from jobs.config.schema import RecordingConfig
from jobs.run.progress import console

BARE_ROW = re.compile(rb"\d+\.\d+\s+\d+\s+\d+\s+[01]\s*")  # of the Event Camera Dataset (IJRR 2017)
TELL_EVERY_S = 10.0
KEYS = tuple(field.name for field in dataclasses.fields(RecordingConfig))
EXAMPLES = {"columns": "[t,x,y,p]", "time_unit": "us", "strict": "true", "stream": "0", "start_us": "0"}


def read_recording(path: str | Path, settings: RecordingConfig) -> EventFile:
    """Return the events of a file, and print the reader's warnings: what it left out, chose or missed.

    Raises:
        ValueError: As `envs.recordings.read_events`.
    """
    with _printing():
        return read_events(path, **options(path, settings))


def recording_parts(path: str | Path, settings: RecordingConfig) -> Iterator[EventFile]:
    """Yield the events of a file in parts, and print the progress every `TELL_EVERY_S`.

    Raises:
        ValueError: As `envs.recordings.read_parts`, or for more than `max_events` events.
    """
    count, told = 0, math.inf  # the first part may have to compile its reader
    given = options(path, settings)
    most = given.pop("max_events")
    parts = read_parts(path, **given)
    while True:
        with _printing():
            part = next(parts, None)
        if part is None:
            return
        count += len(part.events)
        if most is not None and count > most:
            raise ValueError(
                f"{path}: contains more than max_events={most} events; raise max_events, or give start_us "
                "and end_us"
            )
        told = min(told, time.monotonic())
        if time.monotonic() - told > TELL_EVERY_S:
            told = time.monotonic()
            console.print(f"{Path(path).name}: {count / 1e6:,.1f} million events read")
        yield part


def options(path: str | Path, settings: RecordingConfig) -> dict[str, Any]:
    """Return the arguments of `read_events`; for bare rows of the Event Camera Dataset, fill them in."""
    given = {name: getattr(settings, name) for name in KEYS}
    if given["columns"] is None and given["format"] in (None, "txt") and Path(path).is_file():
        with Path(path).open("rb") as file:
            if BARE_ROW.match(file.read(100)):
                given |= {"format": "txt", "columns": ["t", "x", "y", "p"]}
                given["time_unit"] = given["time_unit"] or "s"
    return given


@contextlib.contextmanager
def refusing(key: str, path: str | Path) -> Iterator[None]:
    """Convert the errors of a block that reads a file for a command.

    Raises:
        ConfigError: The file cannot be read; the message ends with the keys that the remedy names.
    """
    try:
        yield
    except (ValueError, OSError) as error:
        said = str(error) if str(error).startswith(str(path)) else f"{path}: {error}"
        named = [name for name in KEYS if re.search(rf"\b{name}\b", said.partition(": ")[2])]
        spelled = " ".join(f"recording.{name}={EXAMPLES.get(name, name.upper())}" for name in named)
        raise ConfigError(f"{key}: {said}{f' (as {spelled})' if spelled else ''}") from error


@contextlib.contextmanager
def _printing() -> Iterator[None]:
    """Print the warnings of a block as plain lines, with keys of the command line for names of arguments."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", UserWarning)
        yield
    for warning in said:
        text = re.sub(r"\b(topic|group|stream)= chooses", r"recording.\1 chooses", str(warning.message))
        console.print(text.replace("strict=True", "recording.strict=true"))
