"""Run a study: train its variants or take published policies, evaluate all under every condition, compare.

Run: python -m platform.launch +exp=robustness
Expect: about half a second of one core for each episode (7 for each training and condition). In the run
folder under `study/`: a figure for each axis, tables with intervals, and every episode. All policies fly
through the same corridors. Each training of a variant has its own run folder, and a finished training is not
repeated. To resume a stopped study, run the same command again: stored episodes are read back, failed ones
are tried again (`jobs.rollout.scheduler`).
"""

import dataclasses

import numpy as np

from jobs.config.config import Config, ConfigError
from jobs.rollout.executors import Executor
from jobs.rollout.policies import EvaluatedPolicy, find_study_policies, read_policy
from jobs.rollout.scheduler import default_executor, evaluate_tasks
from jobs.rollout.store import EpisodeStore
from jobs.run.folder import Run, finish, locate_run, open_run
from jobs.run.progress import console
from jobs.study.plan import Plan, plan_study
from jobs.study.record import Evaluated, facts_of, record
from jobs.study.results import FOLDERS, Results
from jobs.study.settings import Settings
from jobs.study.spec import families_of
from jobs.study.trainings import check_variants, minutes, published_policies, train_variants
from jobs.tracking.tracker import open_tracker

__all__ = ["Settings", "run"]


def run(config: Config, executor: Executor | None = None) -> dict[str, float]:
    """Train and evaluate what is missing, write the results, return success rates by group and condition.

    Args:
        config: The experiment.
        executor: Computes the missing episodes; None: on all cores.

    Raises:
        ConfigError: No policy and no variant is named, or one has a wrong key or value.
    """
    if not config.own.policies and not config.own.variants:
        raise ConfigError(
            "study: must name policies or variants, got none; +exp=robustness names eight policies"
        )
    check_variants(config)
    taken = find_study_policies(config, locate_run(config))
    places = {} if config.own.train else published_policies(config)
    folder = open_run(config)
    config = folder.config
    times: dict[str, float] = {}
    if config.own.train:
        runs = train_variants(config)
        places = {training: one.policy for training, one in runs.items()}
        each: dict[str, list[float]] = {}
        for (name, _), one in runs.items():
            each.setdefault(name, []).append(minutes(one))
        times = {name: float(np.mean(own)) for name, own in each.items()}
    trained = [dataclasses.replace(read_policy(str(place)), group=name, training=seed)
               for (name, seed), place in places.items()]  # fmt: skip
    return evaluate(folder, [*taken, *trained], times, executor)


def evaluate(
    folder: Run,
    policies: list[EvaluatedPolicy],
    times: dict[str, float],
    executor: Executor | None,
) -> dict[str, float]:
    """Evaluate all policies in the same corridors, and write the results.

    `times` maps a variant to the mean minutes of its trainings; it may be empty.
    """
    config = folder.config
    plan = plan_study(config, policies)
    announce(plan)
    place = next(
        (folder.path / name for name in FOLDERS if (folder.path / name).is_dir()), folder.path / FOLDERS[0]
    )
    store, executor = EpisodeStore(place), executor or default_executor(config.cluster, place)
    planned = Evaluated(plan, store, {}, {})
    families_of(dataclasses.asdict(config.own), Results(facts_of(folder, planned), {}))  # find errors early
    kind = "ablation" if config.own.variants else "sweep"  # tags of earlier versions
    with open_tracker(config, folder, key=f"{kind} {plan.identity[:8]}") as tracker:
        tracker.tags({"kind": kind, "groups": ", ".join(plan.groups)})
        found = Evaluated(plan, store, *evaluate_tasks(plan.tasks, store, executor, "Study"))
        rates = record(folder, place, tracker, found, times)
        console.print(tracker.dashboard(), markup=False)
    return finish(folder, "study", rates)


def announce(plan: Plan) -> None:
    """Print the groups to evaluate, and where a policy's own sensor differs from the configured one."""
    for group, trainings in plan.groups.items():
        seeds = ", ".join(str(seed) for seed in trainings if seed is not None)
        console.print(f"Group: {group}" + (f" (training seeds {seeds})" if seeds else ""), markup=False)
    for agent, differences in plan.differences.items():
        changes = ", ".join(
            f"{name} = {own!r} instead of {ours!r}" for name, (own, ours) in differences.items()
        )
        console.print(f"Evaluated with its own sensor: {agent}: {changes}", markup=False)
