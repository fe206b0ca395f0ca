"""Change one thing at a time and see how far the trained policy bears it (appendix D.3).

Run: python -m platform.launch +exp=robustness
Expect: a few minutes for nine conditions of 20 flights on two cores; a table with intervals
and one figure per axis in the run folder under `sweep/`. Every condition flies the same
corridors. A stopped sweep continues when the same command is given again: conditions that
were flown are read back, never flown twice.
"""

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from ray import tune

from envs.accuracy import measure
from jobs.cluster import start_ray
from jobs.conditions import Cell, Sweep, plan, read_manifest, swept_policy
from jobs.config import Config
from jobs.drift import DriftWatch
from jobs.evaluate import VIEW_COLUMNS
from jobs.figures import axis_figure
from jobs.flights import EPISODE, check_sensor, fly, write_episodes
from jobs.pilots import make_pilot
from jobs.progress import console, progress
from jobs.report import Summary, columns, markdown, metrics, show, summarise, table
from jobs.runs import Run, finish, locate_run, open_run, write_atomic, write_json
from jobs.tracking import Tracker, open_child, open_tracker

LABELS = ("Axis", "Value")
MAX_FAILURES = 2
FRACTION_STEPS = 1000  # MLflow's steps are whole numbers: fractional axes are logged in 1/1000


class SweepError(RuntimeError):
    """A sweep stopped; the message says why in one line and how to go on."""


class KeepEpisodes(tune.Callback):
    """Writes the episodes of a condition the moment it is flown; in the driver, which has the run folder.

    Tune pickles its callbacks, and a progress bar cannot be pickled: it stays behind.
    """

    def __init__(self, folder: Path, advance: Callable[..., None] | None = None) -> None:
        """Keep episodes in a folder, and tell `advance` how many."""
        self.folder, self.advance = folder, advance

    def __getstate__(self) -> dict[str, Any]:
        """All but the progress bar."""
        return {"folder": self.folder, "advance": None}

    def on_trial_result(
        self, iteration: int, trials: list[Any], trial: Any, result: dict[str, Any], **info: Any
    ) -> None:
        """Keep one condition, beside the episodes that it has."""
        path = self.folder / f"{result['key']}.json"
        rows = {row[0]: row for row in [*kept_rows(path), *result["episodes"]]}
        kept = {name: result[name] for name in ("label", "event_error", "renders_per_step", "encoder")}
        write_json(path, {**kept, "episodes": [rows[seed] for seed in sorted(rows)]})
        if self.advance is not None:
            self.advance(len(result["episodes"]), note=" ".join(result["label"]))


def run(config: Config) -> dict[str, Any]:
    """Fly every condition that is not flown yet; report, and return the policy's figures."""
    policy = swept_policy(config, locate_run(config))
    folder = open_run(config)
    config = folder.config
    sweep = plan(config, policy)
    announce(policy, sweep)
    with open_tracker(config, folder, key=f"sweep {sweep.identity[:8]}") as tracker:
        tracker.tags({"kind": "sweep", "policy": read_manifest(policy).get("name", policy)})
        episodes = fly_cells(config, folder, sweep.cells())
        figures = report(folder, tracker, policy, sweep, episodes)
        console.print(tracker.dashboard(), markup=False)
    return finish(folder, "sweep", figures)


def announce(policy: str, sweep: Sweep) -> None:
    """Say which policy is flown, and where its sensor replaces the configured one."""
    name = read_manifest(policy).get("name", "a bound")
    console.print(f"Policy: {policy}, {name}", markup=False)
    if sweep.differ:
        flown = ", ".join(
            f"{name} = {own!r} instead of {ours!r}" for name, (own, ours) in sweep.differ.items()
        )
        console.print(f"Flown with the policy's own sensor: {flown}", markup=False)


def fly_cells(config: Config, folder: Run, every: Sequence[Cell]) -> dict[str, np.ndarray]:
    """The episodes of each cell by its key: read back where they are kept, else flown as a Tune trial.

    Raises:
        SweepError: If a cell could not be flown.
    """
    kept = folder.path / "sweep" / "episodes"
    unique = {cell.key: cell for cell in every}
    missing = [cell for cell in (unflown(cell, kept) for cell in unique.values()) if cell.seeds]
    if missing:
        total, left = (sum(len(cell.seeds) for cell in some) for some in (unique.values(), missing))
        start_ray(config.cluster, folder.path)
        with progress("Sweep", total, "flights", done=total - left) as advance:
            results = _tuner(folder, missing, KeepEpisodes(kept, advance)).fit()
        if results.errors:
            reason = str(results.errors[0]).strip().splitlines()[-1]
            raise SweepError(f"the sweep stopped: {reason}; the same command flies what is missing")
    return {key: read_episodes(cell, kept) for key, cell in unique.items()}


def unflown(cell: Cell, kept: Path) -> Cell:
    """The cell with only those seeds whose episodes are not kept."""
    flown = {row[0] for row in kept_rows(kept / f"{cell.key}.json")}
    return dataclasses.replace(cell, seeds=tuple(seed for seed in cell.seeds if seed not in flown))


def kept_rows(path: Path) -> list[list[Any]]:
    """The kept episodes of one cell, each a list in the order of EPISODE; none if there is no file."""
    return json.loads(path.read_text())["episodes"] if path.is_file() else []


def simulated(cell: Cell, kept: Path) -> dict[str, float]:
    """How exact the events of a kept cell were, how many renders that took, and the encoder's drift."""
    values = json.loads((kept / f"{cell.key}.json").read_text())
    drift = {f"evae/{name}": value for name, value in values.get("encoder", {}).items()}
    return drift | {f"sim/{name}": values[name] for name in ("event_error", "renders_per_step")}


def read_episodes(cell: Cell, kept: Path) -> np.ndarray:
    """The episodes of a cell's seeds, dtype EPISODE."""
    rows = {row[0]: tuple(row) for row in kept_rows(kept / f"{cell.key}.json")}
    return np.array([rows[seed] for seed in cell.seeds], EPISODE)


def _tuner(folder: Run, missing: Sequence[Cell], keep: KeepEpisodes) -> tune.Tuner:
    """One trial per cell, one core each."""
    return tune.Tuner(
        tune.with_resources(fly_cell, {"cpu": 1}),
        tune_config=tune.TuneConfig(reuse_actors=True),  # a new worker imports for seconds
        param_space={"cell": tune.grid_search(list(missing))},
        run_config=tune.RunConfig(
            name="tune",
            storage_path=str(folder.path / "sweep"),
            verbose=0,
            callbacks=[keep],
            failure_config=tune.FailureConfig(max_failures=MAX_FAILURES),
        ),
    )


def fly_cell(params: Mapping[str, Any]) -> None:
    """The trial of one cell, in a Ray worker; its result holds the episodes."""
    torch.set_num_threads(1)
    cell: Cell = params["cell"]
    drift = DriftWatch(cell.pilot)
    episodes = fly(make_pilot(cell.pilot, cell.action), cell.env, cell.seeds, watch=drift.add)
    accuracy = measure(cell.env)
    tune.report(
        {
            "key": cell.key,
            "label": list(cell.label),
            "episodes": episodes.tolist(),
            "event_error": accuracy.error,
            "renders_per_step": accuracy.renders,
            "encoder": drift.figures(),  # of the flights flown last
        }
    )


def report(
    folder: Run, tracker: Tracker, policy: str, sweep: Sweep, episodes: Mapping[str, np.ndarray]
) -> dict[str, float]:
    """Tables, figures and tracked runs of a flown sweep; the policy's success rate by condition."""
    levels = {name: summarise(cell.label, episodes[cell.key]) for name, cell in sweep.bounds.items()}
    sensor = read_manifest(policy).get("sensor", {})
    rows: list[tuple[Cell, Summary]] = []
    for axis, points in sweep.axes.items():
        flown = [summarise(cell.label, episodes[cell.key]) for _, cell in points]
        values = [value for value, _ in points]
        trained = sensor.get(axis.rpartition(".")[2], 0.0 if axis.startswith("faults.") else None)
        figure = axis_figure(axis, values, flown, levels, trained)
        figure.savefig(folder.path / "sweep" / f"{axis}.png", dpi=120)
        tracker.figure(f"sweep/{axis}.png", figure)
        track_axis(tracker, axis, values, flown)
        rows += [(cell, row) for (_, cell), row in zip(points, flown, strict=True)]
    for cell, row in rows:
        track_cell(folder, tracker, cell, row, sensor)
    publish(folder, tracker, policy, [*(row for _, row in rows), *levels.values()])
    flights = {cell.label: episodes[cell.key] for cell, _ in rows}
    write_episodes(folder.path / "sweep" / "episodes.csv", LABELS, flights)
    return {"=".join(row.label): row.success for _, row in rows}


def track_axis(tracker: Tracker, axis: str, values: Sequence[float], rows: Sequence[Summary]) -> None:
    """One curve per axis in the parent run: its steps are the axis, in 1/1000 where it has fractions."""
    scale = 1 if all(float(value).is_integer() for value in values) else FRACTION_STEPS
    for value, row in zip(values, rows, strict=True):
        figures = metrics(row)
        curve = {f"sweep/{name.partition('/')[2]}.{axis}": figures[name] for name in VIEW_COLUMNS}
        log_once(tracker, round(value * scale), curve)


def log_once(tracker: Tracker, step: int, figures: Mapping[str, float]) -> None:
    """Log the points that the MLflow run does not hold yet: MLflow would draw a repeated one twice."""
    client, run_id = tracker.client, tracker.run_id
    held = {
        (name, point.step, point.value)
        for name in client.get_run(run_id).data.metrics.keys() & figures.keys()
        for point in client.get_metric_history(run_id, name)
    }
    tracker.log(step, {name: value for name, value in figures.items() if (name, step, value) not in held})


def track_cell(folder: Run, parent: Tracker, cell: Cell, row: Summary, sensor: Mapping[str, Any]) -> None:
    """A child run for one condition, with what differs from the sensor the policy was trained with."""
    differ = check_sensor({"sensor": sensor}, cell.env, allow_mismatch=True) if sensor else {}
    axis, value = cell.label
    slot = f"condition {parent.run_id} {axis} {cell.key}"  # a parent's conditions are its own
    with open_child(parent, folder, slot, f"{axis}={value}", "condition") as child:
        child.params({"axis": axis, "value": value, "pilot": cell.pilot, "env": dataclasses.asdict(cell.env)})
        child.tags({"differs_from_training": json.dumps(differ)})
        log_once(child, 0, metrics(row) | simulated(cell, folder.path / "sweep" / "episodes"))


def publish(folder: Run, tracker: Tracker, policy: str, rows: Sequence[Summary]) -> None:
    """Show, store and track the table."""
    text = markdown(LABELS, rows)
    show(table("One setting changed at a time", LABELS, rows))
    write_atomic(folder.path / "sweep" / "table.md", text)
    tracker.text("sweep/table.md", text)
    if "sweep/results.json" not in {
        file.path for file in tracker.client.list_artifacts(tracker.run_id, "sweep")
    }:
        tracker.table("sweep/results", columns(LABELS, rows))  # MLflow appends to a table that is there
    shown = [f"metrics.`{name}`" for name in VIEW_COLUMNS]
    search = f"tags.`mlflow.parentRunId` = '{tracker.run_id}'"
    view = tracker.save_view("sweep", "Sweep", [*shown, "params.`axis`", "params.`value`"], search)
    tracker.describe(f"Policy: {policy}\n\n[Conditions as a table]({view})\n\n{text}")
