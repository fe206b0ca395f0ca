"""Cells are flown side by side as Tune trials, and kept as they end.

What was flown is read back, never flown twice; what failed is tried again by the next run. A part of
a cell whose process ends, or hangs longer than its limit, is tried `MAX_FAILURES` times more. Workers
get the policies from the driver, so that other machines need not see its folders.
"""

import atexit
import dataclasses
import functools
import math
import os
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from ray import tune

from envs.event_error import measure_event_error
from jobs.config.config import Config
from jobs.rollout.agents import BOUNDS, Agent, make_agent
from jobs.rollout.drift import DriftWatch
from jobs.rollout.episodes import EPISODE, fly
from jobs.rollout.tasks import (
    Cell,
    accuracy_file,
    episodes_folder,
    kept_rows,
    read_episodes,
    read_kept,
    split,
    unflown,
)
from jobs.run.files import write_json
from jobs.run.progress import console, progress
from jobs.run.provenance import git_commit
from jobs.run.ray_cluster import fit, start_ray, storage
from jobs.run.watchdog import ending_after

MAX_FAILURES = 2
# A step takes a thousandth of this, with pyrender a tenth; compiling takes a minute, and several
# on a busy machine.
MAX_STEP_S, MAX_START_S = 0.1, 900.0
# Kept episodes are what a stopped job continues from. Tune's own picture of all trials, written
# at each result, would cost more than the flights.
TUNE_SNAPSHOT_S = "3600"

Files = dict[str, dict[str, bytes]]  # policy folder -> name -> content


class FlightsError(RuntimeError):
    """Cells of which nothing could be flown; the message says why in one line."""


class KeepEpisodes(tune.Callback):
    """Writes the episodes of a part the moment it is flown; in the driver, which has the run folder.

    Tune pickles its callbacks, and a progress bar cannot be pickled: it stays behind.

    Attributes:
        failed: Key of a cell that raised -> the reason.
        restarts: Part -> how often its process ended before it was flown.
        late: The parts that took longer than their limit, and were ended.
    """

    def __init__(self, folder: Path, advance: Callable[..., None] | None = None) -> None:
        """Keep episodes in a folder, and tell `advance` how many."""
        self.folder, self.advance, self.commit = folder, advance, git_commit()
        self.failed: dict[str, str] = {}
        self.restarts: Counter[tuple[str, int]] = Counter()
        self.late: set[tuple[str, int]] = set()
        self._started: dict[tuple[str, int], float] = {}
        self._restarts_before: dict[str, int] = {}

    def __getstate__(self) -> dict[str, Any]:
        """All but the progress bar."""
        return {**self.__dict__, "advance": None}

    def on_trial_result(
        self, iteration: int, trials: list[Any], trial: Any, result: dict[str, Any], **info: Any
    ) -> None:
        """Keep one part, beside the episodes that its cell has; of the encoder, what the first seeds say."""
        note, key = " ".join(result["label"]), result["key"]
        if "failed" in result:
            if self.failed.get(key) != result["failed"]:
                console.print(f"Not flown: {note}: {result['failed']}", markup=False)
            self.failed[key] = result["failed"]
            return
        path = self.folder / f"{key}.json"
        rows = {row[0]: row for row in kept_rows(path)}
        before: dict[str, Any] = read_kept(self.folder, key) if rows else {"commits": [], "restarts": 0}
        earlier = min(rows, default=math.inf) < result["episodes"][0][0]
        kept = {
            "label": result["label"],
            "commits": sorted({*before["commits"], self.commit}),
            "encoder": before["encoder"] if earlier else result["encoder"],
            "restarts": self._restarts_before.setdefault(key, before["restarts"]) + self._restarts_of(key),
        }
        rows |= {row[0]: row for row in result["episodes"]}
        write_json(path, {**kept, "episodes": [rows[seed] for seed in sorted(rows)]})
        if result["accuracy"] is not None:
            write_json(accuracy_file(self.folder.parent, result["simulation"]), result["accuracy"])
        if self.advance is not None:
            self.advance(len(result["episodes"]), note=note)

    def on_trial_start(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """Note when a part begins, or begins again."""
        self._started[_flown_in(trial).part] = time.monotonic()

    def on_trial_recover(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """Say that a part is tried again."""
        self._count(_flown_in(trial), "tried again")

    def on_trial_error(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """Say that a part is given up."""
        self._count(_flown_in(trial), "given up")

    def _restarts_of(self, key: str) -> int:
        return sum(count for (cell, _), count in self.restarts.items() if cell == key)

    def _count(self, cell: Cell, what: str) -> None:
        self.restarts[cell.part] += 1
        if time.monotonic() - self._started.get(cell.part, math.inf) >= limit_s(cell):
            self.late.add(cell.part)
        console.print(f"{self.lost(cell)}, {what}: {' '.join(cell.label)} {cell.entry.group}", markup=False)

    def lost(self, cell: Cell) -> str:
        """Why a part that did not raise is not flown."""
        late = f" (it may take {limit_s(cell):.0f} s)" if cell.part in self.late else ""
        return f"its process ended{late} {self.restarts[cell.part]} times"


def fly_cells(
    config: Config, place: Path, every: Sequence[Cell], title: str = "Fly", measuring: bool = True
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """The episodes of each cell by its key, read back where they are kept, else flown as Tune trials.

    Args:
        config: Says where Ray runs.
        place: The folder of a run folder that keeps them.
        every: The cells; of those that share a key the first is flown.
        title: What the progress is called.
        measuring: Whether the accuracy of each simulation is measured too.

    Returns:
        Key -> EPISODE of the cells that could be flown, and key -> reason of the others.

    Raises:
        FlightsError: If none could be flown.
    """
    kept = episodes_folder(place)
    unique: dict[str, Cell] = {}
    for cell in every:
        unique.setdefault(cell.key, cell)
    missing = [cell for cell in (unflown(cell, kept) for cell in unique.values()) if cell.seeds]
    failed: dict[str, str] = {}
    if missing:
        total, left = (sum(len(cell.seeds) for cell in some) for some in (unique.values(), missing))
        start_ray(config.cluster, place.parent)
        os.environ["TUNE_GLOBAL_CHECKPOINT_S"] = TUNE_SNAPSHOT_S
        parts = [part for cell in missing for part in split(cell)]
        measured = unmeasured(parts, kept) if measuring else set()
        with progress(title, total, "flights", done=total - left) as advance:
            keep = KeepEpisodes(kept, advance)
            fit(_tuner(storage(config.cluster, place), parts, measured, keep))
        left_out = [part for part in parts if unflown(part, kept).seeds]
        failed = {part.key: keep.failed.get(part.key, keep.lost(part)) for part in left_out}
    if len(failed) == len(unique):
        reason = next(iter(failed.values()))
        raise FlightsError(f"nothing could be flown: {reason}; the same command tries again")
    flown = {key: read_episodes(cell, kept) for key, cell in unique.items() if key not in failed}
    return flown, failed


def unmeasured(parts: Sequence[Cell], kept: Path) -> set[tuple[str, int]]:
    """The parts that measure their simulation's accuracy: the first of each that is not known."""
    first: dict[str, tuple[str, int]] = {}
    for part in parts:
        if not accuracy_file(kept.parent, part.simulation).is_file():
            first.setdefault(part.simulation, part.part)
    return set(first.values())


def _tuner(
    place: str, parts: Sequence[Cell], measured: set[tuple[str, int]], keep: KeepEpisodes
) -> tune.Tuner:
    """One trial per part, one core each."""
    trials = [{"cell": part, "measured": part.part in measured, "limit_s": limit_s(part)} for part in parts]
    return tune.Tuner(
        tune.with_resources(tune.with_parameters(fly_cell, files=packed(parts)), {"cpu": 1}),
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
    """How long a part may take before its process counts as hanging [s]."""
    steps = len(cell.seeds) * cell.env.time_limit_s * cell.env.control_hz
    return MAX_START_S + steps * MAX_STEP_S


def _flown_in(trial: Any) -> Cell:
    """The part that a trial flies."""
    return trial.config["trial"]["cell"]


def fly_cell(params: Mapping[str, Any], files: Files) -> None:
    """The trial of one part, in a Ray worker; one that raises is reported, and stops no other."""
    torch.set_num_threads(1)
    cell: Cell = params["trial"]["cell"]
    training = [] if cell.entry.training is None else [f"s{cell.entry.training}"]
    label = [*cell.label, cell.entry.group, *training]
    try:
        with ending_after(params["trial"]["limit_s"]):
            result = flown(with_files(cell, files), params["trial"]["measured"])
    except Exception as error:
        result = {"failed": " ".join(f"{type(error).__name__}: {error}".split())}
    tune.report({"key": cell.key, "label": label, **result})


def packed(cells: Iterable[Cell]) -> Files:
    """The files of every policy that flies, for workers that may not see their folders."""
    folders = {cell.entry.agent for cell in cells} - set(BOUNDS)
    return {
        folder: {file.name: file.read_bytes() for file in Path(folder).iterdir() if file.is_file()}
        for folder in sorted(folders)
    }


def with_files(cell: Cell, files: Files) -> Cell:
    """The cell, its policy's folder replaced by one that this process has written itself."""
    agent = cell.entry.agent
    if agent in BOUNDS:
        return cell
    place = _unpacked.get(cell.entry.identity)
    if place is None:
        place = tempfile.mkdtemp(prefix="evade-policy-")
        atexit.register(shutil.rmtree, place, ignore_errors=True)
        for name, content in files[agent].items():
            (Path(place) / name).write_bytes(content)
        _unpacked[cell.entry.identity] = place  # only when it is whole
    return dataclasses.replace(cell, entry=dataclasses.replace(cell.entry, agent=place))


_unpacked: dict[str, str] = {}  # identity of a policy -> its folder in this process


def flown(cell: Cell, measured: bool) -> dict[str, Any]:
    """The episodes of a part, the drift of its policy's encoder, and how exact its simulation is."""
    agent = cell.entry.agent
    drift = DriftWatch(agent)
    flying = loaded(agent, cell.action, cell.table)
    episodes = fly(flying, cell.env, cell.seeds, len(cell.seeds), drift.add)
    bad = [name for name in EPISODE.names or () if not np.isfinite(episodes[name]).all()]
    if bad:
        raise ValueError(f"episodes must be finite, got NaN or infinity in {', '.join(bad)}")
    accuracy = measure_event_error(cell.env) if measured else None
    return {
        "episodes": episodes.tolist(),
        "encoder": drift.figures(),
        "simulation": cell.simulation,
        "accuracy": accuracy and {"event_error": accuracy.error, "renders_per_step": accuracy.renders},
    }


@functools.lru_cache(maxsize=2)
def loaded(agent: str, action: str, table: tuple[tuple[str, Any], ...] = ()) -> Agent:
    """An agent, kept by a worker from cell to cell: it forgets its flights when it is reset."""
    return make_agent(agent, action, dict(table))
