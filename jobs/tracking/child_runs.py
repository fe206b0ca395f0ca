"""Child runs in MLflow: a study's conditions and groups, a search's trials, a trade's settings."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from envs.config import settings_hash
from jobs.tracking.clock import now_ms
from jobs.tracking.store import check_metrics, flatten
from jobs.tracking.tracker import Tracker

MAX_CHILDREN = 10_000  # of one run


class ChildRun(NamedTuple):
    """A finished child run with its whole content."""

    name: str
    params: Mapping[str, object]
    tags: Mapping[str, str]
    metrics: Mapping[str, float]
    curves: Mapping[str, Mapping[int, float]] = {}  # metric -> its value at each step


def write_child_runs(parent: Tracker, kind: str, children: Sequence[ChildRun]) -> None:
    """Write finished child runs of `parent`: three calls each, none for a run that exists unchanged.

    A run whose content has changed replaces the run of the same name.
    """
    from mlflow.entities import Metric, Param, RunTag

    client = parent.client
    search = f"tags.`mlflow.parentRunId` = '{parent.run_id}' and tags.kind = '{kind}'"
    found = client.search_runs([parent.experiment_id], search, max_results=MAX_CHILDREN)
    known = {run.info.run_name: run for run in found}
    for child in children:
        content = settings_hash(child._asdict() | {"params": flatten(child.params)})
        old = known.get(child.name)
        if old is not None and old.data.tags.get("content") == content:
            continue
        if old is not None:
            client.delete_run(old.info.run_id)
        facts = {"kind": kind, "mlflow.parentRunId": parent.run_id}
        now = now_ms()
        run_id = client.create_run(parent.experiment_id, now, tags=facts, run_name=child.name).info.run_id
        client.log_batch(
            run_id,
            metrics=[Metric(name, value, now, step) for name, step, value in _points(child)],
            params=[Param(key, value) for key, value in flatten(child.params).items()],
            tags=[RunTag(key, value) for key, value in {**child.tags, "content": content}.items()],
        )
        client.set_terminated(run_id, end_time=now_ms())


def _points(child: ChildRun) -> list[tuple[str, int, float]]:
    """Return name, step and value of every metric of a child run; single values are at step 0."""
    curves = {name: {0: value} for name, value in child.metrics.items()} | dict(child.curves)
    check_metrics({name: sum(points.values()) for name, points in curves.items()})
    return [(name, step, value) for name, points in curves.items() for step, value in points.items()]
