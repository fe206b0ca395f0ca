"""Choose among trainings of one experiment with different seeds by evaluating each under drawn faults.

With PPO, seeds differ more than recipes do. The corridors are from the split `validation` and the values of
the conditions are drawn, so the choice depends on no corridor and no level of a later evaluation.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from envs.config import EnvConfig
from jobs.analysis.tables import show_table
from jobs.config.conditions import condition_errors, episode_draw
from jobs.config.config import Config
from jobs.rollout.policies import EvaluatedPolicy, read_policy
from jobs.rollout.scheduler import default_executor, evaluate_tasks
from jobs.rollout.store import EpisodeStore
from jobs.rollout.tasks import EvaluationTask, make_task
from jobs.run.files import write_atomic, write_json
from jobs.run.folder import Run
from models.policy.policy import MANIFEST, read_policy_manifest

CORRIDORS = 16  # per condition, the same for all candidates
DRAWS = 4  # of a condition's values; its corridors are divided evenly among them
TEXTURES = ["checker", "stripes", "rings", "noise"]
FAULTS: tuple[dict[str, Any], ...] = (
    {},
    {"faults.background_activity": {"low": 0.02, "high": 0.3}},
    {"faults.sparsity": {"low": 0.1, "high": 0.7}},
    {"faults.shot_noise_hz": {"low": 0.5, "high": 6.0}, "faults.hot_pixel_share": {"low": 0.0, "high": 0.006},
     "faults.hot_pixel_hz": 80.0},
    {"camera.contrast_threshold": {"low": 0.06, "high": 0.4, "log": True}},
    {"env.control_hz": {"low": 40.0, "high": 500.0, "log": True}},
    {"env.layout.ground_texture.pattern": TEXTURES, "env.layout.wall_texture.pattern": TEXTURES,
     "env.layout.ground_texture.contrast": {"low": 0.1, "high": 0.6},
     "env.layout.wall_texture.contrast": {"low": 0.1, "high": 0.6},
     "env.layout.wall_albedo": 0.6,
     "fidelity.tolerance": 0.5, "fidelity.samples": 1},  # textures are slow to render
)  # fmt: skip


def candidate_seeds(config: Config) -> list[int]:
    """Return the seeds of a run's candidates; runs with other seeds and as many candidates share none."""
    count = config.train.candidates
    return [config.seed * count + place for place in range(count)]


def candidate_run(folder: Run, seed: int) -> Run:
    """Return folder and configuration of a candidate's training; the folder lies in the run folder."""
    train = dataclasses.replace(folder.config.train, candidates=1)
    own = dataclasses.replace(folder.config, seed=seed, train=train)
    return Run(folder.path / "candidates" / f"{folder.path.name}-c{seed}", own)


def validation_tasks(policy: EvaluatedPolicy, action: str, trained: EnvConfig) -> list[EvaluationTask]:
    """Return a candidate's tasks: the `FAULTS` that its simulation supports, in validation corridors.

    Args:
        policy: The candidate.
        action: How it chooses its actions.
        trained: The simulation of its training, which the drawn conditions modify.
    """
    env = dataclasses.replace(trained, split="validation")
    tasks = []
    for place, condition in enumerate(FAULTS):
        if condition_errors("", [condition], env):  # a mesh has no textures to change
            continue
        draw, draws = episode_draw([condition]), DRAWS if condition else 1
        for number in range(draws):
            drawn = env if draw is None else draw(env, np.random.default_rng([place, number]))
            task = make_task((f"drawn{place}", number), policy, action, drawn, CORRIDORS)
            tasks.append(dataclasses.replace(task, seeds=tuple(range(number, CORRIDORS, draws))))
    return tasks


def validate(folder: Run, policies: Mapping[int, Path]) -> dict[int, tuple[float, float]]:
    """Evaluate all candidates; return seed -> success rate [-] and mean distance [m] over all tasks.

    Episodes are stored in the run folder, so a stopped validation resumes.

    Raises:
        RuntimeError: A task failed.
    """
    config, place = folder.config, folder.path / "candidates" / "validation"
    tasks = {
        seed: validation_tasks(read_policy(str(policy)), config.evaluate.action, config.env)
        for seed, policy in policies.items()
    }
    every = [task for own in tasks.values() for task in own]
    executor = default_executor(config.cluster, place)
    found, failed = evaluate_tasks(every, EpisodeStore(place), executor, "Validate", measure_accuracy=False)
    for task in every:
        if task.key in failed:
            raise RuntimeError(
                f"{task.name}: not validated: {failed[task.key]}; the same command tries again"
            )
    return {seed: _mean([found[task.key].episodes for task in own]) for seed, own in tasks.items()}


def _mean(episodes: Sequence[np.ndarray]) -> tuple[float, float]:
    every = np.concatenate(episodes)
    return float(every["success"].mean()), float(every["distance_m"].mean())


def best_of(rates: Mapping[int, tuple[float, float]]) -> int:
    """Return the seed with the highest success rate; ties go to the larger distance, then the lower seed."""
    return max(rates, key=lambda seed: (*rates[seed], -seed))


def take(folder: Run, best: Run, rates: Mapping[int, tuple[float, float]]) -> None:
    """Copy a candidate's policy and learning curve into its run.

    The manifest has the run's own seed, and the success rates of all candidates.
    """
    manifest = read_policy_manifest(best.policy / MANIFEST)
    chosen = {
        "chosen": best.config.seed,
        "validation_success": {str(seed): rate for seed, (rate, _) in rates.items()},
        "conditions": list(FAULTS),
    }
    for file in sorted(best.policy.iterdir()):
        if file.name != MANIFEST:
            write_atomic(folder.policy / file.name, file.read_bytes())
    write_json(folder.policy / MANIFEST, {**manifest, "seed": folder.config.seed, "candidates": chosen})
    lines = best.train / "results.jsonl"
    write_atomic(folder.train / lines.name, lines.read_bytes())


def show(rates: Mapping[int, tuple[float, float]], best: int) -> None:
    """Print the results of each candidate and which one was chosen."""
    rows = [
        (str(seed), f"{100 * rate:.0f}", f"{far:.0f}", "taken" if seed == best else "")
        for seed, (rate, far) in rates.items()
    ]
    head = ("Seed", "Success [%]", "Distance [m]", "")
    show_table("Candidates, in validation corridors under drawn faults", head, rows, 1)
