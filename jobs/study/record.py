"""Write the results of a study into its run folder and the tracker: plots, tables, episodes, crash films."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from jobs.analysis.plots import style_of
from jobs.analysis.tables import estimate_text, markdown_table, save_plot, show_table
from jobs.config.conditions import NOMINAL, axis_numbers
from jobs.evaluation.evaluate import VIEW_COLUMNS, film_episode
from jobs.rollout.diagnostics import mean_drift
from jobs.rollout.policies import own_sensor_differences
from jobs.rollout.store import EpisodeStore, TaskResult
from jobs.rollout.table import LABELS
from jobs.rollout.tasks import EvaluationTask, text_of
from jobs.run.checkpoints import sha256
from jobs.run.files import write_atomic, write_json
from jobs.run.folder import Run
from jobs.run.progress import console
from jobs.run.provenance import command, git_commit, provenance, today
from jobs.study.axis_figure import axis_figure
from jobs.study.computed import Study, compute
from jobs.study.page import FOUND_MET, figures, part
from jobs.study.plan import Plan
from jobs.study.results import Condition, Results, texts_of, write_cells
from jobs.study.summaries import (
    Summary,
    axis_curves,
    columns_of,
    details_table,
    metrics_of,
    success_lines,
)
from jobs.study.tables import value_text
from jobs.tracking.child_runs import ChildRun, write_child_runs
from jobs.tracking.pages import COLOUR, NOTE, chart_view, table_view
from jobs.tracking.tracker import Tracker

FILMED = 2  # crashes filmed for each group
CHILD_PARAMS = ("axis", "value", "group")
CURVES_NOTE = (
    "One group along every axis of numbers: the step of a metric is the axis value. See the parent run."
)
TITLE = "Success [%] with 95 % intervals; rows: what is changed, columns: groups"


@dataclass(frozen=True)
class Evaluated:
    """The results of a plan.

    Attributes:
        plan: The planned evaluation tasks.
        store: Where their episodes are stored.
        results: Key of a task -> its result.
        failed: Key of a task -> why it has no result.
    """

    plan: Plan
    store: EpisodeStore
    results: dict[str, TaskResult]
    failed: dict[str, str]

    @cached_property
    def by_cell(self) -> dict[tuple[Condition, str], list[EvaluationTask]]:
        """Return condition and group -> its tasks, one for each training."""
        found: dict[tuple[Condition, str], list[EvaluationTask]] = {}
        for task in self.plan.tasks:
            found.setdefault((task.condition, task.policy.group), []).append(task)
        return found

    @cached_property
    def cells(self) -> dict[tuple[Condition, str], dict[int | None, np.ndarray]]:
        """Return condition and group -> training seed -> episodes; no entry where nothing was evaluated."""
        found = {
            at: {
                task.policy.training: self.results[task.key].episodes
                for task in tasks
                if task.key in self.results
            }
            for at, tasks in self.by_cell.items()
        }
        return {at: own for at, own in found.items() if own}

    def event_error(self, task: EvaluationTask) -> dict[str, float]:
        """Return the accuracy of a task's simulation as metrics; empty if it was not measured."""
        accuracy = self.store.accuracy(task)
        values = {} if accuracy is None else asdict(accuracy)
        return {f"sim/{name}": value for name, value in values.items()}


def record(
    folder: Run, place: Path, tracker: Tracker, found: Evaluated, times: Mapping[str, float]
) -> dict[str, float]:
    """Write plots, tables and MLflow runs of a study; return success rates by condition and group.

    Args:
        folder: The run folder.
        place: The folder in it that holds the study.
        tracker: The MLflow run of the study.
        found: The evaluated tasks.
        times: Variant -> mean minutes of its trainings; empty if none was trained.
    """
    write_cells(place / "episodes.csv", found.cells)
    tracker.artifact(place / "episodes.csv", "sweep")
    facts = facts_of(folder, found)
    results = Results(json.loads(json.dumps(facts)), found.cells)
    study = compute(folder.config.exp, asdict(folder.config.own), results, [], None)
    for path in write_plots(place, study):
        tracker.artifact(path, "sweep")
    for path in film_crashes(place, found):
        tracker.artifact(path, "sweep/crashes")
    write_tables(place, tracker, study, found, times)
    write_child_runs(tracker, "condition", [condition_run(found, one) for one in study.summaries])
    track_groups(tracker, study)
    track_totals(tracker, found, study)
    facts["episodes_sha256"] = sha256(place / "episodes.csv")
    write_json(place / "about.json", facts)  # written last: it marks the study as complete
    return {one.name: one.success.value for one in study.summaries}


def facts_of(folder: Run, found: Evaluated) -> dict[str, Any]:
    """Return the provenance of the results: command, commits, date, policies, axes; without local paths."""
    plan, config, study = found.plan, folder.config, folder.config.own
    return {
        **provenance(),
        "run": folder.path.name,
        "exp": config.exp,
        "identity": plan.identity,
        "command": command(),
        "commit": git_commit(),
        "evaluated_at": sorted({commit for result in found.results.values() for commit in result.commits}),
        "date": today(),
        "budget": config.budget,
        "scene": study.scene,
        "split": study.split,
        "trials": study.trials,
        "reference": study.reference,
        "action": config.evaluate.action,
        "groups": plan.groups,
        "axes": {axis: {text_of(value): dict(changes) for value, changes in points.items()}
                 for axis, points in plan.axes.items()},
        "exactness": _exactness(found),
        "compared": [_compared(plan, at) for at in plan.conditions],
        "met": sorted([*texts_of(at), group] for at, group in plan.met),
        "seeds": study.seeds,
        "env_steps": config.train.env_steps,
        "variants": {name: dict(changes) for name, changes in study.variants.items()},
    }  # fmt: skip


def _compared(plan: Plan, at: Condition) -> dict[str, Any]:
    """Return a condition's baselines and the first condition with the same simulation, as JSON values."""
    usual = plan.baselines[at]
    one = {"condition": texts_of(at), "baseline": texts_of(usual), "same_as": texts_of(plan.same_as[at])}
    own = {group: texts_of(found[at]) for group, found in plan.own_baselines.items() if found[at] != usual}
    return {**one, "own_baseline": own} if own else one


def _exactness(found: Evaluated) -> list[dict[str, Any]]:
    """Return the requested and the measured accuracy of each condition whose accuracy was measured."""
    first = {task.condition: task for task in reversed(found.plan.tasks)}
    return [
        {"condition": texts_of(at), "asked": task.env.fidelity.tolerance, **asdict(accuracy)}
        for at, task in ((at, first[at]) for at in found.plan.conditions)
        if (accuracy := found.store.accuracy(task)) is not None
    ]


def write_plots(place: Path, study: Study) -> list[Path]:
    """Write one plot for each axis, and the figures that the study's file names."""
    paths = []
    for axis, points in study.results.axes.items():
        own = [one for one in study.summaries if one.condition[0] == axis]
        if axis != NOMINAL and own:
            paths.append(place / f"{axis}.png")
            save_plot(paths[-1], axis_figure(axis, points, own))
    for name, figure in figures(study).items():
        paths.append(place / f"{name}.png")
        save_plot(paths[-1], figure)
    return paths


def film_crashes(place: Path, found: Evaluated) -> list[Path]:
    """Film contacts of each group's first training in the nominal condition; baselines are not filmed."""
    unchanged = [task for task in found.plan.tasks if task.condition[0] == NOMINAL]
    evaluated = [task for task in unchanged if task.key in found.results and task.policy.training is not None]
    first = {task.policy.group: task for task in reversed(evaluated)}
    paths = []
    for group, task in sorted(first.items()):
        for seed in typical_crashes(found.results[task.key].episodes):
            paths.append(place / "crashes" / f"{group}-{task.key[:8]}-corridor{seed}.mp4")
            if not paths[-1].is_file():
                film_episode(task.policy.agent, task.action, task.env, seed, paths[-1])
    return paths


def typical_crashes(episodes: np.ndarray) -> list[int]:
    """Return the corridors of at most `FILMED` contacts, those closest to the median distance."""
    hit = episodes[episodes["collision"]]
    if not hit.size:
        return []
    far = np.abs(hit["distance_m"] - np.median(hit["distance_m"]))
    return [int(seed) for seed in hit["seed"][np.lexsort((hit["seed"], far))][:FILMED]]


def write_tables(
    place: Path, tracker: Tracker, study: Study, found: Evaluated, times: Mapping[str, float]
) -> None:
    """Print, write and track the tables and the findings of all families of tests."""
    results, failed = study.results, [task for task in found.plan.tasks if task.key in found.failed]
    gaps = {(task.condition, task.policy.group): "failed" for task in failed}
    head, lines = success_lines(study.summaries, results, results.conditions, gaps)
    show_table(TITLE, head, lines, 2)
    text = f"{TITLE}.\n\n{markdown_table(head, lines, 2)}"
    if results.met:
        console.print(FOUND_MET, markup=False)
        text += f"\n{FOUND_MET}\n"
    if times:
        text += "\nMinutes of a training, without its encoder: "
        text += f"{', '.join(f'{name} {value:.1f}' for name, value in times.items())}.\n"
    if failed:
        labels = {(*texts_of(task.condition), task.policy.group, _seed_text(task)): found.failed[task.key]
                  for task in failed}  # fmt: skip
        reasons = sorted((*label, reason) for label, reason in labels.items())
        table = markdown_table((*LABELS, "Reason"), reasons, 5)
        text += f"\nNot evaluated; the same command tries again:\n\n{table}"
        console.print(f"Not evaluated: {len(reasons)} of {len(found.plan.tasks)}, see table.md", markup=False)
    else:
        for _, findings in study.families.values():
            for one in findings:
                console.print(f"{one.contrast.name}: {value_text(one)} {one.verdict}", markup=False)
        write_all(place, tracker, {"study.md": part(study, "results") + "\n"})
    details = details_table(study.summaries, str(results.facts["reference"]))
    write_all(place, tracker, {"table.md": text, "details.md": details})
    tracker.table("sweep/results", columns_of(study.summaries))


def write_all(place: Path, tracker: Tracker, texts: Mapping[str, str]) -> None:
    """Write texts, file name -> text, into the run folder and the tracker."""
    for name, text in texts.items():
        write_atomic(place / name, text)
        tracker.text(f"sweep/{name}", text)


def _seed_text(task: EvaluationTask) -> str:
    return "" if task.policy.training is None else str(task.policy.training)


def condition_run(found: Evaluated, one: Summary) -> ChildRun:
    """Return the child run of a group under one condition; a tag says why tasks of it failed, if any."""
    axis, value = texts_of(one.condition)
    tasks = found.by_cell[one.condition, one.group]
    seeds = ", ".join("-" if seed is None else str(seed) for seed in one.trainings)
    rate = estimate_text(one.success, 100, ".0f")
    tags = {
        "differs_from_training": json.dumps(own_sensor_differences(tasks[0].policy, tasks[0].env)),
        NOTE: f"Success [%] of {one.group} with {axis} = {value}: {rate}. See the parent run.",
        COLOUR: style_of(one.group)[0],
    }
    reasons = [found.failed[task.key] for task in tasks if task.key in found.failed]
    if reasons:
        tags["not_evaluated"] = "; ".join(reasons)
    drift = mean_drift(found.results[task.key].drift for task in tasks if task.key in found.results)
    params = {
        "axis": axis,
        "value": value,
        "group": one.group,
        "seeds": seeds,
        "episodes": one.episodes,
        **found.plan.axes[axis][one.condition[1]],
    }
    return ChildRun(one.name, params, tags, metrics_of(one) | found.event_error(tasks[0]) | drift)


def track_groups(tracker: Tracker, study: Study) -> None:
    """Write a child run with curves for each group, and the views that show all child runs."""
    curves = {name: _curves(study, name) for name in dict.fromkeys(one.group for one in study.summaries)}
    children = [
        ChildRun(name, {"group": name}, {NOTE: CURVES_NOTE, COLOUR: style_of(name)[0]}, {}, own)
        for name, own in curves.items()
    ]
    write_child_runs(tracker, "group", children)
    _save_views(tracker, list(dict.fromkeys(metric for own in curves.values() for metric in own)))


def _curves(study: Study, group: str) -> dict[str, dict[int, float]]:
    """Return a group's curves along every numeric axis: metric -> axis value -> value of the metric."""
    curves: dict[str, dict[int, float]] = {}
    for axis, points in study.results.axes.items():
        numbers = axis_numbers({text_of(value): changes for value, changes in points.items()})
        own = [one for one in study.summaries if (one.group, one.condition[0]) == (group, axis)]
        if numbers and own:
            curves |= axis_curves(axis, list(numbers.values()), own)
    return curves


def track_totals(tracker: Tracker, found: Evaluated, study: Study) -> None:
    """Log the totals of a study and the event errors of its simulations to its MLflow run."""
    plan = found.plan
    errors = [error["sim/event_error"] for task in plan.tasks if (error := found.event_error(task))]
    totals = {
        "conditions": len(plan.conditions),
        "groups": len(plan.groups),
        "episodes": sum(len(result.episodes) for result in found.results.values()),
        "failed_tasks": len(found.failed),
        "restarts": sum(result.restarts for result in found.results.values()),
    }
    metrics: dict[str, float] = {f"sweep/{name}": value for name, value in totals.items()}
    if errors:
        metrics |= {"sim/event_error": errors[0], "sim/event_error_max": max(errors)}
    for group in study.said["variants"]:
        rates = [study.results.values(at, group).mean() for at in study.results.conditions
                 if (at, group) in study.results.cells]  # fmt: skip
        metrics |= {f"eval/{group}_success": float(np.mean(rates))} if rates else {}
    tracker.log_once(0, metrics)


def _save_views(tracker: Tracker, curves: Sequence[str]) -> None:
    """Save the dashboard views of a study's child runs: charts over the axes, and a table of conditions."""
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
