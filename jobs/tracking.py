"""What happened, written to MLflow; the only file that talks to it.

One process creates the store (two at once break it), the driver alone writes, and it writes in
batches: hundreds of single writes cost seconds, a batch a few hundredths of one.

A store that does not answer holds up no training: curves wait in the run folder and are delivered
when it is back. All else (tables, figures, the runs themselves) waits for it two minutes, then
stops with what is computed in the run folder, from where the same command records it.
"""

import base64
import contextlib
import fcntl
import json
import logging
import math
import os
import tempfile
import time
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import quote

from envs.config import settings_hash
from jobs.config import Config, as_dict
from jobs.outbox import PATIENT, QUICK, Outbox, StoreAway, calls
from jobs.progress import console
from jobs.runs import Run, holding, provenance, read_json, write_json
from jobs.store import check_metrics, dashboard_command, flatten, page, store_uri

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from mlflow import MlflowClient

BATCH = 100  # MLflow's limit on parameters and on tags of one call
MOST_CHILDREN = 10_000  # of one run
WORKFLOW = "workflowType=machine_learning"  # unless an address says so, MLflow opens pages for chat models
VIEW_TAG = "mlflow.sharedViewState"  # MLflow's own name for stored views
RESULTS_VIEW = "results"
AWAY = ("INTERNAL_ERROR", "TEMPORARILY_UNAVAILABLE")  # codes of MLflow's that another attempt may not meet


class TrackingError(RuntimeError):
    """The tracking store does not answer; the message says where the results are."""


@dataclass(frozen=True)
class Tracker:
    """One MLflow run that is being written."""

    client: "MlflowClient"
    uri: str
    experiment_id: str
    run_id: str
    outbox: Outbox

    def log(self, step: int, metrics: Mapping[str, float]) -> None:
        """Write metrics of one step in one batch, now or when the store answers again.

        Args:
            step: Position on the run's own axis, such as environment steps [-].
            metrics: `section/name` -> value. NaN means "not measured": it is left out, and
                the tag `not_measured` names it.

        Raises:
            ValueError: If a value is infinite (MLflow would store 1.8e308 without a word),
                a name is in no known section, or there are more than `jobs.store.MOST_METRICS`.
        """
        values = check_metrics(metrics)
        missing = sorted(name for name, value in values.items() if math.isnan(value))
        measured = {name: value for name, value in values.items() if name not in missing}
        row = {"step": step, "time_ms": int(time.time() * 1000), "metrics": measured, "missing": missing}
        with calls(QUICK):
            reason = self.outbox.deliver([row], self._send)
        if reason is not None:
            console.print(
                f"{self.uri} does not answer, results wait in {self.outbox.file}: {reason}", markup=False
            )

    def _send(self, row: Mapping[str, Any]) -> None:
        """Write what `log` was told; the same row twice is the same points once, as their times are equal.

        Raises:
            StoreAway: The store does not answer.
        """
        from mlflow.entities import Metric, RunTag
        from mlflow.exceptions import MlflowException

        step, missing = row["step"], row["missing"]
        metrics = [Metric(name, value, row["time_ms"], step) for name, value in row["metrics"].items()]
        tags = [RunTag("not_measured", f"step {step}: {', '.join(missing)}")] if missing else []
        try:
            self.client.log_batch(self.run_id, metrics=metrics, tags=tags)
        except MlflowException as error:
            if error.error_code not in AWAY:
                raise
            raise StoreAway(_reason(error)) from error

    def log_once(self, step: int, metrics: Mapping[str, float]) -> None:
        """Write only what the run does not hold yet: MLflow would draw a repeated point twice."""
        held = {
            (name, point.step, point.value)
            for name in self.client.get_run(self.run_id).data.metrics.keys() & metrics.keys()
            for point in self.client.get_metric_history(self.run_id, name)
        }
        self.log(step, {name: value for name, value in metrics.items() if (name, step, value) not in held})

    def params(self, values: Mapping[str, Any]) -> None:
        """Write settings that the run does not have yet, nested mappings as `outer.inner`."""
        from mlflow.entities import Param

        known = self.client.get_run(self.run_id).data.params
        new = [Param(key, text) for key, text in flatten(values).items() if key not in known]
        for first in range(0, len(new), BATCH):
            self.client.log_batch(self.run_id, params=new[first : first + BATCH])

    def tags(self, values: Mapping[str, Any]) -> None:
        """Write tags; a tag that exists takes the new value."""
        from mlflow.entities import RunTag

        self.client.log_batch(self.run_id, tags=[RunTag(key, str(value)) for key, value in values.items()])

    def describe(self, markdown: str) -> None:
        """Write the text that stands at the top of the run's page."""
        self.tags({"mlflow.note.content": markdown})

    def figure(self, name: str, figure: "Figure") -> None:
        """Write a figure as a picture file called `name`."""
        self.client.log_figure(self.run_id, figure, name, save_kwargs={"dpi": 120})

    def text(self, name: str, text: str) -> None:
        """Write a text file called `name`."""
        self.client.log_text(self.run_id, text, name)

    def table(self, name: str, columns: Mapping[str, Sequence[Any]]) -> None:
        """Write a table as `name`.json; the values of its first column must be unique."""
        self.client.log_table(self.run_id, dict(columns), f"{name}.json")

    def artifact(self, path: Path, folder: str | None = None) -> None:
        """Write a file, as it is, into a folder of the run's artifacts."""
        self.client.log_artifact(self.run_id, str(path), folder)

    def link(self) -> str:
        """Address of the run's page."""
        return f"{page(self.uri)}/#/experiments/{self.experiment_id}/runs/{self.run_id}?{WORKFLOW}"

    def save_view(self, key: str, name: str, columns: Sequence[str], search: str = "") -> str:
        """Store a view of the experiment's runs under "Views", and return its address.

        Args:
            key: Identity of the view; the same key replaces it.
            name: What the menu calls it.
            columns: Shown columns, such as "metrics.`eval/success_rate`"; the first orders the rows.
            search: Filter, such as "tags.kind = 'condition'".
        """
        order = {"orderByKey": columns[0], "orderByAsc": False}
        state = {"searchFilter": search, **order, "selectedColumns": list(columns)}
        now_ms = int(time.time() * 1000)
        packed = "deflate;" + base64.b64encode(zlib.compress(json.dumps(state).encode())).decode()
        view = {"name": name, "createdAt": now_ms, "updatedAt": now_ms, "state": packed}
        self.client.set_experiment_tag(self.experiment_id, f"{VIEW_TAG}.{key}", json.dumps(view))
        return experiment_page(self, key)

    def dashboard(self) -> str:
        """The command that opens the dashboard, and the addresses to open in it."""
        lines = [] if page(self.uri) == self.uri else [f"Dashboard: {dashboard_command(self.uri)}"]
        stored = self.client.get_experiment(self.experiment_id).tags
        view = RESULTS_VIEW if f"{VIEW_TAG}.{RESULTS_VIEW}" in stored else None
        return "\n".join([*lines, f"This run:  {self.link()}", f"All runs:  {experiment_page(self, view)}"])


def experiment_page(tracker: Tracker, view: str | None = None) -> str:
    """Address of the table of runs, in a stored view (without one, it shows no figures)."""
    shown = "" if view is None else f"&viewStateShareKey={quote(view)}"
    return f"{page(tracker.uri)}/#/experiments/{tracker.experiment_id}/runs?{WORKFLOW}{shown}"


@contextlib.contextmanager
def open_tracker(config: Config, folder: Run, key: str = "run") -> Iterator[Tracker]:
    """Write to the MLflow run of a run folder: the one it had before, or a new one.

    It ends as FINISHED, as FAILED after an exception, or as KILLED after Ctrl+C. Whoever writes
    to it works in the run folder: no other process may.

    Args:
        config: Names the store and the experiment; its settings become parameters.
        folder: The run folder; it remembers the MLflow run's id.
        key: Which of the folder's MLflow runs.

    Raises:
        RunError: Another process works in the run folder.
        TrackingError: The store does not answer.
    """
    uri = store_uri(config)
    name = folder.path.name if key == "run" else f"{folder.path.name} {key}"
    facts = {"run_folder": folder.path, "job": config.job, **provenance()}
    with holding(folder), _answering(uri, folder):
        client, experiment_id = open_store(uri, config.tracking.experiment, config.cluster.storage)
        waiting = folder.path / f"undelivered-{quote(key, safe='')}.jsonl"
        store = Tracker(client, uri, experiment_id, "", Outbox(waiting))
        tracker = _continue_or_create(store, folder, key, name, {"kind": key})
        with _ended(tracker):
            tracker.params(as_dict(folder.config))
            tracker.tags({**facts, "mlflow.source.git.commit": facts["commit"]})
            tracker.artifact(folder.path / "config.yaml")
            yield tracker


@contextlib.contextmanager
def open_child(parent: Tracker, folder: Run, key: str, name: str, kind: str) -> Iterator[Tracker]:
    """Write to a run below `parent`; the same key continues the same run."""
    tags = {"kind": kind, "mlflow.parentRunId": parent.run_id}
    waiting = Outbox(folder.path / f"undelivered-{quote(key, safe='')}.jsonl")
    child = _continue_or_create(replace(parent, outbox=waiting), folder, key, name, tags)
    with _ended(child):
        yield child


class Child(NamedTuple):
    """A finished run below another, with all that it holds."""

    name: str
    params: Mapping[str, Any]
    tags: Mapping[str, str]
    metrics: Mapping[str, float]


def write_children(parent: Tracker, kind: str, children: Sequence[Child]) -> None:
    """Write finished runs below `parent`: three calls each, and none for one that is there unchanged.

    One whose content has changed takes the place of the run of the same name.
    """
    from mlflow.entities import Metric, Param, RunTag

    client = parent.client
    search = f"tags.`mlflow.parentRunId` = '{parent.run_id}' and tags.kind = '{kind}'"
    found = client.search_runs([parent.experiment_id], search, max_results=MOST_CHILDREN)
    known = {run.info.run_name: run for run in found}
    for child in children:
        content = settings_hash(
            {"params": flatten(child.params), "tags": child.tags, "metrics": child.metrics}
        )
        old = known.get(child.name)
        if old is not None and old.data.tags.get("content") == content:
            continue
        if old is not None:
            client.delete_run(old.info.run_id)
        facts = {"kind": kind, "mlflow.parentRunId": parent.run_id}
        run_id = client.create_run(parent.experiment_id, tags=facts, run_name=child.name).info.run_id
        now_ms = int(time.time() * 1000)
        client.log_batch(
            run_id,
            metrics=[Metric(name, value, now_ms, 0) for name, value in check_metrics(child.metrics).items()],
            params=[Param(key, value) for key, value in flatten(child.params).items()],
            tags=[RunTag(key, value) for key, value in {**child.tags, "content": content}.items()],
        )
        client.set_terminated(run_id)


@contextlib.contextmanager
def _answering(uri: str, folder: Run) -> Iterator[None]:
    """Stop with one clear error where the store does not answer."""
    from mlflow.exceptions import MlflowException

    try:
        with calls(PATIENT):
            yield
    except (MlflowException, StoreAway) as error:
        if isinstance(error, MlflowException) and error.error_code not in AWAY:
            raise
        rest = f"what was computed is in {folder.path}, the same command records it"
        raise TrackingError(f"tracking.uri: {uri} does not answer ({_reason(error)}); {rest}") from error


def _reason(error: Exception) -> str:
    """The cause, as the last words of what MLflow says."""
    return str(error).strip().splitlines()[0].rpartition("Caused by ")[2][:200]


@contextlib.contextmanager
def _ended(tracker: Tracker) -> Iterator[None]:
    """End the run as what its block turned out to be; deliver what waits before it is finished."""
    from mlflow.exceptions import MlflowException

    try:
        yield
        for row in tracker.outbox.rows():
            tracker._send(row)
        tracker.outbox.file.unlink(missing_ok=True)
        tracker.client.set_terminated(tracker.run_id, "FINISHED")
    except BaseException as error:
        status = "KILLED" if isinstance(error, KeyboardInterrupt) else "FAILED"
        # A store that does not answer must not hide why the block ended.
        with contextlib.suppress(MlflowException), calls(QUICK):
            tracker.client.set_terminated(tracker.run_id, status)
        raise


def _continue_or_create(near: Tracker, folder: Run, key: str, name: str, tags: dict[str, str]) -> Tracker:
    """The MLflow run that the folder remembers under `key`, or a new one that it will remember."""
    from mlflow.exceptions import MlflowException

    file = folder.path / "tracking.json"
    known = read_json(file) if file.is_file() else {}
    slot = f"{near.uri} {near.experiment_id} {key}"
    run_id = known.get(slot)
    if run_id is not None:
        try:
            near.client.update_run(run_id, status="RUNNING")
            near.client.log_batch(run_id, tags=[])
            return replace(near, run_id=run_id)
        except MlflowException as error:  # the run was deleted: begin a new one
            if error.error_code in AWAY:
                raise
    run = near.client.create_run(near.experiment_id, tags=tags, run_name=name)
    write_json(file, {**known, slot: run.info.run_id})
    return replace(near, run_id=run.info.run_id)


def open_store(uri: str, experiment: str, storage: str | None = None) -> tuple["MlflowClient", str]:
    """A client of the store and the id of the experiment; both are created if they are not there.

    `storage` keeps a new experiment's artifacts; None: beside an SQLite file, or the server's own.
    """
    os.environ["MLFLOW_DISABLE_TELEMETRY"] = "true"
    os.environ["MLFLOW_ALLOW_PICKLE_DESERIALIZATION"] = "false"
    os.environ.setdefault("MLFLOW_LOGGING_LEVEL", "WARNING")
    from mlflow import MlflowClient

    logging.getLogger("alembic").setLevel(logging.WARNING)
    location, name = None, f"evade-store-{os.getuid()}-{settings_hash({'uri': uri})[:8]}.lock"
    lock = Path(tempfile.gettempdir(), name)
    if uri.startswith("sqlite:///"):
        file = Path(uri.removeprefix("sqlite:///"))
        file.parent.mkdir(parents=True, exist_ok=True)
        lock, beside = file.with_suffix(".lock"), file.parent / "mlartifacts"
        location = (beside / quote(experiment, safe="")).as_uri()
    if storage is not None:
        location = f"{storage.rstrip('/')}/mlartifacts/{quote(experiment, safe='')}"
    with lock.open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        client = MlflowClient(tracking_uri=uri)
        known = client.get_experiment_by_name(experiment)
        return client, known.experiment_id if known else client.create_experiment(experiment, location)
