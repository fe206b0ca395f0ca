"""Evaluate tasks: split their missing episodes into parts, and store each part that an executor returns.

Stored episodes are never evaluated again. The next run of the command retries failed ones.
"""

from collections.abc import Sequence
from pathlib import Path

from jobs.config.schema import ClusterConfig
from jobs.rollout.executors import Executor, Part, Recorder, run_serially
from jobs.rollout.store import EpisodeStore, TaskResult
from jobs.rollout.tasks import MAX_EPISODES, EvaluationTask, split
from jobs.run.progress import progress


def evaluate_tasks(
    tasks: Sequence[EvaluationTask],
    store: EpisodeStore,
    executor: Executor,
    title: str = "Evaluate",
    measure_accuracy: bool = True,
) -> tuple[dict[str, TaskResult], dict[str, str]]:
    """Evaluate the episodes that the store lacks, and return the results of all tasks.

    Args:
        tasks: If tasks share a key, only the first is evaluated.
        store: Where the episodes are stored.
        executor: Computes the missing parts.
        title: Label of the progress bar.
        measure_accuracy: Whether the accuracy of each simulation is measured too.

    Returns:
        Key -> result for the tasks that succeeded, and key -> reason for those that failed.

    Raises:
        RuntimeError: All tasks failed; the message gives one reason in one line.
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
        raise RuntimeError(f"nothing could be evaluated: {reason}; the same command tries again")
    return {key: store.result(task) for key, task in unique.items() if key not in failed}, failed


def plan_parts(tasks: Sequence[EvaluationTask], store: EpisodeStore, measure_accuracy: bool) -> list[Part]:
    """Split tasks into parts; with `measure_accuracy`, the first part of each simulation measures it.

    The accuracy of `renderer=spheres` is never measured: the ray caster takes minutes for hundreds of
    spheres, and is wrong where they overlap.
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
    """Return an executor that uses Tune, or only this process for at most `MAX_EPISODES` local episodes.

    So few episodes take less time than the start of Ray. Pyrender always runs in a process of its own,
    because a failing graphics driver can end the process.

    Args:
        cluster: Where Ray runs.
        folder: Folder for Tune's state, in the run folder.
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
