"""Metrics that the tracking store has not accepted yet; they wait in the run folder until it answers."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypedDict

from jobs.run.files import append_json_lines, json_lines, read_json_lines, write_atomic

RETRY_AFTER_S = 30.0  # so that a store that does not answer does not delay the job
# Variables that MLflow reads at each call: how often it retries a server that does not answer.
MANY_RETRIES = {"MLFLOW_HTTP_REQUEST_MAX_RETRIES": "6"}  # 0, 4, 8, 16, 32 and 64 s apart
NO_RETRIES = {"MLFLOW_HTTP_REQUEST_MAX_RETRIES": "0", "MLFLOW_HTTP_REQUEST_TIMEOUT": "20"}


class StoreUnavailable(Exception):
    """The store did not answer a call."""


class LoggedStep(TypedDict):
    """The metrics of one step, and the names of those that were not measured."""

    step: int
    time_ms: int
    metrics: dict[str, float]
    missing: list[str]


@dataclass
class RetryQueue:
    """The logged steps that one MLflow run still lacks, oldest first, as lines of JSON.

    Attributes:
        file: File of the waiting steps; it exists only while steps wait.
    """

    file: Path
    _retry_at_s: float = field(default=0.0, repr=False)

    @property
    def record(self) -> Path:
        """Return the file of all steps, delivered or not, as lines of JSON."""
        return self.file.with_name(f"metrics-{self.file.name.removeprefix('undelivered-')}")

    def recorded(self) -> list[LoggedStep]:
        """Read all steps, delivered or not; if a step was logged twice, only its last metrics."""
        rows: list[LoggedStep] = read_json_lines(self.record)
        return list({(row["step"], *sorted(row["metrics"])): row for row in rows}.values())

    def rows(self) -> list[LoggedStep]:
        """Read the waiting steps; drop an incomplete last line that a kill left.

        Raises:
            RunError: A line is damaged.
        """
        return read_json_lines(self.file)

    def deliver(self, new: LoggedStep, send: Callable[[LoggedStep], None]) -> str | None:
        """Send the waiting steps and the new one, in order; store the steps that could not be sent.

        Each step is also written to `record`, for another MLflow run of the same folder.

        Args:
            new: The step to send after the waiting ones.
            send: Sends one, or raises StoreUnavailable; may get the same step twice.

        Returns:
            Why steps wait from now on; None if none wait, or if some waited before.
        """
        append_json_lines(self.record, [new])
        waited = self.rows()
        rows = [*waited, new]
        if waited and time.monotonic() < self._retry_at_s:
            self._keep(rows)
            return None
        for sent, row in enumerate(rows):
            try:
                send(row)
            except StoreUnavailable as error:
                self._keep(rows[sent:])
                self._retry_at_s = time.monotonic() + RETRY_AFTER_S
                return None if waited else str(error)
        self.file.unlink(missing_ok=True)
        return None

    def _keep(self, rows: Sequence[LoggedStep]) -> None:
        write_atomic(self.file, json_lines(rows))
