"""Write text and bytes atomically, and JSON with a checksum.

A power failure, a full disk or an interrupted copy can change one digit of a result, so that the file is
still valid JSON. The checksum detects this.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from core.files import naming
from core.files import write_atomic as write_atomic  # re-exported for the jobs
from envs.config import settings_hash

CHECKSUM = "checksum"  # covers the other values of a JSON object; older files have none


class RunError(RuntimeError):
    """A run folder cannot be used; the message says why in one line, and what to do."""


def write_json(path: Path, values: object) -> None:
    """Write plain containers as JSON, atomically; NaN and infinity raise a ValueError.

    An object gets a checksum, which `read_json` verifies and removes.
    """
    kept = with_checksum(values) if isinstance(values, Mapping) else values
    write_atomic(path, json.dumps(kept, indent=2, allow_nan=False) + "\n")


def read_json(path: Path) -> Any:
    """Read a file that `write_json` wrote.

    Raises:
        RunError: The file is damaged.
    """
    try:
        return without_checksum(json.loads(path.read_bytes()))
    except ValueError as error:
        remedy = "delete it, and the same command makes it again"
        raise RunError(f"{path}: must be JSON, got a damaged file ({error}); {remedy}") from None


def with_checksum(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a JSON object, converted as JSON stores them, with their checksum."""
    text = json.dumps({name: value for name, value in values.items() if name != CHECKSUM}, allow_nan=False)
    own = json.loads(text)
    return {**own, CHECKSUM: settings_hash(own)}


def without_checksum(values: Any) -> Any:
    """Return the values of a JSON object without their checksum; values without one are returned unchanged.

    Raises:
        ValueError: The values do not match the checksum.
    """
    if not isinstance(values, dict) or CHECKSUM not in values:
        return values
    if values != with_checksum(values):
        raise ValueError("other values than its checksum says")
    return {name: value for name, value in values.items() if name != CHECKSUM}


def json_lines(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return rows as lines of JSON, each with its checksum; NaN and infinity raise a ValueError."""
    return "".join(json.dumps(with_checksum(row), allow_nan=False) + "\n" for row in rows)


def append_json_lines(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Append `json_lines` to a file, created if missing; first remove an incomplete last line."""
    with naming(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab") as lines:
            lines.truncate(len(whole_lines(path)))
            lines.write(json_lines(rows).encode())


def read_json_lines(path: Path) -> list[Any]:
    """Read the rows of a file of `json_lines`, without an incomplete last line; empty without a file.

    Raises:
        RunError: A line is damaged.
    """
    lines = whole_lines(path).splitlines()
    rows = []
    for number, line in enumerate(lines, 1):
        try:
            rows.append(without_checksum(json.loads(line)))
        except ValueError as error:
            remedy = "delete the line, and the same command goes on without it"
            raise RunError(f"{path}: line {number} is damaged ({error}); {remedy}") from None
    return rows


def whole_lines(path: Path) -> bytes:
    """Return a file's content up to its last line end; empty without a file."""
    content = path.read_bytes() if path.is_file() else b""
    return content[: content.rfind(b"\n") + 1]
