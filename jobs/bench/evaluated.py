"""Evaluate a policy in the cells of a protocol, or in some of their corridors."""

import dataclasses
import sys
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from envs.config import EnvConfig
from jobs.bench.protocol import Cell
from jobs.bench.result import Cost, Kind
from jobs.config.config import Config
from jobs.rollout.agents import BASELINES, ONNX, Agent, make_agent
from jobs.rollout.episodes import roll_out
from jobs.rollout.executors import Executor
from jobs.rollout.policies import EvaluatedPolicy, find_one_policy, read_foreign, read_policy
from jobs.rollout.scheduler import evaluate_tasks
from jobs.rollout.store import EpisodeStore
from jobs.rollout.tasks import EvaluationTask
from jobs.run.files import RunError
from jobs.run.folder import locate_run
from jobs.run.torch_threads import torch_threads

Tasks = Mapping[Cell, list[EvaluationTask]]


def find_benchmarked(key: str, name: str, config: Config) -> tuple[EvaluatedPolicy, Kind]:
    """Find a policy by name or path; return it with its kind.

    Raises:
        ConfigError: There is no such policy.
    """
    if name in BASELINES:
        return read_policy(name), "baseline"
    if name.endswith(ONNX) or ":" in name:
        return read_foreign(name), "onnx" if name.endswith(ONNX) else "function"
    return find_one_policy(key, name, config, locate_run(config)), "folder"


def evaluate_cells(
    tasks: Tasks, store: EpisodeStore, executor: Executor, title: str
) -> dict[Cell, np.ndarray]:
    """Evaluate the episodes that the store lacks; return the EPISODE rows of each cell, sorted by corridor.

    Raises:
        RunError: Tasks failed; running the same command again repeats them.
    """
    whole = joined(task for group in tasks.values() for task in group)
    _, failed = evaluate_tasks(whole, store, executor, title, measure_accuracy=False)
    if failed:
        reason = next(iter(failed.values()))
        raise RunError(f"{len(failed)} of {len(whole)} tasks failed ({reason}); the same command tries again")
    return {
        cell: np.sort(np.concatenate([store.result(task).episodes for task in group]), order="seed")
        for cell, group in tasks.items()
    }


def joined(tasks: Iterable[EvaluationTask]) -> list[EvaluationTask]:
    """Merge tasks with the same simulation; an agent that no fault affects has few different ones."""
    found: dict[str, EvaluationTask] = {}
    for task in tasks:
        seeds = sorted({*task.seeds, *(found[task.key].seeds if task.key in found else ())})
        found[task.key] = dataclasses.replace(found.get(task.key, task), seeds=tuple(seeds))
    return list(found.values())


class Timed:
    """An agent whose decisions are timed.

    Attributes:
        seconds: Wall time of each decision [s].
    """

    def __init__(self, agent: Agent) -> None:
        """Time the decisions of an agent."""
        self._agent, self.seconds = agent, list[float]()
        self.observation = agent.observation
        self.reset, self.keep = agent.reset, agent.keep

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Return the agent's actions."""
        begun = time.perf_counter()
        actions = self._agent(observations)
        self.seconds.append(time.perf_counter() - begun)
        return actions


def cost_of(policy: EvaluatedPolicy, action: str, env: EnvConfig) -> Cost:
    """Measure the cost of a policy in one training corridor of the clean cell, on one core."""
    with torch_threads(1):
        agent = Timed(make_agent(policy.agent, action))
        roll_out(agent, dataclasses.replace(env, split="train"), (0,))
    path = _place(policy.agent)
    files = [path] if path.is_file() else [file for file in path.glob("*") if file.is_file()]
    return Cost(
        bytes=sum(file.stat().st_size for file in files) if path.exists() else None,
        operations_per_event=_operations(agent),
        ms_per_decision=round(1e3 * float(np.median(agent.seconds)), 4),
    )


def _place(agent: str) -> Path:
    """Return the file or folder of an agent; for a function, of its imported module."""
    module = sys.modules.get(agent.rpartition(":")[0])
    path = Path(agent if module is None or module.__file__ is None else module.__file__)
    return path.parent if path.name == "__init__.py" else path


def _operations(agent: Timed) -> int | None:
    """Return the additions and comparisons per event of a tabulated encoder; None if unknown."""
    inner: Any = agent._agent
    features = getattr(getattr(getattr(inner, "policy", None), "encoder", None), "features", None)
    return None if features is None else 2 * int(features.shape[1])
