"""Evaluates tasks: splits what is missing into parts, hands these to an executor, stores each as it ends.

What is stored is never evaluated twice; what failed is tried again by the next run.
"""

from collections.abc import Sequence
from pathlib import Path

from jobs.config.schema import ClusterConfig
from jobs.rollout.executors import Executor, Part, Recorder, run_serially
from jobs.rollout.store import EpisodeStore, TaskResult
from jobs.rollout.tasks import MAX_EPISODES, EvaluationTask, split
from jobs.run.progress import progress


class NothingEvaluatedError(RuntimeError):
    """All tasks failed; the message says why in one line."""


def evaluate_tasks(
    tasks: Sequence[EvaluationTask],
    store: EpisodeStore,
    executor: Executor,
    title: str = "Evaluate",
    measure_accuracy: bool = True,
) -> tuple[dict[str, TaskResult], dict[str, str]]:
    """Evaluate what the store lacks, and return what it then holds.

    Args:
        tasks: Of those that share a key the first is evaluated.
        store: Where the episodes are kept.
        executor: Computes the missing parts.
        title: What the progress is called.
        measure_accuracy: Whether the accuracy of each simulation is measured too.

    Returns:
        Key -> result of the tasks that could be evaluated, and key -> reason of the others.

    Raises:
        NothingEvaluatedError: If all failed.
    """
    unique: dict[str, EvaluationTask] = {}
    for task in tasks:
        unique.setdefault(task.key, task)
    missing = [task for task in map(store.missing, unique.values()) if task.seeds]
    failed: dict[str, str] = {}
    if missing:
        total, left = (sum(len(task.seeds) for task in some) for some in (unique.values(), missing))
        parts = plan_parts(missing, store, measure_accuracy)
        with progress(title, total, "episodes", done=total - left) as advance:
            recorder = Recorder(store, advance)
            executor(parts, recorder)
        failed = {part.task.key: recorder.reason(part) for part in parts if store.missing(part.task).seeds}
    if unique and len(failed) == len(unique):
        reason = next(iter(failed.values()))
        raise NothingEvaluatedError(f"nothing could be evaluated: {reason}; the same command tries again")
    return {key: store.result(task) for key, task in unique.items() if key not in failed}, failed


def plan_parts(tasks: Sequence[EvaluationTask], store: EpisodeStore, measure_accuracy: bool) -> list[Part]:
    """Return the parts of tasks; the first of each simulation measures its accuracy, if it is to be known.

    That of `renderer=spheres` is not: the ray caster takes minutes for hundreds of spheres, and is wrong
    where they overlap.
    """
    parts = [part for task in tasks for part in split(task)]
    if not measure_accuracy:
        return [Part(part) for part in parts]
    first: dict[str, tuple[str, int]] = {}
    for part in parts:
        if part.env.renderer != "spheres" and store.accuracy(part) is None:
            first.setdefault(part.simulation, part.part_id)
    return [Part(part, first.get(part.simulation) == part.part_id) for part in parts]


def default_executor(cluster: ClusterConfig, folder: Path) -> Executor:
    """Return Tune's executor where it pays: a handful of episodes is done before Ray has started.

    Pyrender always runs in a process of its own, because a failing driver can end it.

    Args:
        cluster: Where Ray runs.
        folder: The folder of a run folder where Tune keeps its state.
    """

    def execute(parts: Sequence[Part], recorder: Recorder) -> None:
        few = sum(len(part.task.seeds) for part in parts) <= MAX_EPISODES
        drawn_here = all(part.task.env.renderer != "pyrender" for part in parts)
        if cluster.name == "local" and few and drawn_here:
            run_serially(parts, recorder)
            return
        from jobs.rollout.tune_executor import run_with_tune  # imports Ray, which takes seconds

        run_with_tune(parts, recorder, cluster, folder)

    return execute
