"""Evaluate a policy by EventPolicy-C: failures under corruptions, relative to those of a frozen reference.

Run: evade bench POLICY, such as bytestream_hold-s0, models/mine, policy.onnx or my_policy.py:policy
Expect: ten minutes on two idle cores for part C. To resume a stopped run, run the command again. In the run
folder, under `bench/`, one JSON and one CSV file of the policy for submission (docs/benchmark.md).
"""

import dataclasses
import hashlib
from typing import Literal

import numpy as np
from pydantic.dataclasses import dataclass

from envs.config import STRICT
from jobs.analysis.tables import show_table
from jobs.bench.evaluated import cost_of, evaluate_cells, find_benchmarked
from jobs.bench.protocol import Protocol, met_in_training, read_protocol, tasks_of
from jobs.bench.result import Result, csv_of, write_result
from jobs.bench.score import Scores, failure_counts, score
from jobs.config.config import Config, ConfigError
from jobs.config.schema import Name
from jobs.rollout.executors import Executor
from jobs.rollout.scheduler import default_executor
from jobs.rollout.store import EpisodeStore
from jobs.run.folder import open_run
from jobs.run.libraries import processor
from jobs.run.progress import console
from jobs.run.provenance import git_commit


@dataclass(frozen=True, config=STRICT)
class Settings:
    """The policy to evaluate, the part of the benchmark, and details for the leaderboard.

    Attributes:
        policy: A policy folder, a name in models/pretrained, a baseline, FILE.onnx, FILE.py:FUNCTION or
            FOLDER:FUNCTION.
        part: "C" corrupts the sensor, "W" changes the world.
        name: Name in the leaderboard; None: the policy's own name.
        source: Where others can get the policy, such as a link.
        met: Corruptions in the training of a foreign policy; known already for a policy folder.
    """

    policy: Name
    part: Literal["C", "W"]
    name: Name | None
    source: str
    met: list[str]


def run(config: Config, executor: Executor | None = None) -> dict[str, float]:
    """Evaluate the policy in all cells, print its scores, and write its result.

    Raises:
        ConfigError: The policy does not exist, or `bench.met` names an unknown corruption.
    """
    own, protocol, action = config.own, read_protocol(), config.evaluate.action
    policy, kind = find_benchmarked("bench.policy", own.policy, config)
    policy = policy if own.name is None else dataclasses.replace(policy, group=own.name)
    _check_met(own, protocol)
    tasks = tasks_of(protocol, own.part, policy, action)
    place = open_run(config).path / "bench"
    store = EpisodeStore(place)
    console.print(f"{protocol.title}, part {own.part}: {policy.name}", markup=False)
    cells = evaluate_cells(tasks, store, executor or default_executor(config.cluster, place), "Benchmark")
    reference = protocol.reference["failures"]
    if any(name not in reference for name, severity in cells if severity):  # new protocol without reference
        console.print(f"The reference has no failures yet; here: {failure_counts(cells)}", markup=False)
        return {}
    scores, text = score([cells], reference), csv_of(cells)
    show(scores, protocol)
    result = Result(
        benchmark=protocol.title,
        protocol=protocol.sha256,
        part=own.part,
        policy=policy.group,
        training=policy.training,
        kind=kind,
        identity=policy.identity,
        source=own.source,
        action=action,
        met=sorted({*own.met, *met_in_training(protocol, own.part, policy)}),
        mce=scores.mce,
        clean=scores.clean,
        worst=scores.worst,
        errors=scores.errors,
        failures=scores.failures,
        cost=cost_of(policy, action, next(iter(tasks.values()))[0].env),
        episodes=hashlib.sha256(text.encode()).hexdigest(),
        commit=git_commit(),
        processor=processor().get("model name", "unknown"),
    )
    console.print(f"Result: {write_result(place, result, text)}, and the CSV file beside it", markup=False)
    return {"mce": scores.mce, "clean": scores.clean, "worst": scores.worst}


def _check_met(own: Settings, protocol: Protocol) -> None:
    """Raise ConfigError if `bench.met` names a corruption that the protocol lacks."""
    names = list(protocol.parts[own.part])
    unknown = [name for name in own.met if name not in names]
    if unknown:
        raise ConfigError(f"bench.met: must be of {names}, got {unknown}")


def show(scores: Scores, protocol: Protocol) -> None:
    """Print failures by corruption and severity, and the mean corruption error."""
    rows = [
        (name, *(f"{100 * rate:.0f}" for rate in rates), f"{100 * scores.errors[name]:.0f}")
        for name, rates in scores.failures.items()
    ]
    head = ("Corruption", *(f"{severity} [%]" for severity in range(1, 6)), "CE [%]")
    show_table(f"Failures of {protocol.corridors} episodes, and corruption error", head, rows)
    low, high = scores.interval or (np.nan, np.nan)
    console.print(
        f"mCE {100 * scores.mce:.1f} % [{100 * low:.1f}, {100 * high:.1f}], 100 % is the reference "
        f"{protocol.reference['policy']}; "
        f"clean failures {100 * scores.clean:.0f} %, worst cell {100 * scores.worst:.0f} % "
        f"({scores.worst_cell[0]} {scores.worst_cell[1]})",
        markup=False,
    )
