import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest

from jobs.rollout.diagnostics import DRIFT_METRICS
from jobs.rollout.episodes import EPISODE
from jobs.rollout.executors import Part, evaluate_part
from jobs.rollout.store import EpisodeStore, PartResult, SimulationAccuracy, TaskResult
from jobs.run.folder import open_run
from jobs.study.record import Evaluated, _exactness, facts_of, film_crashes, typical_crashes
from jobs.study.results import Results
from jobs.study.study import announce, run
from jobs.study.summaries import summaries_of
from models.policy.policy import NETWORKS
from tests.support.configs import sweep_config
from tests.support.episodes import flights
from tests.support.fake_executor import FakeExecutor
from tests.support.policies import save_training
from tests.support.runs import in_store, planned, tracked_sweeps


def published(config, found):
    """The results as their files have them."""
    return Results(json.loads(json.dumps(facts_of(open_run(config), found))), found.cells)


def results_of(sweep, episodes, folder):
    """What was found of a sweep whose tasks have these episodes, by key."""
    results = {key: TaskResult(rows, {}, ("c0ffee",), 0) for key, rows in episodes.items()}
    return Evaluated(sweep, EpisodeStore(folder), results, {})


def test_groups_are_compared_with_the_reference_as_far_as_they_were_evaluated(tmp_path):
    config = sweep_config(tmp_path, reference="straight")
    sweep = planned(config, "straight", "oracle", "random")
    won = {"straight": 5, "oracle": 20}
    flown = [task for task in sweep.tasks if task.policy.group in won]
    found = results_of(sweep, {task.key: flights(won[task.policy.group]) for task in flown}, tmp_path)
    rows = summaries_of(published(config, found))
    places = [(row.condition, row.group) for row in rows]
    assert places == [(at, name) for at in sweep.conditions for name in won]
    assert rows[0].success_difference is None
    assert rows[1].success_difference.value == 0.75
    alone = dataclasses.replace(config, own=dataclasses.replace(config.own, reference=None))
    assert all(row.success_difference is None for row in summaries_of(published(alone, found)))


def test_typical_crashes_are_those_in_the_middle():
    rows = np.zeros(6, EPISODE)
    rows["seed"], rows["collision"] = np.arange(6), [True, True, True, True, True, False]
    rows["distance_m"] = [5.0, 50.0, 48.0, 52.0, 90.0, 50.0]
    assert typical_crashes(rows) == [1, 2]
    assert typical_crashes(rows[5:]) == []


def test_crashes_of_each_groups_first_training_are_filmed_once(tmp_path):
    config = sweep_config(tmp_path)
    trainings = (("a", 0), ("a", 1), ("b", 4))
    agents = [save_training(tmp_path / f"{name}{seed}", name, seed, config.env) for name, seed in trainings]
    sweep = planned(config, *agents, "straight")
    usual = [task for task in sweep.tasks if task.condition[0] == "nominal"]
    rows = evaluate_part(Part(usual[0])).episodes
    rows["collision"] = [True, False]
    found = results_of(sweep, {task.key: rows for task in usual}, tmp_path)
    paths = film_crashes(tmp_path / "sweep", found)
    filmed = [f"{task.policy.group}-{task.key[:8]}-corridor0.mp4" for task in (usual[0], usual[2])]
    assert [path.name for path in paths] == filmed
    before = [path.stat().st_mtime_ns for path in paths]
    film_crashes(tmp_path / "sweep", found)
    assert [path.stat().st_mtime_ns for path in paths] == before


def test_what_made_a_sweep_is_told_without_a_place_of_this_machine(tmp_path, monkeypatch):
    named = f"study.policies=[{tmp_path}/mine,oracle]"
    words = ["x", "+exp=robustness", named, f"runs_dir={tmp_path}", "tracking.uri=sqlite:///a.db"]
    monkeypatch.setattr("sys.argv", words)
    config = sweep_config(tmp_path)
    sweep = planned(config, "straight")
    found = facts_of(open_run(config), results_of(sweep, {sweep.tasks[0].key: flights(1)}, tmp_path))
    assert found["evaluated_at"] == ["c0ffee"]
    assert found["command"] == "python -m platform.launch +exp=robustness 'study.policies=[mine,oracle]'"
    assert str(tmp_path) not in str(found)


def test_how_exact_a_condition_was_is_told_once_it_was_measured(tmp_path):
    sweep = planned(sweep_config(tmp_path), "straight", "oracle")
    found = results_of(sweep, {}, tmp_path)
    assert _exactness(found) == []
    task = next(task for task in sweep.tasks if task.condition == ("rate", 100))
    found.store.add(task, PartResult(flights(1, trials=1), {}, SimulationAccuracy(0.01, 5.0)), "c0ffee")
    measured = {"asked": 0.05, "event_error": 0.01, "renders_per_step": 5.0}
    assert _exactness(found) == [{"condition": ["rate", "100"], **measured}]


def test_who_is_evaluated_and_whose_sensor_differs_is_said(tmp_path, capsys):
    config = sweep_config(tmp_path)
    same = save_training(tmp_path / "same", "a", 0, config.env)
    slow = save_training(tmp_path / "slow", "a", 1, dataclasses.replace(config.env, control_hz=100.0))
    announce(planned(config, same, slow, "oracle"))
    assert capsys.readouterr().out.splitlines() == [
        "Group: a (training seeds 0, 1)",
        "Group: oracle",
        f"Evaluated with its own sensor: {slow}: control_hz = 100.0 instead of 200.0",
    ]


@pytest.mark.slow  # two whole reports
def test_a_sweep_is_one_run_with_a_child_for_each_condition_and_group_and_a_rerun_adds_no_point(tmp_path):
    config = in_store(sweep_config(tmp_path, policies=["straight", "oracle"], reference="straight"), tmp_path)
    for _ in range(2):
        figures = run(config, FakeExecutor())
    place = open_run(config).path / "study"
    names = {"sparsity.png", "rate.png", "table.md", "details.md", "episodes.csv", "about.json"}
    assert names <= {path.name for path in place.iterdir()}
    client, sweeps = tracked_sweeps(config)
    ((parent, children),) = sweeps.items()
    assert set(children) == set(figures)
    assert len(figures) == 5 * 2
    assert client.get_run(parent).info.run_name.startswith(f"{place.parent.name} sweep ")
    child = children["rate=100 oracle"]
    assert child.info.status == "FINISHED"
    wanted = {"axis": "rate", "value": "100", "group": "oracle", "seeds": "-", "env.control_hz": "100"}
    assert wanted.items() <= child.data.params.items()
    known = {"sweep/value": 100.0, "sim/event_error": 0.01, "sweep/success_difference": 0.0}
    assert known.items() <= child.data.metrics.items()
    history = client.get_metric_history(child.info.run_id, "eval/distance_m")
    assert [point.value for point in history] == [50.0]
    history = client.get_metric_history(parent, "sweep/conditions")
    assert [point.value for point in history] == [5.0]
    totals = {"sim/event_error_max": 0.01, "sweep/episodes": 8}  # of each baseline two rates
    assert totals.items() <= client.get_run(parent).data.metrics.items()
    (groups,) = tracked_sweeps(config, "group")[1].values()
    assert set(groups) == {"straight", "oracle"}
    curve = client.get_metric_history(groups["oracle"].info.run_id, "sweep/sparsity_percent_distance_m")
    assert [(point.step, point.value) for point in curve] == [(0, 50.0), (50, 50.0)]
    note = client.get_run(parent).data.tags["mlflow.note.content"]
    assert re.search(r"charts-.*page/sweep/sparsity\.png.*\| rate \| 100 \|", note, re.DOTALL)
    rows = Path(client.download_artifacts(parent, "sweep/episodes.csv", str(tmp_path))).read_bytes()
    assert rows == (place / "episodes.csv").read_bytes()
    # A simulation that several conditions share stands under each: conditions, agents, corridors.
    assert len(rows.splitlines()) == 1 + 5 * 2 * 2
    table = client.download_artifacts(parent, "sweep/results.json", str(tmp_path))
    assert len(json.loads(Path(table).read_text())["data"]) == len(figures)


@pytest.mark.system  # four seconds of MLflow's store
def test_a_failed_task_stands_in_the_table_and_its_child_comes_when_it_is_evaluated(tmp_path):
    config = in_store(sweep_config(tmp_path), tmp_path)
    executor = FakeExecutor()
    executor.broken = {("rate", 100): "ValueError: no"}
    run(config, executor)
    table = open_run(config).path / "study" / "table.md"
    assert "| rate | 100 | failed |" in table.read_text()
    assert "| rate | 100 | straight |  | ValueError: no |" in table.read_text()
    executor.broken = {}
    run(config, executor)
    assert "failed" not in table.read_text()
    _, sweeps = tracked_sweeps(config)
    ((_, children),) = sweeps.items()
    assert len(children) == 5


@pytest.mark.system  # four seconds of MLflow's store
def test_sweeps_of_other_policies_or_corridors_share_no_run_and_tell_what_differs_from_training(tmp_path):
    config = in_store(sweep_config(tmp_path), tmp_path)
    agent = save_training(tmp_path / "policy", "a", 0, dataclasses.replace(config.env, control_hz=100.0))
    for policies, trials in (([agent], 2), ([agent, "straight"], 2), ([agent], 3)):
        settings = dataclasses.replace(config.own, policies=policies, trials=trials)
        run(dataclasses.replace(config, own=settings), FakeExecutor())
    _, sweeps = tracked_sweeps(config)
    assert sorted(len(children) for children in sweeps.values()) == [5, 5, 10]
    for children in sweeps.values():
        differ = {name: json.loads(run.data.tags["differs_from_training"]) for name, run in children.items()}
        assert differ.pop("rate=200 a") == {"control_hz": [100.0, 200.0]}
        assert not any(differ.values())


@pytest.mark.slow
def test_tasks_evaluated_as_tune_trials_come_back_and_one_that_raises_stops_no_other(tmp_path):
    config = sweep_config(tmp_path)
    kinds = {"bytestream": 0, "event_columns": 0, "event_image": 1}
    agents = [save_training(tmp_path / name, name, seed, config.env, name) for name, seed in kinds.items()]
    (tmp_path / "event_image" / NETWORKS).write_bytes(b"")
    config = dataclasses.replace(config, own=dataclasses.replace(config.own, policies=agents))
    figures = run(config)
    assert list(figures.values()) == [0.0] * 5 * 2
    place = open_run(config).path / "study"
    assert "| event_image | 1 | PolicyFileError: " in (place / "table.md").read_text()
    kept = {path: path.read_text() for path in (place / "episodes").glob("*.json")}
    assert len(kept) == 3 * 2
    for task in map(json.loads, kept.values()):
        assert set(task["encoder"]) == (set(DRIFT_METRICS) if "bytestream" in task["label"] else set())
    assert run(config) == figures
    assert {path: path.read_text() for path in (place / "episodes").glob("*.json")} == kept
