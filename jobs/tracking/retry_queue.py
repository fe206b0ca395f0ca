"""Results on their way to a tracking store that does not answer: kept in the run folder until it does."""

import contextlib
import json
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jobs.run.files import write_atomic

REST_S = 30.0  # between two attempts, so that a store that is away does not hold up the work
# How MLflow's calls meet a server that does not answer.
PATIENT = {"MLFLOW_HTTP_REQUEST_MAX_RETRIES": "6"}  # 0, 4, 8, 16, 32 and 64 s apart
QUICK = {"MLFLOW_HTTP_REQUEST_MAX_RETRIES": "0", "MLFLOW_HTTP_REQUEST_TIMEOUT": "20"}


class StoreAway(Exception):
    """One call was not answered."""


@contextlib.contextmanager
def calls(how: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables, which MLflow reads at each call, for a while."""
    before = {name: os.environ.get(name) for name in how}
    os.environ.update(how)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


@dataclass
class RetryQueue:
    """What one MLflow run has still to be told, oldest first, as lines of JSON.

    Attributes:
        file: Where it waits; there is none while nothing waits.
    """

    file: Path
    _next_s: float = field(default=0.0, repr=False)

    def rows(self) -> list[dict[str, Any]]:
        """What waits; half a line that a kill left is dropped."""
        text = self.file.read_text() if self.file.is_file() else ""
        return [json.loads(line) for line in text[: text.rfind("\n") + 1].splitlines()]

    def deliver(self, new: Sequence[dict[str, Any]], send: Callable[[dict[str, Any]], None]) -> str | None:
        """Send what waits and what is new, in order; keep what could not be sent.

        Args:
            new: Rows to send after those that wait.
            send: Sends one, or raises StoreAway; may be told the same row twice.

        Returns:
            Why rows wait from now on; None if none wait, or if they waited before.
        """
        waited = self.rows()
        if waited and time.monotonic() < self._next_s:
            self._keep([*waited, *new])
            return None
        rows = [*waited, *new]
        for sent, row in enumerate(rows):
            try:
                send(row)
            except StoreAway as error:
                self._keep(rows[sent:])
                self._next_s = time.monotonic() + REST_S
                return None if waited else str(error)
        self.file.unlink(missing_ok=True)
        return None

    def _keep(self, rows: Sequence[dict[str, Any]]) -> None:
        write_atomic(self.file, "".join(json.dumps(row, allow_nan=False) + "\n" for row in rows))
