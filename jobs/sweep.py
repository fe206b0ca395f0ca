"""Fly policies of several trainings through every condition, and say what each group bears (appendix D.3).

Run: python -m platform.launch +exp=robustness
Expect: about half a second of one core for each flight (7 for each policy and condition); in the
run folder under `sweep/` a figure per axis, tables with intervals and every episode. All fly the
same corridors. A stopped sweep continues when the same command is given again: what was flown is
read back, never flown twice; what failed is tried again. A cell whose process ends, or hangs
longer than its limit, is tried `MAX_FAILURES` times more.
"""

import dataclasses
import functools
import math
import os
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from ray import tune

from envs.accuracy import measure
from jobs.cluster import fit, start_ray, storage
from jobs.conditions import Cell, Sweep, find_entries, plan
from jobs.config import Config
from jobs.drift import DriftWatch
from jobs.flights import EPISODE, fly
from jobs.pilots import Pilot, make_pilot
from jobs.progress import console, progress
from jobs.runs import RunError, finish, git_commit, locate_run, open_run, read_json, write_json
from jobs.sweep_report import accuracy_file, report
from jobs.tracking import open_tracker
from jobs.watchdog import ending_after

MAX_FAILURES = 2
# A step takes a thousandth of this, with pyrender a tenth; compiling takes a minute, and several
# on a busy machine.
LONGEST_STEP_S, LONGEST_START_S = 0.1, 900.0
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
        restarts: Key of a cell -> how often its process ended before it was flown.
        late: Keys of the cells that took longer than their limit, and were ended.
    """

    def __init__(self, folder: Path, advance: Callable[..., None] | None = None) -> None:
        """Keep episodes in a folder, and tell `advance` how many."""
        self.folder, self.advance, self.commit = folder, advance, git_commit()
        self.failed: dict[str, str] = {}
        self.restarts: Counter[str] = Counter()
        self.late: set[str] = set()
        self._started: dict[str, float] = {}

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
        kept = {"label": result["label"], "commit": self.commit, "encoder": result["encoder"],
                "restarts": self.restarts[result["key"]]}  # fmt: skip
        write_json(path, {**kept, "episodes": [rows[seed] for seed in sorted(rows)]})
        if result["accuracy"] is not None:
            write_json(accuracy_file(self.folder.parent, result["simulation"]), result["accuracy"])
        if self.advance is not None:
            self.advance(len(result["episodes"]), note=note)

    def on_trial_start(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """Note when a cell begins, or begins again."""
        self._started[_flown_in(trial).key] = time.monotonic()

    def on_trial_recover(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """Say that a cell is tried again."""
        self._count(_flown_in(trial), "tried again")

    def on_trial_error(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """Say that a cell is given up."""
        self._count(_flown_in(trial), "given up")

    def _count(self, cell: Cell, what: str) -> None:
        self.restarts[cell.key] += 1
        if time.monotonic() - self._started.get(cell.key, math.inf) >= limit_s(cell):
            self.late.add(cell.key)
        console.print(f"{self.lost(cell)}, {what}: {' '.join(cell.label)} {cell.entry.group}", markup=False)

    def lost(self, cell: Cell) -> str:
        """Why a cell that did not raise is not flown."""
        late = f" (it may take {limit_s(cell):.0f} s)" if cell.key in self.late else ""
        return f"its process ended{late} {self.restarts[cell.key]} times"


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
            fit(_tuner(storage(config.cluster, place), missing, measured, keep))
        failed = {
            cell.key: keep.failed.get(cell.key, keep.lost(cell))
            for cell in missing
            if unflown(cell, kept).seeds
        }
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
    """The kept episodes of one cell, each a list in the order of EPISODE; none if there is no file.

    A damaged file is put aside, and its cell is flown again.
    """
    if not path.is_file():
        return []
    try:
        return read_json(path)["episodes"]
    except RunError:
        path.replace(path.with_suffix(".damaged"))
        console.print(f"Damaged and put aside, flown again: {path}", markup=False)
        return []


def read_kept(kept: Path, key: str) -> dict[str, Any]:
    """What is kept of a cell beside its episodes: the commit that flew it, and its encoder's drift."""
    return {name: value for name, value in read_json(kept / f"{key}.json").items() if name != "episodes"}


def read_episodes(cell: Cell, kept: Path) -> np.ndarray:
    """The episodes of a cell's seeds, dtype EPISODE."""
    rows = {row[0]: tuple(row) for row in kept_rows(kept / f"{cell.key}.json")}
    return np.array([rows[seed] for seed in cell.seeds], EPISODE)


def _tuner(place: str, missing: Sequence[Cell], measured: set[str], keep: KeepEpisodes) -> tune.Tuner:
    """One trial per cell, one core each."""
    trials = [{"cell": cell, "measured": cell.key in measured, "limit_s": limit_s(cell)} for cell in missing]
    return tune.Tuner(
        tune.with_resources(fly_cell, {"cpu": 1}),
        tune_config=tune.TuneConfig(reuse_actors=True),  # a new worker imports for seconds
        param_space={"trial": tune.grid_search(trials)},
        run_config=tune.RunConfig(
            name="tune",
            storage_path=place,
            verbose=0,
            callbacks=[keep],
            failure_config=tune.FailureConfig(max_failures=MAX_FAILURES),
        ),
    )


def limit_s(cell: Cell) -> float:
    """How long a cell may take before its process counts as hanging [s]."""
    steps = len(cell.seeds) * cell.env.time_limit_s * cell.env.control_hz
    return LONGEST_START_S + steps * LONGEST_STEP_S


def _flown_in(trial: Any) -> Cell:
    """The cell of a trial."""
    return trial.config["trial"]["cell"]


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
        with ending_after(params["trial"]["limit_s"]):
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
    bad = [name for name in EPISODE.names or () if not np.isfinite(episodes[name]).all()]
    if bad:
        raise ValueError(f"episodes must be finite, got NaN or infinity in {', '.join(bad)}")
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
