"""Files that are written whole or not at all: text, bytes and JSON."""

import contextlib
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any


class RunError(RuntimeError):
    """A run folder cannot be used; the message says why in one line, and what to do."""


def write_json(path: Path, values: object) -> None:
    """Write plain containers as JSON, whole or not at all; NaN and infinity are refused."""
    write_atomic(path, json.dumps(values, indent=2, allow_nan=False) + "\n")


def read_json(path: Path) -> Any:
    """Read what `write_json` wrote.

    Raises:
        RunError: The file is damaged.
    """
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        remedy = "delete it, and the same command makes it anew"
        raise RunError(f"{path}: must be JSON, got a damaged file ({error}); {remedy}") from None


def write_atomic(path: Path, content: str | bytes) -> None:
    """Write a file so that a reader sees the old content or the new one, never a part.

    This holds on the disk too: the content is stored before its name, and a full disk leaves the old file.
    """
    with replaced(path) as part, part.open("wb") as file:
        file.write(content.encode() if isinstance(content, str) else content)
        file.flush()
        os.fsync(file.fileno())


@contextlib.contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """Yield a path to write to; the file takes its final name when the block ends without an error."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
