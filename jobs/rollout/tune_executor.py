"""Evaluate batches of parts in parallel, as trials of Ray Tune with one core each.

If the process of a batch ends, or hangs longer than its limit, each of its parts is tried alone. A single
part is retried `MAX_FAILURES` times. Workers get the policies' files from the driver, so that other machines
need no access to its folders.
"""

import atexit
import dataclasses
import math
import shutil
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import ray
import torch
from ray import tune
from ray.tune.experiment import Trial

from envs.scene import LAYOUTS, Layout
from jobs.config.schema import ClusterConfig
from jobs.rollout.agents import BASELINES
from jobs.rollout.executors import Part, Recorder, evaluate_together
from jobs.run.ray_cluster import fit, session_folder, start_ray, storage
from jobs.run.trial_errors import low_memory, newest_error
from jobs.run.variables import variables_set
from jobs.run.watchdog import ending_after

MAX_FAILURES = 2
# A step takes a thousandth of this limit, or a tenth with pyrender. Compiling takes a minute, or several on
# a busy machine.
MAX_STEP_S, MAX_START_S = 0.1, 900.0
UNKNOWN_END = "killed, often for lack of memory, or crashed"  # Ray cannot tell which
# A stopped job resumes from the stored episodes, not from Tune's snapshot of all trials. A snapshot at each
# result would cost more than the episodes. A training in this process has another interval.
SNAPSHOTS = {"TUNE_GLOBAL_CHECKPOINT_S": "3600"}  # [s]

Files = Mapping[str, Mapping[str, bytes]]  # policy folder -> name -> content
Batch = tuple[Part, ...]
BatchId = tuple[tuple[str, int], ...]
MAX_ROWS = 32  # most episodes of a batch, in lock-step; more would gain little
MAX_PIXELS = MAX_ROWS * 346 * 260  # most pixels of a batch's cameras, which take a worker's memory
BATCHES_PER_CORE = 8  # at least; with fewer, cores would idle at the end


def batches_of(parts: Sequence[Part], cores: int) -> list[Batch]:
    """Return parts in batches that are rolled out in lock-step, the longest first.

    Parts share a batch if one policy flies them and their observations and actions have one shape. A batch
    has at most `MAX_ROWS` episodes and `MAX_PIXELS` pixels, and fewer where each of the cores would have
    less than `BATCHES_PER_CORE` batches. Parts that pyrender may draw, which can end its process, stay alone.
    """
    most = min(MAX_ROWS, sum(len(part.task.seeds) for part in parts) // (BATCHES_PER_CORE * max(1, cores)))
    batches: dict[tuple[object, ...], list[list[Part]]] = defaultdict(list)
    for part in sorted(parts, key=_most_steps, reverse=True):
        camera, own = part.task.env.camera, batches[_shapes(part)]
        rows = len(part.task.seeds) + sum(len(other.task.seeds) for other in (own[-1] if own else []))
        if not own or rows > min(most, MAX_PIXELS // (camera.width * camera.height)):
            own.append([])
        own[-1].append(part)
    found = [tuple(batch) for some in batches.values() for batch in some]
    return sorted(found, key=_all_steps, reverse=True)


def _shapes(part: Part) -> tuple[object, ...]:
    """Return what the parts of a batch have in common."""
    task, env = part.task, part.task.env
    drawn_here = env.renderer == "auto" and isinstance(LAYOUTS.get(env.scene), Layout)
    alone = () if drawn_here or env.renderer in ("raycast", "spheres") else (part.task.part_id,)
    seen = env.camera.width, env.camera.height, env.window_capacity
    return task.policy.agent, task.action, task.table, *seen, env.vehicle, env.body.get("primitives"), *alone


def _most_steps(part: Part) -> float:
    """Return the number of control steps until the time limit of a part's episodes."""
    return part.task.env.time_limit_s * part.task.env.control_hz


def _all_steps(batch: Batch) -> float:
    """Return the number of control steps if every episode of a batch reaches its time limit."""
    return sum(len(part.task.seeds) * _most_steps(part) for part in batch)


def run_with_tune(parts: Sequence[Part], recorder: Recorder, cluster: ClusterConfig, folder: Path) -> None:
    """Evaluate parts as trials of Tune; start or join Ray.

    Args:
        parts: Grouped here into batches (`batches_of`), one trial each.
        recorder: Receives their results, in this process.
        cluster: Where Ray runs.
        folder: Folder for Tune's state, in the run folder.
    """
    start_ray(cluster, folder.parent)
    trial = tune.with_parameters(run_trial, files=policy_files(parts))
    callback = TrialCallback(recorder)
    with variables_set(SNAPSHOTS):
        batches = batches_of(parts, int(ray.cluster_resources().get("CPU", 1)))
        while batches:
            fit(_tuner(trial, batches, cluster, folder, callback))
            batches = callback.take_unfinished()


def _tuner(
    trial: Any, batches: Sequence[Batch], cluster: ClusterConfig, folder: Path, callback: "TrialCallback"
) -> tune.Tuner:
    shared = any(len(batch) > 1 for batch in batches)  # these are split at once if their process ends
    return tune.Tuner(
        tune.with_resources(trial, {"cpu": 1}),
        tune_config=tune.TuneConfig(reuse_actors=True),  # a new worker imports for seconds
        param_space={
            "trial": tune.grid_search([{"batch": batch, "limit_s": time_limit_s(batch)} for batch in batches])
        },
        run_config=tune.RunConfig(
            name="tune",
            storage_path=storage(cluster, folder),
            verbose=0,
            callbacks=[callback],
            failure_config=tune.FailureConfig(max_failures=0 if shared else MAX_FAILURES),
        ),
    )


def time_limit_s(batch: Batch) -> float:
    """Return the time after which the process of a batch counts as hanging [s]."""
    return MAX_START_S + _all_steps(batch) * MAX_STEP_S


def run_trial(params: Mapping[str, Any], files: Files) -> None:
    """Evaluate a batch in a Ray worker; report the result of each part, or the reason why it failed."""
    torch.set_num_threads(1)
    batch: Batch = params["trial"]["batch"]
    with ending_after(params["trial"]["limit_s"]):
        outcomes = evaluate_together([with_files(part, files) for part in batch])
    tune.report({"outcomes": outcomes})


class TrialCallback(tune.Callback):
    """Passes the results of trials, and the failures of their processes, to a recorder."""

    def __init__(self, recorder: Recorder | None) -> None:
        """Pass results and failures to `recorder`; None in a pickled copy."""
        self._recorder = recorder
        self._started: dict[BatchId, float] = {}
        self._ends: Counter[BatchId] = Counter()
        self._late: set[BatchId] = set()
        self._unfinished: list[Batch] = []

    def take_unfinished(self) -> list[Batch]:
        """Return and clear the batches to retry: failed batches, or their single parts."""
        unfinished, self._unfinished = self._unfinished, []
        return unfinished

    def __reduce__(self) -> tuple[type["TrialCallback"], tuple[None]]:
        """Pickle without the recorder: Tune pickles its callbacks, and a progress bar cannot be pickled."""
        return TrialCallback, (None,)

    def on_trial_start(self, iteration: int, trials: list[Trial], trial: Trial, **info: object) -> None:
        """Note the time at which a batch starts or restarts."""
        self._started[_id_of(_batch_of(trial))] = time.monotonic()

    def on_trial_result(
        self, iteration: int, trials: list[Trial], trial: Trial, result: dict[str, Any], **info: object
    ) -> None:
        """Pass the outcomes of a batch to the recorder."""
        if self._recorder is not None:
            for part, outcome in zip(_batch_of(trial), result["outcomes"], strict=True):
                self._recorder.finish(part, outcome)

    def on_trial_recover(self, iteration: int, trials: list[Trial], trial: Trial, **info: object) -> None:
        """Note that Tune retries a batch."""
        self._lose(trial, "tried again")

    def on_trial_error(self, iteration: int, trials: list[Trial], trial: Trial, **info: object) -> None:
        """Split a batch of several parts; retry a single part, or give it up after `MAX_FAILURES` retries."""
        batch = _batch_of(trial)
        if len(batch) > 1:
            self._unfinished += [(part,) for part in batch]
            self._lose(trial, "each part tried alone")
        elif self._ends[_id_of(batch)] < MAX_FAILURES:
            self._unfinished.append(batch)
            self._lose(trial, "tried again")
        else:
            self._lose(trial, "given up")

    def _lose(self, trial: Trial, consequence: str) -> None:
        batch = _batch_of(trial)
        own, limit_s = _id_of(batch), time_limit_s(batch)
        self._ends[own] += 1
        if time.monotonic() - self._started.get(own, math.inf) >= limit_s:
            self._late.add(own)
        cause = low_memory(newest_error(trial.error_file)) or UNKNOWN_END
        if own in self._late:
            cause = f"it may take {limit_s:.0f} s"
        if self._recorder is not None:
            for part in {part.task.key: part for part in batch}.values():  # once for each task
                reason = f"its process ended ({cause}) {self._ends[own]} times"
                self._recorder.lose(part, reason, consequence)


def _batch_of(trial: Trial) -> Batch:
    return trial.config["trial"]["batch"]


def _id_of(batch: Batch) -> BatchId:
    return tuple(part.task.part_id for part in batch)


def policy_files(parts: Sequence[Part]) -> dict[str, dict[str, bytes]]:
    """Read the files of all policy folders, for workers without access to them."""
    folders = [Path(agent) for agent in {part.task.policy.agent for part in parts} - BASELINES.keys()]
    return {
        str(folder): {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()}
        for folder in sorted(folders)
        if folder.is_dir()
    }


def with_files(part: Part, files: Files) -> Part:
    """Return the part with its policy's folder, if it has one, replaced by a copy written by this process."""
    policy = part.task.policy
    if policy.agent not in files:
        return part
    place = _unpacked.get(policy.identity)
    if place is None:
        # A killed process leaves the folder behind; it is then removed with the logs.
        place = tempfile.mkdtemp(prefix="evade-policy-", dir=session_folder())
        atexit.register(shutil.rmtree, place, ignore_errors=True)
        for name, content in files[policy.agent].items():
            (Path(place) / name).write_bytes(content)
        _unpacked[policy.identity] = place  # only once all files are written
    task = dataclasses.replace(part.task, policy=dataclasses.replace(policy, agent=place))
    return dataclasses.replace(part, task=task)


_unpacked: dict[str, str] = {}  # identity of a policy -> its folder in this process
