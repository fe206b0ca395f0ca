"""Check a benchmark result: it must be consistent, and a random part must repeat to the byte.

Run: evade bench verify RESULT.json
Expect: half a minute on two cores; the number of equal episodes, or the first that differs and exit status
1. The probability of detecting one changed episode equals the repeated share, so a result with many changed
episodes is unlikely to pass.
"""

import dataclasses
import math
import secrets
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from envs.config import STRICT
from jobs.bench.evaluated import Tasks, evaluate_cells, find_benchmarked
from jobs.bench.protocol import Cell, Protocol, read_protocol, tasks_of
from jobs.bench.result import RefusedResultError, Submission, read_result
from jobs.config.config import Config, ConfigError
from jobs.config.schema import Name
from jobs.rollout.executors import Executor
from jobs.rollout.scheduler import default_executor
from jobs.rollout.store import EpisodeStore
from jobs.rollout.tasks import EvaluationTask
from jobs.run.progress import console

Chosen = Sequence[tuple[Cell, int]]  # cell and corridor


@dataclass(frozen=True, config=STRICT)
class Settings:
    """The result to check.

    Attributes:
        result: Its JSON file; the CSV file is in the same folder.
        policy: Local path of the policy; None: its name in models/pretrained, or a baseline.
        share: Share of the episodes to repeat, 0..1.
    """

    result: Name
    policy: Name | None
    share: Annotated[float, Field(gt=0, le=1)]


def run(config: Config, executor: Executor | None = None) -> dict[str, float]:
    """Repeat a random part of a result's episodes.

    Raises:
        RefusedResultError: The result is inconsistent, or a repeated episode differs.
        ConfigError: The policy is not on this machine.
    """
    protocol = read_protocol()
    submission = read_result(Path(config.own.result), protocol)
    result = submission.result
    seed = "" if result.training is None else f"-s{result.training}"
    try:
        policy, _ = find_benchmarked("bench_verify.policy", config.own.policy or result.policy + seed, config)
    except ConfigError as error:
        if config.own.policy is not None:
            raise
        rule = f"must be the place of {result.policy!r} (by {result.source or 'no named source'}), got none"
        remedy = f"evade bench verify {config.own.result} PLACE"
        raise ConfigError(f"bench_verify.policy: {rule}; write: {remedy}") from error
    if policy.identity != result.identity:
        rule = f"is of policy {result.identity}, got {policy.identity}; name the policy's place"
        raise RefusedResultError(f"{config.own.result}: {rule}: bench_verify.policy=PLACE")
    draw = secrets.randbits(32)
    chosen = choose(submission, config.own.share, np.random.default_rng(draw))
    tasks = some_of(tasks_of(protocol, result.part, policy, result.action), chosen)
    with tempfile.TemporaryDirectory() as folder:
        executor = executor or default_executor(config.cluster, Path(folder))
        repeated = evaluate_cells(tasks, EpisodeStore(Path(folder)), executor, "Verify")
    check_equal(submission, repeated, protocol)
    total = sum(rows.size for rows in submission.episodes.values())
    said = f"{len(chosen)} of {total} episodes repeated (drawn by {draw}), all equal to the byte"
    console.print(f"{result.name}: {said}", markup=False)
    return {"repeated": float(len(chosen))}


def choose(submission: Submission, share: float, rng: np.random.Generator) -> Chosen:
    """Draw a random share of the episodes, at least one."""
    every = [(cell, int(seed)) for cell, rows in submission.episodes.items() for seed in rows["seed"]]
    places = rng.choice(len(every), math.ceil(share * len(every)), replace=False)
    return [every[place] for place in np.sort(places)]


def some_of(tasks: Tasks, chosen: Chosen) -> Tasks:
    """Restrict the tasks to the chosen corridors."""
    wanted = set(chosen)
    found: dict[Cell, list[EvaluationTask]] = {}
    for cell, group in tasks.items():
        seeds = [tuple(seed for seed in task.seeds if (cell, seed) in wanted) for task in group]
        kept = [dataclasses.replace(task, seeds=own) for task, own in zip(group, seeds, strict=True) if own]
        found |= {cell: kept} if kept else {}
    return found


def check_equal(submission: Submission, repeated: dict[Cell, np.ndarray], protocol: Protocol) -> None:
    """Raise RefusedResultError for the first episode that is not byte-identical to its repetition."""
    for cell, rows in repeated.items():
        theirs = submission.episodes[cell][rows["seed"]]
        for here, there in zip(rows, theirs, strict=True):
            if here.tobytes() != there.tobytes():
                names = [name for name in here.dtype.names if here[name] != there[name]]
                said = ", ".join(f"{name} {there[name]} instead of {here[name]}" for name in names)
                where = f"{protocol.title} {cell[0]} {cell[1]}, corridor {here['seed']}"
                raise RefusedResultError(f"{submission.result.name}: {where}: {said}")
