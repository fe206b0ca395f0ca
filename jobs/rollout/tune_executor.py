"""Evaluates the parts of tasks side by side as trials of Ray Tune, one core each.

A part whose process ends, or hangs longer than its limit, is tried `MAX_FAILURES` times more. Workers
get the policies from the driver, so that other machines need not see its folders.
"""

import atexit
import dataclasses
import math
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from ray import tune
from ray.tune.experiment import Trial

from jobs.config.schema import ClusterConfig
from jobs.rollout.agents import BASELINES
from jobs.rollout.executors import Part, Recorder, attempt, evaluate_part
from jobs.run.ray_cluster import fit, session_folder, start_ray, storage
from jobs.run.trial_errors import low_memory, newest_error
from jobs.run.variables import variables_set
from jobs.run.watchdog import ending_after

MAX_FAILURES = 2
# A step takes a thousandth of this, with pyrender a tenth; compiling takes a minute, and several
# on a busy machine.
MAX_STEP_S, MAX_START_S = 0.1, 900.0
UNKNOWN_END = "killed, often for lack of memory, or crashed"  # Ray cannot tell which
# Stored episodes are what a stopped job continues from. Tune's own picture of all trials, written
# at each result, would cost more than the episodes. A training of this process has another interval.
SNAPSHOTS = {"TUNE_GLOBAL_CHECKPOINT_S": "3600"}  # [s]

Files = Mapping[str, Mapping[str, bytes]]  # policy folder -> name -> content


def run_with_tune(parts: Sequence[Part], recorder: Recorder, cluster: ClusterConfig, folder: Path) -> None:
    """Evaluate parts as trials of Tune; starts or joins Ray.

    Args:
        parts: One trial each.
        recorder: Takes their results, in this process.
        cluster: Where Ray runs.
        folder: The folder of a run folder where Tune keeps its state.
    """
    start_ray(cluster, folder.parent)
    trial = tune.with_parameters(run_trial, files=policy_files(parts))
    callback = TrialCallback(recorder)
    with variables_set(SNAPSHOTS):
        while parts:
            fit(_tuner(trial, parts, cluster, folder, callback))
            parts = callback.take_unfinished()


def _tuner(
    trial: Any, parts: Sequence[Part], cluster: ClusterConfig, folder: Path, callback: "TrialCallback"
) -> tune.Tuner:
    return tune.Tuner(
        tune.with_resources(trial, {"cpu": 1}),
        tune_config=tune.TuneConfig(reuse_actors=True),  # a new worker imports for seconds
        param_space={
            "trial": tune.grid_search([{"part": part, "limit_s": time_limit_s(part)} for part in parts])
        },
        run_config=tune.RunConfig(
            name="tune",
            storage_path=storage(cluster, folder),
            verbose=0,
            callbacks=[callback],
            failure_config=tune.FailureConfig(max_failures=MAX_FAILURES),
        ),
    )


def time_limit_s(part: Part) -> float:
    """Return how long a part may take before its process counts as hanging [s]."""
    env = part.task.env
    return MAX_START_S + len(part.task.seeds) * env.time_limit_s * env.control_hz * MAX_STEP_S


def run_trial(params: Mapping[str, Any], files: Files) -> None:
    """Evaluate one part in a Ray worker and report its result, or why it failed."""
    torch.set_num_threads(1)
    part: Part = params["trial"]["part"]
    with ending_after(params["trial"]["limit_s"]):
        outcome = attempt(lambda: evaluate_part(with_files(part, files)))
    tune.report({"outcome": outcome})


class TrialCallback(tune.Callback):
    """Hands the results of trials to a recorder, and the ends of their processes."""

    def __init__(self, recorder: Recorder | None) -> None:
        """Hand them to `recorder`."""
        self._recorder = recorder
        self._started: dict[tuple[str, int], float] = {}
        self._ends: Counter[tuple[str, int]] = Counter()
        self._late: set[tuple[str, int]] = set()
        self._unfinished: list[Part] = []

    def take_unfinished(self) -> list[Part]:
        """Return the parts that Tune gave up too early: it gives up trials that have not begun."""
        unfinished, self._unfinished = self._unfinished, []
        return unfinished

    def __reduce__(self) -> tuple[type["TrialCallback"], tuple[None]]:
        """Pickle without the recorder: Tune pickles its callbacks, and a progress bar cannot be pickled."""
        return TrialCallback, (None,)

    def on_trial_start(self, iteration: int, trials: list[Trial], trial: Trial, **info: object) -> None:
        """Note when a part begins, or begins again."""
        self._started[_part_of(trial).task.part_id] = time.monotonic()

    def on_trial_result(
        self, iteration: int, trials: list[Trial], trial: Trial, result: dict[str, Any], **info: object
    ) -> None:
        """Hand over the outcome of a part."""
        if self._recorder is not None:
            self._recorder.finish(_part_of(trial), result["outcome"])

    def on_trial_recover(self, iteration: int, trials: list[Trial], trial: Trial, **info: object) -> None:
        """Note that a part is tried again."""
        self._lose(trial, "tried again")

    def on_trial_error(self, iteration: int, trials: list[Trial], trial: Trial, **info: object) -> None:
        """Note that a part is given up, unless its process has ended too seldom for that."""
        part = _part_of(trial)
        if self._ends[part.task.part_id] < MAX_FAILURES:
            self._unfinished.append(part)
            self._lose(trial, "tried again")
        else:
            self._lose(trial, "given up")

    def _lose(self, trial: Trial, consequence: str) -> None:
        part = _part_of(trial)
        name, limit_s = part.task.part_id, time_limit_s(part)
        self._ends[name] += 1
        if time.monotonic() - self._started.get(name, math.inf) >= limit_s:
            self._late.add(name)
        cause = low_memory(newest_error(trial.error_file)) or UNKNOWN_END
        if name in self._late:
            cause = f"it may take {limit_s:.0f} s"
        if self._recorder is not None:
            self._recorder.lose(part, f"its process ended ({cause}) {self._ends[name]} times", consequence)


def _part_of(trial: Trial) -> Part:
    return trial.config["trial"]["part"]


def policy_files(parts: Sequence[Part]) -> dict[str, dict[str, bytes]]:
    """Return the files of every policy folder, for workers that may not see it."""
    folders = [Path(agent) for agent in {part.task.policy.agent for part in parts} - BASELINES.keys()]
    return {
        str(folder): {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()}
        for folder in sorted(folders)
        if folder.is_dir()
    }


def with_files(part: Part, files: Files) -> Part:
    """Return the part, its policy's folder, if it has one, replaced by one that this process has written."""
    policy = part.task.policy
    if policy.agent not in files:
        return part
    place = _unpacked.get(policy.identity)
    if place is None:
        # A process that is killed leaves it behind: it goes with the logs then.
        place = tempfile.mkdtemp(prefix="evade-policy-", dir=session_folder())
        atexit.register(shutil.rmtree, place, ignore_errors=True)
        for name, content in files[policy.agent].items():
            (Path(place) / name).write_bytes(content)
        _unpacked[policy.identity] = place  # only when it is whole
    task = dataclasses.replace(part.task, policy=dataclasses.replace(policy, agent=place))
    return dataclasses.replace(part, task=task)


_unpacked: dict[str, str] = {}  # identity of a policy -> its folder in this process
