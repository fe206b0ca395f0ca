"""A result: a JSON file with scores and provenance, and a CSV file with every episode in the same folder.

`read_result` accepts only consistent results. It checks the schema, the JSON's checksum, the protocol's
SHA-256, the CSV's SHA-256, one episode for each corridor of each cell, and the scores against the episodes.
A forgery that passes all of these is detected by repeating episodes: `evade bench verify`.
"""

import csv
import hashlib
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pydantic
from pydantic import Field

from jobs.bench.protocol import Cell, Protocol
from jobs.bench.score import Episodes, score
from jobs.rollout.episodes import ADDED, EPISODE
from jobs.rollout.table import as_table, episodes_of
from jobs.run.files import RunError, read_json, write_atomic, write_json

LABELS = ("Corruption", "Severity")
Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Rate = Annotated[float, Field(ge=0.0, le=1.0)]
Text = Annotated[str, Field(min_length=1, max_length=200)]
Kind = Literal["folder", "onnx", "function", "baseline"]


class Cost(pydantic.BaseModel, extra="forbid", strict=True):
    """Cost of a policy, measured on the machine that evaluated it; a verification does not repeat it."""

    bytes: Annotated[int, Field(ge=0)] | None
    operations_per_event: Annotated[int, Field(ge=0)] | None
    ms_per_decision: Annotated[float, Field(ge=0.0)]


class Result(pydantic.BaseModel, extra="forbid", strict=True):
    """The JSON file.

    Attributes:
        benchmark, protocol: Name with version, and SHA-256 of the protocol's file.
        part: "C" or "W".
        policy, training: Group, and the training's seed if the group has several.
        kind: "folder", "onnx", "function" or "baseline".
        identity: Hash of the policy's manifest, file or module.
        source: Where others can get the policy, such as a link; empty: not given.
        action: How a policy folder or an ONNX file chooses its action.
        met: Corruptions with a severity in the policy's training.
        mce, clean, worst, errors, failures: As in `jobs.bench.score.Scores`.
        episodes: SHA-256 of the CSV file.
        commit, processor: Code and machine of the evaluation.
    """

    benchmark: Text
    protocol: Digest
    part: Text
    policy: Text
    training: Annotated[int, Field(ge=0)] | None
    kind: Kind
    identity: Text
    source: str
    action: Literal["deterministic", "stochastic"]
    met: list[str]
    mce: Annotated[float, Field(ge=0.0)]
    clean: Rate
    worst: Rate
    errors: dict[str, Annotated[float, Field(ge=0.0)]]
    failures: dict[str, list[Rate]]
    cost: Cost
    episodes: Digest
    commit: Text
    processor: Text

    @property
    def name(self) -> str:
        """Return the name of the result's files without suffix."""
        seed = "" if self.training is None else f"-s{self.training}"
        return f"{self.policy}{seed}-{self.part}"


@dataclass(frozen=True)
class Submission:
    """A result with its episodes."""

    result: Result
    episodes: dict[Cell, np.ndarray]


class RefusedResultError(RunError):
    """A result that is inconsistent or does not follow the protocol."""


def csv_of(episodes: Episodes) -> str:
    """Return the episodes as the text of the CSV file."""
    text = io.StringIO()
    as_table(LABELS, episodes).to_csv(text, index=False, lineterminator="\n")
    return text.getvalue()


def write_result(folder: Path, result: Result, text: str) -> Path:
    """Write both files; return the JSON file."""
    write_atomic(folder / f"{result.name}.csv", text)
    write_json(folder / f"{result.name}.json", result.model_dump())
    return folder / f"{result.name}.json"


def read_result(path: Path, protocol: Protocol) -> Submission:
    """Read and check a result.

    Raises:
        RefusedResultError: The result is invalid; the message states the violated rule.
    """
    try:
        result = Result(**read_json(path))
    except RunError:
        rule = "must be the file that `evade bench` wrote, unchanged"
        raise RefusedResultError(f"{path}: {rule}; its checksum differs, or it is no JSON") from None
    except (pydantic.ValidationError, TypeError) as error:
        raise RefusedResultError(f"{path}: {_first_line(error)}") from None
    except OSError as error:
        raise RefusedResultError(f"{path}: cannot be read ({error.strerror})") from None
    table = path.with_suffix(".csv")
    if not table.is_file():
        raise RefusedResultError(f"{table}: is missing; it holds every episode")
    text = table.read_text(encoding="utf-8")
    _require(path, "benchmark", protocol.title, result.benchmark)
    _require(path, "protocol", protocol.sha256, result.protocol)
    _require(table, "SHA-256", result.episodes, hashlib.sha256(text.encode()).hexdigest())
    if result.part not in protocol.parts:
        raise RefusedResultError(f"{path}: part must be one of {list(protocol.parts)}, got {result.part!r}")
    episodes = _episodes_of(table, text, protocol, result.part)
    _check_scores(path, result, episodes, protocol)
    return Submission(result, episodes)


def _first_line(error: Exception) -> str:
    """Return the first problem in an error as one line."""
    if isinstance(error, pydantic.ValidationError):
        problem = error.errors()[0]
        return f"{'.'.join(map(str, problem['loc']))}: {problem['msg']}"
    return str(error).splitlines()[0]


def _require(path: Path, what: str, expected: object, found: object) -> None:
    if expected != found:
        raise RefusedResultError(f"{path}: {what} must be {expected}, got {found}")


def _episodes_of(table: Path, text: str, protocol: Protocol, part: str) -> dict[Cell, np.ndarray]:
    """Parse the episodes of a CSV file by cell; require exactly one for each corridor of each cell."""
    cells = protocol.cells(part)
    rows = list(csv.reader(io.StringIO(text)))
    columns = rows[0][len(LABELS) :] if rows else []
    known = [name for name in EPISODE.names or () if name in columns or name not in ADDED]
    _require(table, "columns", [*LABELS, *known], rows[0] if rows else [])
    found: dict[Cell, list[tuple[Any, ...]]] = {cell: [] for cell in cells}
    for number, row in enumerate(rows[1:], 2):
        try:
            cell, values = (row[0], int(row[1])), _values(row[2:], columns)
            found[cell].append(values)
        except (KeyError, ValueError, IndexError):
            raise RefusedResultError(f"{table}: line {number} must be an episode, got {row}") from None
    arrays = {cell: episodes_of(values, columns) for cell, values in found.items()}
    for cell, episodes in arrays.items():
        if not np.array_equal(episodes["seed"], np.arange(protocol.corridors)):
            rule = f"must have the corridors 0 to {protocol.corridors - 1} once each, in their order"
            raise RefusedResultError(f"{table}: {cell[0]} {cell[1]} {rule}")
    return arrays


def _values(row: list[str], columns: Sequence[str]) -> tuple[Any, ...]:
    """Parse these fields of an EPISODE; raise ValueError or KeyError if one is malformed or not finite."""
    kinds = [EPISODE[name].kind for name in columns]
    read: dict[str, Any] = {"b": {"True": True, "False": False}.__getitem__, "i": int, "f": float}
    values = tuple(read[kind](text) for text, kind in zip(row, kinds, strict=True))
    if not all(math.isfinite(value) for value in values):
        raise ValueError("must be finite")
    return values


def _check_scores(path: Path, result: Result, episodes: Episodes, protocol: Protocol) -> None:
    """Check that the scores match the episodes."""
    own: Mapping[str, Any] = score([episodes], protocol.reference["failures"])._asdict()
    for name in ("mce", "clean", "worst", "errors", "failures"):
        _require(path, name, own[name], getattr(result, name))
