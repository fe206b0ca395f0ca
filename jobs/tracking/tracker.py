"""Runs in MLflow: parameters, metrics, tags, files and pages.

One process creates the store (two at once break it). Only the driver writes, in batches: hundreds of
single writes take seconds, a batch a few hundredths of one.

If the store does not answer, training continues: metrics wait in the run folder until the store
answers again. All other calls (tables, plots, the runs themselves) wait two minutes, then the job
stops. Its results are in the run folder, and the same command records them from there.
"""

import contextlib
import dataclasses
import json
import logging
import math
import os
import re
import shlex
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from core.files import replaced
from envs.config import settings_hash
from jobs.config.config import Config, as_dict
from jobs.config.errors import redacted
from jobs.run.files import read_json, write_json
from jobs.run.folder import Run, check_writable
from jobs.run.locks import held_alone, locked, private_folder
from jobs.run.progress import console
from jobs.run.provenance import provenance
from jobs.run.undo import undo_if_refused
from jobs.run.variables import variables_set
from jobs.tracking.clock import now_ms
from jobs.tracking.pages import (
    NOTE,
    PREVIEWS,
    VIEW_TAG,
    Page,
    experiment_note,
    packed_view,
    preview,
    run_address,
    run_note,
    stored_views,
    usual_views,
    view_address,
)
from jobs.tracking.retry_queue import MANY_RETRIES, NO_RETRIES, LoggedStep, RetryQueue, StoreUnavailable
from jobs.tracking.store import (
    check_metrics,
    dashboard_command,
    flatten,
    page,
    quoted,
    sqlite_file,
    store_uri,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from mlflow import MlflowClient
    from mlflow.exceptions import MlflowException

BATCH = 100  # MLflow's limit on parameters and on tags of one call
KNOWN_RUNS = "tracking.json"  # in a run folder
REMEDIES = {  # SQLite's message: remedy
    "disk is full": "make room there; ",
    "disk I/O error": "make room there; ",
    "malformed": "the file is damaged: move it away for a new one; ",
    "not a database": "the file is damaged: move it away for a new one; ",
}
REFUSALS = {  # MLflow's message, as a regular expression: remedy
    "UNAUTHENTICATED|code 401": "set MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD",
    "PERMISSION_DENIED|code 403": "ask its owner for permission, or name your own tracking.experiment=NAME",
    "active' state|INVALID_STATE": "restore it in MLflow's page, or name another tracking.experiment=NAME",
}
UNAVAILABLE = ("INTERNAL_ERROR", "TEMPORARILY_UNAVAILABLE")  # MLflow's codes after which a retry may help


class TrackingError(RuntimeError):
    """The tracking store does not answer; the message says where the results are."""


@dataclass(frozen=True)
class Tracker:
    """One MLflow run that is being written; `uri` is the store's address without a password."""

    client: "MlflowClient"
    uri: str
    experiment_id: str
    run_id: str
    retry_queue: RetryQueue

    def log(self, step: int, metrics: Mapping[str, float]) -> None:
        """Write metrics of one step in one batch, now or when the store answers again.

        Args:
            step: Position on the run's own axis, such as environment steps [-].
            metrics: `section/name` -> value. NaN means "not measured": it is left out, and
                the tag `not_measured` names it.

        Raises:
            ValueError: A value is infinite (MLflow would store 1.8e308 without a message), a name is
                in no known section, or there are more metrics than `jobs.tracking.store.MAX_METRICS`.
        """
        values = check_metrics(metrics)
        if not values:  # a resumed job may have nothing new to log
            return
        missing = sorted(name for name, value in values.items() if math.isnan(value))
        measured = {name: value for name, value in values.items() if name not in missing}
        row: LoggedStep = {"step": step, "time_ms": now_ms(), "metrics": measured, "missing": missing}
        with variables_set(NO_RETRIES):
            reason = self.retry_queue.deliver(row, self._send)
        if reason is not None:
            console.print(f"{self.uri} does not answer, results wait in {self.retry_queue.file}: {reason}")

    def _send(self, row: LoggedStep) -> None:
        """Write the metrics of a step; writing the same row twice adds no points, as their times are equal.

        Raises:
            StoreUnavailable: The store does not answer.
        """
        from mlflow.entities import Metric, RunTag
        from mlflow.exceptions import MlflowException

        step, missing = row["step"], row["missing"]
        metrics = [Metric(name, value, row["time_ms"], step) for name, value in row["metrics"].items()]
        tags = [RunTag("not_measured", f"step {step}: {', '.join(missing)}")] if missing else []
        try:
            self.client.log_batch(self.run_id, metrics=metrics, tags=tags)
        except MlflowException as error:
            if error.error_code not in UNAVAILABLE:
                raise
            raise StoreUnavailable(_reason(error)) from error

    def log_once(self, step: int, metrics: Mapping[str, float]) -> None:
        """Write only the points that the run lacks: MLflow would draw a repeated point twice."""
        held = {
            (name, point.step, point.value)
            for name in self.client.get_run(self.run_id).data.metrics.keys() & metrics.keys()
            for point in self.client.get_metric_history(self.run_id, name)
        }
        self.log(step, {name: value for name, value in metrics.items() if (name, step, value) not in held})

    def params(self, values: Mapping[str, object]) -> None:
        """Write settings that the run does not have yet, nested mappings as `outer.inner`."""
        from mlflow.entities import Param

        known = self.client.get_run(self.run_id).data.params
        new = [Param(key, text) for key, text in flatten(values).items() if key not in known]
        for first in range(0, len(new), BATCH):
            self.client.log_batch(self.run_id, params=new[first : first + BATCH])

    def tags(self, values: Mapping[str, object]) -> None:
        """Write tags; a tag that exists takes the new value."""
        from mlflow.entities import RunTag

        self.client.log_batch(self.run_id, tags=[RunTag(key, str(value)) for key, value in values.items()])

    def figure(self, name: str, figure: "Figure") -> None:
        """Write a plot as a picture file called `name`."""
        self.client.log_figure(self.run_id, figure, name, save_kwargs={"dpi": 120})

    def text(self, name: str, text: str) -> None:
        """Write a text file called `name`."""
        self.client.log_text(self.run_id, text, name)

    def table(self, name: str, columns: Mapping[str, Sequence[object]]) -> None:
        """Write a table as `name`.json, replacing an earlier one; values of the first column are unique."""
        written = {file.path for file in self.client.list_artifacts(self.run_id, str(Path(name).parent))}
        if f"{name}.json" not in written:
            self.client.log_table(self.run_id, dict(columns), f"{name}.json")
        else:  # `log_table` would append to it
            import pandas as pd  # takes half a second

            text = pd.DataFrame(dict(columns)).to_json(orient="split", index=False)
            self.client.log_text(self.run_id, text, f"{name}.json")

    def artifact(self, path: Path, folder: str | None = None) -> None:
        """Write a file, as it is, into a folder of the run's artifacts."""
        self.client.log_artifact(self.run_id, str(path), folder)

    def of(self, path: Path) -> "Tracker":
        """Return the MLflow run of another run folder in the same store; this one, if there is none."""
        run_id = _known_runs(path).get(_slot(self, "run"), self.run_id)
        return dataclasses.replace(self, run_id=run_id)

    def save_view(self, key: str, name: str, state: Mapping[str, object]) -> None:
        """Store a view of the experiment's runs under "Views", unless it is there unchanged.

        Args:
            key: Identity of the view; the same key replaces it.
            name: Name in the menu.
            state: State as returned by `jobs.tracking.pages.table_view` or `chart_view`.
        """
        tag, view = f"{VIEW_TAG}.{key}", packed_view(name, state, now_ms())
        old = json.loads(self.client.get_experiment(self.experiment_id).tags.get(tag, "{}"))
        if old.get("state") != json.loads(view)["state"]:
            self.client.set_experiment_tag(self.experiment_id, tag, view)

    def describe_experiment(self) -> None:
        """Store the usual views, and write the text above the table of runs, unless it is there."""
        for key, name, state in usual_views():
            self.save_view(key, name, state)
        tags = self.client.get_experiment(self.experiment_id).tags
        note = experiment_note(self.experiment_id, tags)
        if tags.get(NOTE) != note:
            self.client.set_experiment_tag(self.experiment_id, NOTE, note)

    def write_page(self) -> None:
        """Rewrite the text at the top of the run's page, with small copies of all its pictures."""
        files = [path for path in self.files() if not path.startswith(f"{PREVIEWS}/")]
        with tempfile.TemporaryDirectory() as place:
            pictures = [path for path in files if path.endswith(".png")]
            for path in pictures:
                small = preview(Path(self.client.download_artifacts(self.run_id, path, place)).read_bytes())
                self.client.log_image(self.run_id, small, artifact_file=f"{PREVIEWS}/{path}")
            tables = {
                path: Path(self.client.download_artifacts(self.run_id, path, place)).read_text()
                for path in files
                if path.endswith(".md")
            }
        run, views = self.client.get_run(self.run_id), self.client.get_experiment(self.experiment_id).tags
        own = {key: name for key, name in stored_views(views).items() if key.endswith(self.run_id)}
        small_ones = [f"{PREVIEWS}/{path}" for path in pictures]
        facts = run.data.params, run.data.tags, run.data.metrics
        shown = Page(self.experiment_id, self.run_id, *facts, [*files, *small_ones], tables, own)
        self.tags({NOTE: run_note(shown)})

    def files(self, folder: str | None = None) -> list[str]:
        """Return the paths of all artifacts of the run."""
        found = self.client.list_artifacts(self.run_id, folder)
        return [path for file in found for path in (self.files(file.path) if file.is_dir else [file.path])]

    def dashboard(self) -> str:
        """Return the command that opens the dashboard, and the addresses to open in it."""
        lines = [] if self.uri.startswith("http") else [f"Dashboard: {dashboard_command(self.uri)}"]
        own = run_address(self.experiment_id, self.run_id), view_address(self.experiment_id, "results")
        this, every = (f"{page(self.uri)}/{address}" for address in own)
        return "\n".join([*lines, f"This run:  {this}", f"All runs:  {every}"])


@contextlib.contextmanager
def open_tracker(config: Config, folder: Run, key: str = "run") -> Iterator[Tracker]:
    """Open the MLflow run of a run folder, the existing one or a new one; yield its tracker.

    The MLflow run ends as FINISHED, as FAILED after an exception, or as KILLED after Ctrl+C. Until then
    no other process can work in the run folder.

    Args:
        config: Names the store and the experiment.
        folder: The run folder; it stores the MLflow run's id, and its settings become parameters.
        key: Name of the MLflow run among the folder's MLflow runs.

    Raises:
        RunError: Another process works in the run folder.
        TrackingError: The store does not answer.
    """
    uri = store_uri(config)
    name = folder.path.name if key == "run" else f"{folder.path.name} {key}"
    facts = {"run_folder": folder.path, "job": config.job, **provenance()}
    with held_alone(folder.path), _answering(uri, folder):
        client, experiment_id = open_store(uri, config.tracking.experiment, config.cluster.storage)
        waiting = folder.path / f"undelivered-{quote(key, safe='')}.jsonl"
        store = Tracker(client, redacted(uri), experiment_id, "", RetryQueue(waiting))
        tracker = _continue_or_create(store, folder, key, name)
        with _ended(tracker):
            tracker.params(as_dict(folder.config))
            tracker.tags({**facts, "mlflow.source.git.commit": facts["commit"]})
            tracker.artifact(folder.path / "config.yaml")
            tracker.describe_experiment()
            tracker.write_page()
            yield tracker
            tracker.describe_experiment()
            tracker.write_page()


@contextlib.contextmanager
def _answering(uri: str, folder: Run) -> Iterator[None]:
    """Raise one clear TrackingError if the store does not answer, is full or is damaged."""
    from mlflow.exceptions import MlflowException
    from sqlalchemy.exc import DBAPIError

    try:
        with variables_set(MANY_RETRIES):
            yield
    except (MlflowException, StoreUnavailable, DBAPIError) as error:
        reason = _reason(error)
        remedy = next((remedy for sign, remedy in REMEDIES.items() if sign in reason), "")
        if isinstance(error, MlflowException) and error.error_code not in UNAVAILABLE and not remedy:
            raise _refusal(error, uri, folder) or error from error
        rest = f"{remedy}what was computed is in {folder.path}, the same command records it"
        raise TrackingError(f"tracking.uri: {redacted(uri)} does not answer ({reason}); {rest}") from error


def _refusal(error: "MlflowException", uri: str, folder: Run) -> "TrackingError | None":
    """Return the error for a store that answers with a refusal; None if no remedy is known."""
    said = redacted(" ".join(str(error).split())[:200])
    signs = (sign for sign in REFUSALS if re.search(sign, f"{error.error_code} {said}"))
    remedy = REFUSALS.get(next(signs, ""))
    if remedy is None:
        return None
    rest = f"what was computed is in {folder.path}, the same command records it"
    return TrackingError(f"tracking.uri: {redacted(uri)} refuses ({said}); {remedy}; {rest}")


def _reason(error: Exception) -> str:
    """Return the cause of an error: the last words of MLflow's message, or SQLite's own."""
    lines = str(error).strip().splitlines()
    cause = next((line for line in lines if line.startswith("(sqlite3.")), lines[0])
    return cause.rpartition("Caused by ")[2][:200]


@contextlib.contextmanager
def _ended(tracker: Tracker) -> Iterator[None]:
    """Set the run's status at the end of a block; deliver waiting metrics before the status FINISHED."""
    from mlflow.exceptions import MlflowException

    try:
        yield
        for row in tracker.retry_queue.rows():
            tracker._send(row)
        tracker.retry_queue.file.unlink(missing_ok=True)
        _terminate(tracker, "FINISHED")
    except BaseException as error:
        status = "KILLED" if isinstance(error, KeyboardInterrupt) else "FAILED"
        # An error of the store must not hide why the block ended.
        with contextlib.suppress(MlflowException), variables_set(NO_RETRIES):
            _terminate(tracker, status)
        raise


def _terminate(tracker: Tracker, status: str) -> None:
    """Set a run's status and end time, which is never before its start, even if the clock was set back."""
    start_ms = tracker.client.get_run(tracker.run_id).info.start_time
    tracker.client.set_terminated(tracker.run_id, status, max(start_ms, now_ms()))


def _continue_or_create(near: Tracker, folder: Run, key: str, name: str) -> Tracker:
    """Return the MLflow run that the folder has stored under `key`, or create and store a new one."""
    from mlflow.exceptions import MlflowException

    known, slot = _known_runs(folder.path), _slot(near, key)
    run_id = known.get(slot)
    if run_id is not None:
        try:
            near.client.update_run(run_id, status="RUNNING")
            near.client.log_batch(run_id, tags=[])
            return dataclasses.replace(near, run_id=run_id)
        except MlflowException as error:  # the run was deleted: create a new one
            if error.error_code in UNAVAILABLE:
                raise
    run = near.client.create_run(near.experiment_id, now_ms(), tags={"kind": key}, run_name=name)
    undo_if_refused(partial(near.client.delete_run, run.info.run_id))
    write_json(folder.path / KNOWN_RUNS, {**known, slot: run.info.run_id})
    created = dataclasses.replace(near, run_id=run.info.run_id)
    for row in near.retry_queue.recorded():  # in a run that was deleted, or in another store
        created._send(row)
    near.retry_queue.file.unlink(missing_ok=True)  # these rows are among them
    return created


def _known_runs(path: Path) -> dict[str, str]:
    """Return the MLflow runs that a run folder has stored: slot -> id."""
    file = path / KNOWN_RUNS
    return read_json(file) if file.is_file() else {}


def _slot(near: Tracker, key: str) -> str:
    """Return the key of a run folder's MLflow run in this tracking store."""
    return f"{near.uri} {near.experiment_id} {key}"


def open_store(uri: str, experiment: str, storage: str | None = None) -> tuple["MlflowClient", str]:
    """Return a client of the store and the experiment's id; create the store and the experiment if missing.

    `storage` is where a new experiment's artifacts go; None: next to an SQLite file, or the server's place.
    """
    os.environ["MLFLOW_DISABLE_TELEMETRY"] = "true"
    os.environ["MLFLOW_ALLOW_PICKLE_DESERIALIZATION"] = "false"
    os.environ["MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT"] = "true"  # it contains the password
    os.environ.setdefault("MLFLOW_LOGGING_LEVEL", "WARNING")
    os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")
    from mlflow import MlflowClient

    logging.getLogger("alembic").setLevel(logging.WARNING)
    logging.getLogger("mlflow.store.db.utils").setLevel(logging.CRITICAL)  # it also logs what it raises
    name, file = quote(experiment, safe=""), sqlite_file(uri)
    if file is not None:
        lock, location = file.with_suffix(".lock"), (file.parent / "mlartifacts" / name).as_uri()
    else:
        lock, location = private_folder() / f"store-{settings_hash({'uri': uri})[:8]}.lock", None
    if storage is not None:
        location = f"{storage.rstrip('/')}/mlartifacts/{name}"
    with locked(lock):
        if file is not None:
            _create_or_check(file)
        client = MlflowClient(tracking_uri=uri)
        if file is not None:
            _remove_stray(uri, file)
        known = client.get_experiment_by_name(experiment)
        if known is not None and known.lifecycle_stage != "active":
            raise TrackingError(_deleted(redacted(uri), experiment, known.experiment_id))
        return client, known.experiment_id if known else client.create_experiment(experiment, location)


def _deleted(uri: str, experiment: str, experiment_id: str) -> str:
    """Return the message for an experiment that was deleted in MLflow, with the command that restores it."""
    restore = f"MLFLOW_TRACKING_URI={shlex.quote(uri)} mlflow experiments restore -x {experiment_id}"
    remedy = f"restore it with `{restore}`, or name another one: tracking.experiment={experiment}_2"
    return f"tracking.experiment: {experiment!r} was deleted in {uri}; {remedy}"


def _remove_stray(uri: str, file: Path) -> None:
    """Remove the empty folders that MLflow creates if it reads an address with escapes as a plain path."""
    taken = Path(uri.removeprefix("sqlite:///")).parent
    if taken != file.parent:
        with contextlib.suppress(OSError):
            os.removedirs(taken)


def _create_or_check(file: Path) -> None:
    """Check an SQLite store, or create it whole or not at all: MLflow cannot use half of the tables.

    Raises:
        TrackingError: The store is damaged.
    """
    from mlflow import MlflowClient

    if file.is_file() and file.stat().st_size:
        try:
            with contextlib.closing(sqlite3.connect(file)) as store:
                ((said,), *_) = store.execute("PRAGMA quick_check(1)")
        except sqlite3.OperationalError:  # locked by another process: no damage
            return
        except sqlite3.DatabaseError as error:
            said = str(error)
        if said != "ok":
            remedy = "restore a copy, or move it away, and the same command records into a new one"
            raise TrackingError(f"tracking.uri: {file}: damaged ({said.splitlines()[-1]}); {remedy}")
        return
    check_writable("tracking.uri", file.parent)
    artifacts = file.parent / "mlartifacts"
    if not artifacts.exists():
        undo_if_refused(partial(shutil.rmtree, artifacts, ignore_errors=True))
    undo_if_refused(partial(file.with_suffix(".lock").unlink, missing_ok=True))
    undo_if_refused(partial(file.unlink, missing_ok=True))
    with replaced(file) as part:
        address = f"sqlite:///{quoted(str(part))}"
        MlflowClient(tracking_uri=address).search_experiments(max_results=1)
