"""Fly policies of several trainings through every condition, and say what each group bears (appendix D.3).

Run: python -m platform.launch +exp=robustness
Expect: about a quarter of a second of one core for each flight (20 for each policy and
condition); in the run folder under `sweep/` a figure per axis, tables with intervals and every
episode. All fly the same corridors. A stopped sweep continues when the same command is given
again: what was flown is read back, never flown twice; what failed is tried again.
"""

import dataclasses
import functools
import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from ray import tune

from envs.accuracy import measure
from jobs.cluster import start_ray
from jobs.conditions import Cell, Sweep, find_entries, plan
from jobs.config import Config
from jobs.drift import DriftWatch
from jobs.flights import EPISODE, fly
from jobs.pilots import Pilot, make_pilot
from jobs.progress import console, progress
from jobs.runs import finish, git_commit, locate_run, open_run, write_json
from jobs.sweep_report import accuracy_file, report
from jobs.tracking import open_tracker

MAX_FAILURES = 2
MOST_ENVS = 32  # flights in lock-step
# Kept episodes are what a stopped sweep continues from. Tune's own picture of all trials, written
# at each result, would cost more than the flights.
TUNE_SNAPSHOT_S = "3600"


class SweepError(RuntimeError):
    """A sweep of which nothing could be flown; the message says why in one line."""


class KeepEpisodes(tune.Callback):
    """Writes the episodes of a cell the moment it is flown; in the driver, which has the run folder.

    Tune pickles its callbacks, and a progress bar cannot be pickled: it stays behind.

    Attributes:
        failed: Key of a cell that raised -> the reason.
    """

    def __init__(self, folder: Path, advance: Callable[..., None] | None = None) -> None:
        """Keep episodes in a folder, and tell `advance` how many."""
        self.folder, self.advance, self.commit = folder, advance, git_commit()
        self.failed: dict[str, str] = {}

    def __getstate__(self) -> dict[str, Any]:
        """All but the progress bar."""
        return {**self.__dict__, "advance": None}

    def on_trial_result(
        self, iteration: int, trials: list[Any], trial: Any, result: dict[str, Any], **info: Any
    ) -> None:
        """Keep one cell, beside the episodes that it has."""
        note = " ".join(result["label"])
        if "failed" in result:
            self.failed[result["key"]] = result["failed"]
            console.print(f"Not flown: {note}: {result['failed']}", markup=False)
            return
        path = self.folder / f"{result['key']}.json"
        rows = {row[0]: row for row in [*kept_rows(path), *result["episodes"]]}
        kept = {"label": result["label"], "commit": self.commit, "encoder": result["encoder"]}
        write_json(path, {**kept, "episodes": [rows[seed] for seed in sorted(rows)]})
        if result["accuracy"] is not None:
            write_json(accuracy_file(self.folder.parent, result["simulation"]), result["accuracy"])
        if self.advance is not None:
            self.advance(len(result["episodes"]), note=note)


def run(config: Config) -> dict[str, Any]:
    """Fly every cell that is not flown yet; report, and return each group's success rate by condition."""
    entries = find_entries(config, locate_run(config))
    folder = open_run(config)
    config = folder.config
    sweep = plan(config, entries)
    announce(sweep)
    with open_tracker(config, folder, key=f"sweep {sweep.identity[:8]}") as tracker:
        tracker.tags({"kind": "sweep", "groups": ", ".join(sweep.groups)})
        episodes, failed = fly_cells(config, folder.path / "sweep", sweep.cells)
        kept = {key: read_kept(episodes_folder(folder.path / "sweep"), key) for key in episodes}
        figures = report(config, folder, tracker, sweep, episodes, kept, failed)
        console.print(tracker.dashboard(), markup=False)
    return finish(folder, "sweep", figures)


def announce(sweep: Sweep) -> None:
    """Say who flies, and where a policy's own sensor replaces the configured one."""
    for group, trainings in sweep.groups.items():
        seeds = ", ".join(str(seed) for seed in trainings if seed is not None)
        console.print(f"Group: {group}" + (f" (training seeds {seeds})" if seeds else ""), markup=False)
    for pilot, differ in sweep.differ.items():
        flown = ", ".join(f"{name} = {own!r} instead of {ours!r}" for name, (own, ours) in differ.items())
        console.print(f"Flown with its own sensor: {pilot}: {flown}", markup=False)


def fly_cells(
    config: Config, place: Path, every: Sequence[Cell], measuring: bool = True
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """The episodes of each cell by its key, read back where they are kept, else flown as a Tune trial.

    Args:
        config: Says where Ray runs.
        place: The folder of a run folder that keeps them.
        every: The cells; of those that share a key one is flown.
        measuring: Whether the accuracy of each simulation is measured too.

    Returns:
        Key -> EPISODE of the cells that could be flown, and key -> reason of the others.

    Raises:
        SweepError: If none could be flown.
    """
    kept = episodes_folder(place)
    unique = {cell.key: cell for cell in every}
    missing = [cell for cell in (unflown(cell, kept) for cell in unique.values()) if cell.seeds]
    failed: dict[str, str] = {}
    if missing:
        total, left = (sum(len(cell.seeds) for cell in some) for some in (unique.values(), missing))
        start_ray(config.cluster, place.parent)
        os.environ["TUNE_GLOBAL_CHECKPOINT_S"] = TUNE_SNAPSHOT_S
        measured = unmeasured(missing, kept) if measuring else set()
        with progress(place.name.capitalize(), total, "flights", done=total - left) as advance:
            keep = KeepEpisodes(kept, advance)
            _tuner(place, missing, measured, keep).fit()
        lost = f"its process ended {MAX_FAILURES + 1} times"
        failed = {cell.key: keep.failed.get(cell.key, lost) for cell in missing if unflown(cell, kept).seeds}
    if len(failed) == len(unique):
        reason = next(iter(failed.values()))
        raise SweepError(f"nothing could be flown: {reason}; the same command tries again")
    flown = {key: read_episodes(cell, kept) for key, cell in unique.items() if key not in failed}
    return flown, failed


def episodes_folder(place: Path) -> Path:
    """Where flown episodes are kept, one file per cell."""
    return place / "episodes"


def unmeasured(cells: Sequence[Cell], kept: Path) -> set[str]:
    """Keys of the cells that measure their simulation's accuracy: the first of each that is not known."""
    first: dict[str, str] = {}
    for cell in cells:
        if not accuracy_file(kept.parent, cell.simulation).is_file():
            first.setdefault(cell.simulation, cell.key)
    return set(first.values())


def unflown(cell: Cell, kept: Path) -> Cell:
    """The cell with only those seeds whose episodes are not kept."""
    flown = {row[0] for row in kept_rows(kept / f"{cell.key}.json")}
    return dataclasses.replace(cell, seeds=tuple(seed for seed in cell.seeds if seed not in flown))


def kept_rows(path: Path) -> list[list[Any]]:
    """The kept episodes of one cell, each a list in the order of EPISODE; none if there is no file."""
    return json.loads(path.read_text())["episodes"] if path.is_file() else []


def read_kept(kept: Path, key: str) -> dict[str, Any]:
    """What is kept of a cell beside its episodes: the commit that flew it, and its encoder's drift."""
    return {
        name: value
        for name, value in json.loads((kept / f"{key}.json").read_text()).items()
        if name != "episodes"
    }


def read_episodes(cell: Cell, kept: Path) -> np.ndarray:
    """The episodes of a cell's seeds, dtype EPISODE."""
    rows = {row[0]: tuple(row) for row in kept_rows(kept / f"{cell.key}.json")}
    return np.array([rows[seed] for seed in cell.seeds], EPISODE)


def _tuner(place: Path, missing: Sequence[Cell], measured: set[str], keep: KeepEpisodes) -> tune.Tuner:
    """One trial per cell, one core each."""
    trials = [{"cell": cell, "measured": cell.key in measured} for cell in missing]
    return tune.Tuner(
        tune.with_resources(fly_cell, {"cpu": 1}),
        tune_config=tune.TuneConfig(reuse_actors=True),  # a new worker imports for seconds
        param_space={"trial": tune.grid_search(trials)},
        run_config=tune.RunConfig(
            name="tune",
            storage_path=str(place),
            verbose=0,
            callbacks=[keep],
            failure_config=tune.FailureConfig(max_failures=MAX_FAILURES),
        ),
    )


def fly_cell(params: Mapping[str, Any]) -> None:
    """The trial of one cell, in a Ray worker; a cell that raises is reported, and stops no other."""
    torch.set_num_threads(1)
    cell: Cell = params["trial"]["cell"]
    label = [
        *cell.label,
        cell.entry.group,
        *([] if cell.entry.training is None else [f"s{cell.entry.training}"]),
    ]
    try:
        result = flown(cell, params["trial"]["measured"])
    except Exception as error:
        result = {"failed": " ".join(f"{type(error).__name__}: {error}".split())}
    tune.report({"key": cell.key, "label": label, **result})


def flown(cell: Cell, measured: bool) -> dict[str, Any]:
    """The episodes of a cell, the drift of its policy's encoder, and how exact its simulation is."""
    pilot = cell.entry.pilot
    drift = DriftWatch(pilot)
    together = min(len(cell.seeds), MOST_ENVS)
    episodes = fly(loaded(pilot, cell.action, cell.table), cell.env, cell.seeds, together, drift.add)
    accuracy = measure(cell.env) if measured else None
    return {
        "episodes": episodes.tolist(),
        "encoder": drift.figures(),  # of the flights flown last
        "simulation": cell.simulation,
        "accuracy": accuracy and {"event_error": accuracy.error, "renders_per_step": accuracy.renders},
    }


@functools.lru_cache(maxsize=2)
def loaded(pilot: str, action: str, table: tuple[tuple[str, Any], ...] = ()) -> Pilot:
    """A pilot, kept by a worker from cell to cell: it forgets its flights when it is reset."""
    return make_pilot(pilot, action, dict(table))
