"""What comes of a flown sweep: figures, tables, every episode, MLflow runs, and films of typical crashes."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from envs.scene import make_scene
from jobs.analysis.plots import style_of
from jobs.analysis.tables import markdown_table, show_table
from jobs.config.conditions import axis_numbers
from jobs.config.config import Config
from jobs.evaluation.evaluate import VIEW_COLUMNS, film
from jobs.evaluation.group_stats import (
    LABELS,
    Condition,
    Row,
    axis_curves,
    columns,
    details,
    matrix,
    metrics,
    name_of,
    success_text,
    summarise_group,
)
from jobs.evaluation.sweep_plan import NOMINAL, Sweep
from jobs.evaluation.sweep_plots import axis_figure, collision_figure
from jobs.rollout.drift import mean_figures
from jobs.rollout.episodes import EPISODE, check_sensor, write_episodes
from jobs.rollout.tasks import Cell, accuracy_file
from jobs.run.files import read_json, write_atomic, write_json
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
TITLE = "Success [%] with 95 % intervals; rows: what is changed, columns: who flies"
Episodes = Mapping[str, np.ndarray]


def report(
    config: Config,
    folder: Run,
    tracker: Tracker,
    sweep: Sweep,
    episodes: Episodes,
    kept: Mapping[str, Mapping[str, Any]],
    failed: Mapping[str, str],
) -> dict[str, float]:
    """Figures, tables and tracked runs of a flown sweep; each group's success rate by condition.

    Args:
        config: The experiment.
        folder: Its run folder.
        tracker: The sweep's MLflow run.
        sweep: What was flown.
        episodes: EPISODE of each cell that could be flown, by its key.
        kept: What else is kept of these, see `jobs.rollout.tasks.read_kept`.
        failed: Why the other cells could not be flown, by key.
    """
    rows = summarise_sweep(sweep, episodes, config.sweep.reference)
    place = folder.path / "sweep"
    for path in write_figures(place, config, sweep, rows, episodes):
        tracker.artifact(path, "sweep")
    for path in film_crashes(place, sweep, episodes):
        tracker.artifact(path, "sweep/crashes")
    flights = {(*cell.label, cell.entry.group, training_text(cell)): episodes[cell.key]
               for cell in sweep.cells if cell.key in episodes}  # fmt: skip
    write_episodes(place / "episodes.csv", LABELS, flights)
    commits = sorted({commit for values in kept.values() for commit in values["commits"]})
    write_json(place / "about.json", about(config, folder, sweep, commits))
    write_tables(place, tracker, config, sweep, rows, failed)
    track_rows(place, tracker, sweep, rows, kept, failed)
    return {f"{name_of(row.condition)} {row.group}": row.success.value for row in rows}


def summarise_sweep(sweep: Sweep, episodes: Episodes, reference: str) -> list[Row]:
    """The rows of all conditions and groups of which something was flown."""
    rows = []
    for condition in sweep.conditions:
        flown = {group: cells_of(sweep, condition, group, episodes) for group in sweep.groups}
        for group, trainings in flown.items():
            other = flown.get(reference) if group != reference else None
            if trainings:
                rows.append(summarise_group(condition, group, trainings, other))
    return rows


def cells_of(
    sweep: Sweep, condition: Condition, group: str, episodes: Episodes
) -> dict[int | None, np.ndarray]:
    """Training seed -> its episodes under one condition."""
    return {
        cell.entry.training: episodes[cell.key]
        for cell in sweep.cells
        if cell.label == condition and cell.entry.group == group and cell.key in episodes
    }


def training_text(cell: Cell) -> str:
    """A cell's training seed; nothing for a bound."""
    return "" if cell.entry.training is None else str(cell.entry.training)


def write_figures(
    place: Path, config: Config, sweep: Sweep, rows: Sequence[Row], episodes: Episodes
) -> list[Path]:
    """One figure for each axis, and the map of contacts."""
    paths = []
    place.mkdir(parents=True, exist_ok=True)
    for axis, points in sweep.axes.items():
        own = [row for row in rows if row.condition[0] == axis]
        if axis != NOMINAL and own:
            paths.append(place / f"{axis}.png")
            axis_figure(axis, points, own).savefig(paths[-1], dpi=120)
    scene = make_scene(config.sweep.scene, np.random.default_rng(0), **config.env.layout)
    ends = {group: contacts(sweep, group, episodes) for group in sweep.groups}
    paths.append(place / "contacts.png")
    collision_figure(ends, scene.length_m, scene.width_m / 2).savefig(paths[-1], dpi=120)
    return paths


def contacts(sweep: Sweep, group: str, episodes: Episodes) -> tuple[np.ndarray, np.ndarray]:
    """Episodes of a group in the sweep's scene: without any change, and under all changes."""
    own = {cell.key: cell for cell in sweep.cells if cell.entry.group == group and cell.key in episodes}
    usual = {cell.key: cell.env for cell in sweep.cells if cell.label[0] == NOMINAL}
    scene = next(iter(usual.values())).scene
    parts: tuple[list[np.ndarray], ...] = ([np.empty(0, EPISODE)], [np.empty(0, EPISODE)])
    for key, cell in own.items():
        if cell.env.scene == scene:
            parts[key not in usual].append(episodes[key])
    return np.concatenate(parts[0]), np.concatenate(parts[1])


def film_crashes(place: Path, sweep: Sweep, episodes: Episodes) -> list[Path]:
    """Films of contacts of each group's first training where nothing is changed; bounds have none."""
    usual = [cell for cell in sweep.cells if cell.label[0] == NOMINAL and cell.key in episodes]
    first = {cell.entry.group: cell for cell in reversed(usual) if cell.entry.training is not None}
    paths = []
    for group, cell in sorted(first.items()):
        for seed in typical_crashes(episodes[cell.key]):
            paths.append(place / "crashes" / f"{group}-{cell.key[:8]}-corridor{seed}.mp4")
            if not paths[-1].is_file():
                film(cell.entry.agent, cell.action, cell.env, seed, paths[-1])
    return paths


def typical_crashes(flown: np.ndarray) -> list[int]:
    """The corridors of at most `FILMED` contacts, those closest to the median way flown."""
    hit = flown[flown["collision"]]
    if not hit.size:
        return []
    far = np.abs(hit["distance_m"] - np.median(hit["distance_m"]))
    return [int(seed) for seed in hit["seed"][np.lexsort((hit["seed"], far))][:FILMED]]


def about(config: Config, folder: Run, sweep: Sweep, commits: Sequence[str]) -> dict[str, Any]:
    """What made the figures: command, commits and date, policies and axes; no path of a machine."""
    return {
        "run": folder.path.name,
        "identity": sweep.identity,
        "command": command(),
        "commit": git_commit(),
        "flown_at": list(commits),
        "date": today(),
        "budget": config.budget,
        "scene": config.sweep.scene,
        "trials": config.sweep.trials,
        "reference": config.sweep.reference,
        "action": config.evaluate.action,
        "groups": sweep.groups,
        "axes": sweep.axes,
        "exactness": exactness(folder.path / "sweep", sweep),
    }


def exactness(place: Path, sweep: Sweep) -> list[dict[str, Any]]:
    """How exact each condition was simulated: asked and achieved, as far as it was measured."""
    first = {cell.label: cell for cell in reversed(sweep.cells)}
    return [
        {"condition": list(label), "asked": cell.env.fidelity.tolerance, **read_json(file)}
        for label, cell in ((label, first[label]) for label in sweep.conditions)
        if (file := accuracy_file(place, cell.simulation)).is_file()
    ]


def write_tables(
    place: Path,
    tracker: Tracker,
    config: Config,
    sweep: Sweep,
    rows: Sequence[Row],
    failed: Mapping[str, str],
) -> None:
    """Show, store and track the tables."""
    gaps = {(*cell.label, cell.entry.group): "failed" for cell in sweep.cells if cell.key in failed}
    head, lines = matrix(rows, sweep.conditions, list(sweep.groups), gaps)
    reasons = sorted({(*cell.label, cell.entry.group, training_text(cell), failed[cell.key])
                      for cell in sweep.cells if cell.key in failed})  # fmt: skip
    show_table(TITLE, head, lines, len(head))
    text = f"{TITLE}.\n\n{markdown_table(head, lines, 2)}"
    if reasons:
        text += (
            f"\nNot flown; the same command tries again:\n\n{markdown_table((*LABELS, 'Reason'), reasons, 5)}"
        )
        console.print(f"Not flown: {len(reasons)} of {len(sweep.cells)}, see table.md", markup=False)
    write_atomic(place / "table.md", text)
    tracker.text("sweep/table.md", text)
    full = details(rows, config.sweep.reference)
    write_atomic(place / "details.md", full)
    tracker.text("sweep/details.md", full)
    if "sweep/results.json" not in {
        file.path for file in tracker.client.list_artifacts(tracker.run_id, "sweep")
    }:
        tracker.table("sweep/results", columns(rows))  # MLflow appends to a table that is there


def track_rows(
    place: Path,
    tracker: Tracker,
    sweep: Sweep,
    rows: Sequence[Row],
    kept: Mapping[str, Mapping[str, Any]],
    failed: Mapping[str, str],
) -> None:
    """A child run for each condition and group; what is not flown in full is tagged."""
    own: dict[tuple[str, ...], list[Cell]] = {}
    for cell in sweep.cells:
        own.setdefault((*cell.label, cell.entry.group), []).append(cell)
    children = []
    for row in rows:
        cells = own[(*row.condition, row.group)]
        axis, value = row.condition
        differ = (
            check_sensor({"sensor": cells[0].entry.sensor}, cells[0].env, True)
            if cells[0].entry.sensor
            else {}
        )
        seeds = ", ".join("-" if seed is None else str(seed) for seed in row.trainings)
        params = {"axis": axis, "value": value, "group": row.group, "seeds": seeds, "flights": row.flights}
        note = f"Success [%] of {row.group} with {axis} = {value}: {success_text(row)}. See the parent run."
        tags = {"differs_from_training": json.dumps(differ), NOTE: note, COLOUR: style_of(row.group)[0]}
        reasons = [failed[cell.key] for cell in cells if cell.key in failed]
        tags |= {"not_flown": "; ".join(reasons)} if reasons else {}
        simulated = accuracy(place, cells[0]) | mean_figures(
            [kept[cell.key] for cell in cells if cell.key in kept]
        )
        children.append(
            ChildRun(
                f"{name_of(row.condition)} {row.group}",
                params | sweep.axes[axis][value],
                tags,
                metrics(row) | simulated,
            )
        )
    write_child_runs(tracker, "condition", children)
    along = {row.group: group_curves(sweep, row.group, rows) for row in rows}
    write_child_runs(
        tracker,
        "group",
        [
            ChildRun(group, {"group": group}, {NOTE: CURVES_NOTE, COLOUR: style_of(group)[0]}, {}, curves)
            for group, curves in along.items()
        ],
    )
    save_views(tracker, list(dict.fromkeys(name for curves in along.values() for name in curves)))
    errors = [found["sim/event_error"] for cell in sweep.cells if (found := accuracy(place, cell))]
    worst = {"sim/event_error": errors[0], "sim/event_error_max": max(errors)} if errors else {}
    flights = sum({cell.key: len(cell.seeds) for cell in sweep.cells if cell.key in kept}.values())
    figures = {
        "conditions": len(sweep.conditions),
        "groups": len(sweep.groups),
        "flights": flights,
        "failed_cells": len(failed),
        "restarts": sum(cell.get("restarts", 0) for cell in kept.values()),
    }
    tracker.log_once(0, {f"sweep/{name}": value for name, value in figures.items()} | worst)


def group_curves(sweep: Sweep, group: str, rows: Sequence[Row]) -> dict[str, dict[int, float]]:
    """Success and distance of a group along every axis of numbers: metric -> axis value -> figure."""
    curves: dict[str, dict[int, float]] = {}
    for axis, points in sweep.axes.items():
        numbers = axis_numbers(points)
        own = [row for row in rows if row.group == group and row.condition[0] == axis]
        if numbers and own:
            curves |= axis_curves(axis, numbers, own)
    return curves


def save_views(tracker: Tracker, curves: Sequence[str]) -> None:
    """Store what shows a sweep's children: charts over the axes, and a table of all conditions."""
    below = f"tags.`mlflow.parentRunId` = '{tracker.run_id}' and tags.kind = "
    columns_shown = [
        *(f"metrics.`{name}`" for name in VIEW_COLUMNS),
        *(f"params.`{name}`" for name in CHILD_PARAMS),
    ]
    name = f"Sweep {tracker.run_id[:6]}"
    tracker.save_view(
        f"table-{tracker.run_id}", f"{name}: conditions", table_view(f"{below}'condition'", columns_shown)
    )
    charts = sorted(curves, key=lambda curve: not curve.endswith("_success"))
    tracker.save_view(f"charts-{tracker.run_id}", f"{name}: charts", chart_view(f"{below}'group'", charts))


def accuracy(place: Path, cell: Cell) -> dict[str, float]:
    """The same of a cell's simulation, if it was measured, under the names of a tracker."""
    file = accuracy_file(place, cell.simulation)
    values = read_json(file) if file.is_file() else {}
    return {f"sim/{name}": value for name, value in values.items()}
