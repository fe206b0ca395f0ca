"""The report of a sweep: plots, tables, every episode, MLflow runs, and videos of typical crashes."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NotRequired, TypedDict

import numpy as np

from envs.scene import make_scene
from jobs.analysis.plots import style_of
from jobs.analysis.tables import markdown_table, save_plot, show_table
from jobs.config.conditions import NOMINAL, axis_numbers
from jobs.config.config import Config
from jobs.evaluation.evaluate import VIEW_COLUMNS, film_episode
from jobs.evaluation.group_stats import (
    LABELS,
    MET,
    Condition,
    GroupResult,
    axis_curves,
    details_table,
    result_columns,
    result_metrics,
    success_table,
    success_text,
    summarise_group,
)
from jobs.evaluation.sweep_plan import Axes, Sweep
from jobs.evaluation.sweep_plots import axis_figure, collision_figure
from jobs.rollout.diagnostics import mean_drift
from jobs.rollout.episodes import EPISODE, write_episodes
from jobs.rollout.policies import own_sensor_differences
from jobs.rollout.store import EpisodeStore, TaskResult
from jobs.rollout.tasks import EvaluationTask
from jobs.run.checkpoints import sha256
from jobs.run.files import write_atomic, write_json
from jobs.run.folder import Run
from jobs.run.progress import console
from jobs.run.provenance import command, git_commit, today
from jobs.tracking.child_runs import ChildRun, write_child_runs
from jobs.tracking.pages import COLOUR, NOTE, chart_view, table_view
from jobs.tracking.tracker import Tracker

FILMED = 2
CHILD_PARAMS = ("axis", "value", "group")
CURVES_NOTE = (
    "One group along every axis of numbers: the step of a metric is the axis value. See the parent run."
)
WITHIN = f"{MET} The condition lies within what the group was trained on."
TITLE = "Success [%] with 95 % intervals; rows: what is changed, columns: groups"


class Exactness(TypedDict):
    """How exact the events of a condition were: the error that was asked, and what was achieved."""

    condition: tuple[str, str]
    asked: float
    event_error: float
    renders_per_step: float


class Compared(TypedDict):
    """What a condition is compared with, and the first condition that is the same simulation for all.

    Groups that were trained at another rate may be compared with another one.
    """

    condition: tuple[str, str]
    baseline: tuple[str, str]
    same_as: tuple[str, str]
    own_baseline: NotRequired[Mapping[str, tuple[str, str]]]  # group -> in place of `baseline`


class SweepFacts(TypedDict):
    """What made a sweep, as its about.json says it."""

    run: str
    exp: NotRequired[str]  # older sweeps have none
    identity: str
    command: str
    commit: str
    evaluated_at: list[str]
    date: str
    budget: str
    scene: str
    split: NotRequired[str]  # older sweeps are all "eval"
    trials: int
    reference: str
    action: str
    groups: dict[str, list[int | None]]
    axes: Axes
    exactness: list[Exactness]
    compared: NotRequired[list[Compared]]  # older sweeps have none
    met: NotRequired[list[tuple[str, str, str]]]  # of the sweep, sorted; older sweeps have none
    episodes_sha256: NotRequired[str]  # older sweeps have none


@dataclass(frozen=True)
class SweepResults:
    """What a sweep has found.

    Attributes:
        sweep: What was to be evaluated.
        store: Where its episodes are kept.
        results: Key of a task -> its result.
        failed: Key of a task -> why it has none.
    """

    sweep: Sweep
    store: EpisodeStore
    results: dict[str, TaskResult]
    failed: dict[str, str]

    def tasks(self, condition: Condition, group: str) -> list[EvaluationTask]:
        """The tasks of a group under one condition, one for each training."""
        every = self.sweep.tasks
        return [task for task in every if (task.condition, task.policy.group) == (condition, group)]

    def trainings(self, condition: Condition, group: str) -> dict[int | None, np.ndarray]:
        """Training seed -> its episodes under one condition, as far as there are any."""
        return {
            task.policy.training: self.results[task.key].episodes
            for task in self.tasks(condition, group)
            if task.key in self.results
        }

    def event_error(self, task: EvaluationTask) -> dict[str, float]:
        """How exact a task's simulation is, as metrics; empty if that was not measured."""
        accuracy = self.store.accuracy(task)
        values = {} if accuracy is None else asdict(accuracy)
        return {f"sim/{name}": value for name, value in values.items()}


def report(config: Config, folder: Run, tracker: Tracker, found: SweepResults) -> dict[str, float]:
    """Write plots, tables and tracked runs of a sweep; return each group's success rate by condition."""
    sweep = found.sweep
    place = folder.path / "sweep"
    groups = summarise_sweep(found, config.sweep.reference)
    for path in write_plots(place, config, found, groups):
        tracker.artifact(path, "sweep")
    for path in film_crashes(place, found):
        tracker.artifact(path, "sweep/crashes")
    episodes = {(*task.condition, task.policy.group, training_text(task)): found.results[task.key].episodes
                for task in sweep.tasks if task.key in found.results}  # fmt: skip
    write_episodes(place / "episodes.csv", LABELS, episodes)
    tracker.artifact(place / "episodes.csv", "sweep")
    facts = about(config, folder, found)
    write_json(place / "about.json", {**facts, "episodes_sha256": sha256(place / "episodes.csv")})
    write_tables(place, tracker, config.sweep.reference, found, groups)
    write_child_runs(tracker, "condition", [condition_run(found, result) for result in groups])
    track_groups(tracker, sweep, groups)
    track_sweep(tracker, found)
    return {result.name: result.success.value for result in groups}


def summarise_sweep(found: SweepResults, reference: str) -> list[GroupResult]:
    """The results of all conditions and groups of which something was evaluated."""
    results = []
    for condition in found.sweep.conditions:
        episodes = {group: found.trainings(condition, group) for group in found.sweep.groups}
        for group, trainings in episodes.items():
            other = episodes.get(reference) if group != reference else None
            if trainings:
                results.append(summarise_group(condition, group, trainings, other))
    return results


def training_text(task: EvaluationTask) -> str:
    """A task's training seed; nothing for a baseline."""
    return "" if task.policy.training is None else str(task.policy.training)


def write_plots(
    place: Path, config: Config, found: SweepResults, groups: Sequence[GroupResult]
) -> list[Path]:
    """One plot for each axis, and the map of contacts."""
    paths = []
    for axis, points in found.sweep.axes.items():
        own = [result for result in groups if result.condition[0] == axis]
        if axis != NOMINAL and own:
            paths.append(place / f"{axis}.png")
            save_plot(paths[-1], axis_figure(axis, points, own))
    scene = make_scene(config.sweep.scene, np.random.default_rng(0), **config.env.layout)
    ends = {group: contacts(found, group) for group in found.sweep.groups}
    paths.append(place / "contacts.png")
    save_plot(paths[-1], collision_figure(ends, scene.length_m, scene.width_m / 2))
    return paths


def contacts(found: SweepResults, group: str) -> tuple[np.ndarray, np.ndarray]:
    """Episodes of a group in the sweep's scene: without any change, and under all changes."""
    tasks = found.sweep.tasks
    own = {task.key: task for task in tasks if task.policy.group == group and task.key in found.results}
    usual = {task.key: task.env for task in tasks if task.condition[0] == NOMINAL}
    scene = next(iter(usual.values())).scene
    parts: tuple[list[np.ndarray], ...] = ([np.empty(0, EPISODE)], [np.empty(0, EPISODE)])
    for key, task in own.items():
        if task.env.scene == scene:
            parts[key not in usual].append(found.results[key].episodes)
    return np.concatenate(parts[0]), np.concatenate(parts[1])


def film_crashes(place: Path, found: SweepResults) -> list[Path]:
    """Videos of contacts of each group's first training where nothing is changed; baselines have none."""
    first: dict[str, EvaluationTask] = {}
    for task in found.sweep.tasks:
        if task.condition[0] == NOMINAL and task.key in found.results and task.policy.training is not None:
            first.setdefault(task.policy.group, task)
    paths = []
    for group, task in sorted(first.items()):
        for seed in typical_crashes(found.results[task.key].episodes):
            paths.append(place / "crashes" / f"{group}-{task.key[:8]}-corridor{seed}.mp4")
            if not paths[-1].is_file():
                film_episode(task.policy.agent, task.action, task.env, seed, paths[-1])
    return paths


def typical_crashes(episodes: np.ndarray) -> list[int]:
    """The corridors of at most `FILMED` contacts, those closest to the median distance."""
    hit = episodes[episodes["collision"]]
    if not hit.size:
        return []
    far = np.abs(hit["distance_m"] - np.median(hit["distance_m"]))
    return [int(seed) for seed in hit["seed"][np.lexsort((hit["seed"], far))][:FILMED]]


def about(config: Config, folder: Run, found: SweepResults) -> SweepFacts:
    """What made the plots and tables: command, commits and date, policies and axes; no path of a machine."""
    sweep = found.sweep
    return {
        "run": folder.path.name,
        "exp": config.exp,
        "identity": sweep.identity,
        "command": command(),
        "commit": git_commit(),
        "evaluated_at": sorted({commit for result in found.results.values() for commit in result.commits}),
        "date": today(),
        "budget": config.budget,
        "scene": config.sweep.scene,
        "split": config.sweep.split,
        "trials": config.sweep.trials,
        "reference": config.sweep.reference,
        "action": config.evaluate.action,
        "groups": sweep.groups,
        "axes": sweep.axes,
        "exactness": exactness(found),
        "compared": [compared(sweep, at) for at in sweep.conditions],
        "met": sorted(sweep.met),
    }


def compared(sweep: Sweep, at: Condition) -> Compared:
    """What a condition of a sweep is compared with."""
    usual = sweep.baselines[at]
    one = Compared(condition=at, baseline=usual, same_as=sweep.same_as[at])
    own = {group: found[at] for group, found in sweep.own_baselines.items() if found[at] != usual}
    return {**one, "own_baseline": own} if own else one


def exactness(found: SweepResults) -> list[Exactness]:
    """How exact each condition was simulated: asked and achieved, as far as it was measured."""
    first: dict[Condition, EvaluationTask] = {}
    for task in found.sweep.tasks:
        first.setdefault(task.condition, task)
    return [
        Exactness(
            condition=condition,
            asked=task.env.fidelity.tolerance,
            event_error=accuracy.event_error,
            renders_per_step=accuracy.renders_per_step,
        )
        for condition, task in ((condition, first[condition]) for condition in found.sweep.conditions)
        if (accuracy := found.store.accuracy(task)) is not None
    ]


def write_tables(
    place: Path, tracker: Tracker, reference: str, found: SweepResults, groups: Sequence[GroupResult]
) -> None:
    """Print, write and track the tables."""
    sweep, failed = found.sweep, [task for task in found.sweep.tasks if task.key in found.failed]
    gaps = {(*task.condition, task.policy.group): "failed" for task in failed}
    head, lines = success_table(groups, sweep.conditions, list(sweep.groups), gaps, sweep.met)
    show_table(TITLE, head, lines, len(head))
    text = f"{TITLE}.\n\n{markdown_table(head, lines, 2)}"
    if sweep.met:
        console.print(WITHIN, markup=False)
        text += f"\n{WITHIN}\n"
    if failed:
        reasons = sorted(
            {(*task.condition, task.policy.group, training_text(task), found.failed[task.key])
             for task in failed}
        )  # fmt: skip
        table = markdown_table((*LABELS, "Reason"), reasons, 5)
        text += f"\nNot evaluated; the same command tries again:\n\n{table}"
        console.print(f"Not evaluated: {len(reasons)} of {len(sweep.tasks)}, see table.md", markup=False)
    for name, content in (("table.md", text), ("details.md", details_table(groups, reference))):
        write_atomic(place / name, content)
        tracker.text(f"sweep/{name}", content)
    tracker.table("sweep/results", result_columns(groups))


def condition_run(found: SweepResults, result: GroupResult) -> ChildRun:
    """The child run of a group under one condition; a tag says what of it could not be evaluated."""
    axis, value = result.condition
    tasks = found.tasks(result.condition, result.group)
    seeds = ", ".join("-" if seed is None else str(seed) for seed in result.trainings)
    note = f"Success [%] of {result.group} with {axis} = {value}: {success_text(result)}. See the parent run."
    differences = own_sensor_differences(tasks[0].policy, tasks[0].env)
    tags = {
        "differs_from_training": json.dumps(differences),
        NOTE: note,
        COLOUR: style_of(result.group)[0],
    }
    reasons = [found.failed[task.key] for task in tasks if task.key in found.failed]
    if reasons:
        tags["not_evaluated"] = "; ".join(reasons)
    drift = mean_drift(found.results[task.key].drift for task in tasks if task.key in found.results)
    params = {
        "axis": axis,
        "value": value,
        "group": result.group,
        "seeds": seeds,
        "episodes": result.episodes,
        **found.sweep.axes[axis][value],
    }
    return ChildRun(result.name, params, tags, result_metrics(result) | found.event_error(tasks[0]) | drift)


def track_groups(tracker: Tracker, sweep: Sweep, groups: Sequence[GroupResult]) -> None:
    """Write a child run for each group, with its curves, and the views that show all children."""
    names = dict.fromkeys(result.group for result in groups)
    curves = {name: group_curves(sweep, name, groups) for name in names}
    children = [
        ChildRun(name, {"group": name}, {NOTE: CURVES_NOTE, COLOUR: style_of(name)[0]}, {}, own)
        for name, own in curves.items()
    ]
    write_child_runs(tracker, "group", children)
    save_views(tracker, list(dict.fromkeys(metric for own in curves.values() for metric in own)))


def track_sweep(tracker: Tracker, found: SweepResults) -> None:
    """Write the totals of a sweep, and the event errors of its simulations, into its own run."""
    sweep = found.sweep
    errors = [error["sim/event_error"] for task in sweep.tasks if (error := found.event_error(task))]
    totals = {
        "conditions": len(sweep.conditions),
        "groups": len(sweep.groups),
        "episodes": sum(len(result.episodes) for result in found.results.values()),
        "failed_tasks": len(found.failed),
        "restarts": sum(result.restarts for result in found.results.values()),
    }
    metrics: dict[str, float] = {f"sweep/{name}": value for name, value in totals.items()}
    if errors:
        metrics |= {"sim/event_error": errors[0], "sim/event_error_max": max(errors)}
    tracker.log_once(0, metrics)


def group_curves(sweep: Sweep, group: str, groups: Sequence[GroupResult]) -> dict[str, dict[int, float]]:
    """Success and distance of a group along every axis of numbers: metric -> axis value -> its value."""
    curves: dict[str, dict[int, float]] = {}
    for axis, points in sweep.axes.items():
        numbers = axis_numbers(points)
        own = [result for result in groups if (result.group, result.condition[0]) == (group, axis)]
        if numbers and own:
            curves |= axis_curves(axis, numbers, own)
    return curves


def save_views(tracker: Tracker, curves: Sequence[str]) -> None:
    """Store what shows a sweep's children: charts over the axes, and a table of all conditions."""
    below = f"tags.`mlflow.parentRunId` = '{tracker.run_id}' and tags.kind = "
    columns = [
        *(f"metrics.`{name}`" for name in VIEW_COLUMNS),
        *(f"params.`{name}`" for name in CHILD_PARAMS),
    ]
    name = f"Sweep {tracker.run_id[:6]}"
    tracker.save_view(
        f"table-{tracker.run_id}", f"{name}: conditions", table_view(f"{below}'condition'", columns)
    )
    charts = sorted(curves, key=lambda curve: not curve.endswith("_success"))
    tracker.save_view(f"charts-{tracker.run_id}", f"{name}: charts", chart_view(f"{below}'group'", charts))
