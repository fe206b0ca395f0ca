"""Files that are written whole or not at all: text, bytes and JSON."""

import json
import os
from pathlib import Path
from typing import Any


class RunError(RuntimeError):
    """A run folder that cannot be worked in; the message says why in one line, and what to do."""


def write_json(path: Path, values: Any) -> None:
    """Write plain containers as JSON, whole or not at all; NaN and infinity are refused."""
    write_atomic(path, json.dumps(values, indent=2, allow_nan=False) + "\n")


def read_json(path: Path) -> Any:
    """What `write_json` wrote.

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

    On the disk too: the content is there before its name, and a full disk leaves the old file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError:
        part.unlink(missing_ok=True)
        raise
