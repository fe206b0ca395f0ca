"""Evaluate policies of several trainings under every condition, and report how robust each group is (D.3).

Run: python -m platform.launch +exp=robustness
Expect: about half a second of one core for each episode (7 for each training and condition); in the
run folder under `sweep/` a figure per axis, tables with intervals and every episode. All policies go
through the same corridors. A stopped sweep continues when the same command is given again: stored
episodes are read back, failed ones are tried again (`jobs.rollout.scheduler`).
"""

from jobs.config.config import Config
from jobs.evaluation.sweep_plan import Sweep, plan_sweep
from jobs.evaluation.sweep_report import SweepResults, report
from jobs.rollout.executors import Executor
from jobs.rollout.policies import find_sweep_policies
from jobs.rollout.scheduler import default_executor, evaluate_tasks
from jobs.rollout.store import EpisodeStore
from jobs.run.folder import finish, locate_run, open_run
from jobs.run.progress import console
from jobs.tracking.tracker import open_tracker


def run(config: Config, executor: Executor | None = None) -> dict[str, float]:
    """Evaluate what is missing, and report; return each group's success rate by condition.

    Args:
        config: The experiment.
        executor: Computes the missing episodes; None: on all cores.
    """
    policies = find_sweep_policies(config, locate_run(config))
    folder = open_run(config)
    config = folder.config
    sweep = plan_sweep(config, policies)
    announce(sweep)
    place = folder.path / "sweep"
    store, executor = EpisodeStore(place), executor or default_executor(config.cluster, place)
    with open_tracker(config, folder, key=f"sweep {sweep.identity[:8]}") as tracker:
        tracker.tags({"kind": "sweep", "groups": ", ".join(sweep.groups)})
        results = SweepResults(sweep, store, *evaluate_tasks(sweep.tasks, store, executor, "Sweep"))
        rates = report(config, folder, tracker, results)
        console.print(tracker.dashboard(), markup=False)
    return finish(folder, "sweep", rates)


def announce(sweep: Sweep) -> None:
    """Print what is evaluated, and where a policy's own sensor replaces the configured one."""
    for group, trainings in sweep.groups.items():
        seeds = ", ".join(str(seed) for seed in trainings if seed is not None)
        console.print(f"Group: {group}" + (f" (training seeds {seeds})" if seeds else ""), markup=False)
    for agent, differences in sweep.differences.items():
        changes = ", ".join(
            f"{name} = {own!r} instead of {ours!r}" for name, (own, ours) in differences.items()
        )
        console.print(f"Evaluated with its own sensor: {agent}: {changes}", markup=False)
