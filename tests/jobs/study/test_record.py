import dataclasses
import json

import numpy as np

from jobs.rollout.episodes import EPISODE
from jobs.rollout.executors import Part, evaluate_part
from jobs.rollout.store import EpisodeStore, PartResult, SimulationAccuracy, TaskResult
from jobs.rollout.tasks import text_of
from jobs.run.folder import open_run
from jobs.study.figures import contact_ends
from jobs.study.record import Evaluated, _exactness, facts_of, film_crashes, typical_crashes
from jobs.study.results import Results
from jobs.study.summaries import summaries_of
from tests.support.configs import sweep_config
from tests.support.episodes import flights
from tests.support.policies import save_training
from tests.support.runs import planned


def published(config, found):
    """The results as their files have them."""
    return Results(json.loads(json.dumps(facts_of(open_run(config), found))), found.cells)


def results_of(sweep, episodes, folder):
    """What was found of a sweep whose tasks have these episodes, by key."""
    results = {key: TaskResult(rows, {}, ("c0ffee",), 0) for key, rows in episodes.items()}
    return Evaluated(sweep, EpisodeStore(folder), results, {})


def test_groups_are_compared_with_the_reference_under_the_same_condition(tmp_path):
    config = sweep_config(tmp_path, reference="straight")
    sweep = planned(config, "straight", "oracle", "random")
    won = {"straight": 5, "oracle": 20, "random": 0}
    episodes = {task.key: flights(won[task.policy.group]) for task in sweep.tasks}
    found = results_of(sweep, episodes, tmp_path)
    rows = summaries_of(published(config, found))
    assert [(row.condition, row.group) for row in rows[:4]] == [
        (("nominal", "poles_eval"), "straight"),
        (("nominal", "poles_eval"), "oracle"),
        (("nominal", "poles_eval"), "random"),
        (("sparsity", 0.0), "straight"),
    ]
    assert [row.success_difference and row.success_difference.value for row in rows[:3]] == [
        None,
        0.75,
        -0.25,
    ]
    alone = dataclasses.replace(config, own=dataclasses.replace(config.own, reference=None))
    assert all(row.success_difference is None for row in summaries_of(published(alone, found)))


def test_a_group_of_which_nothing_was_evaluated_has_no_result(tmp_path):
    config = sweep_config(tmp_path)
    sweep = planned(config, "straight", "oracle")
    episodes = {task.key: flights(3) for task in sweep.tasks if task.policy.group == "straight"}
    found = results_of(sweep, episodes, tmp_path)
    assert {row.group for row in summaries_of(published(config, found))} == {"straight"}


def test_contacts_of_the_sweeps_scene_are_told_by_what_was_changed_and_counted_once(tmp_path):
    axes = {"sparsity": {"faults.sparsity": [0.0, 0.5]}, "world": {"env.scene": ["poles_eval", "poles"]}}
    config = sweep_config(tmp_path, axes=axes)
    sweep = planned(config, save_training(tmp_path / "policy", "a", 0, config.env))
    found = results_of(sweep, {task.key: flights(3) for task in sweep.tasks}, tmp_path)
    for task in sweep.tasks:  # other episodes where something is changed
        found.results[task.key].episodes["steps"] = task.env.faults.sparsity > 0
    usual, changed = contact_ends(published(config, found))["a"]
    assert (len(usual), len(changed)) == (20, 20)


def test_typical_crashes_are_those_in_the_middle():
    rows = np.zeros(6, EPISODE)
    rows["seed"], rows["collision"] = np.arange(6), [True, True, True, True, True, False]
    rows["distance_m"] = [5.0, 50.0, 48.0, 52.0, 90.0, 50.0]
    assert typical_crashes(rows) == [1, 2]
    assert typical_crashes(rows[5:]) == []


def test_crashes_of_each_groups_first_training_are_filmed_once(tmp_path):
    config = sweep_config(tmp_path)
    agents = [
        save_training(tmp_path / f"{group}{seed}", group, seed, config.env)
        for group, seed in (("a", 0), ("a", 1), ("b", 4))
    ]
    sweep = planned(config, *agents, "straight")
    usual = [task for task in sweep.tasks if task.condition[0] == "nominal"]
    rows = evaluate_part(Part(usual[0])).episodes
    rows["collision"] = [True, False]
    found = results_of(sweep, {task.key: rows for task in usual}, tmp_path)
    paths = film_crashes(tmp_path / "sweep", found)
    assert [path.name for path in paths] == [
        f"{task.policy.group}-{task.key[:8]}-corridor0.mp4" for task in (usual[0], usual[2])
    ]
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
    task = next(task for task in sweep.tasks if task.condition[0] != "nominal")
    found.store.add(task, PartResult(flights(1, trials=1), {}, SimulationAccuracy(0.01, 5.0)), "c0ffee")
    told = _exactness(found)
    values = {"event_error": 0.01, "renders_per_step": 5.0}
    assert {"condition": [task.condition[0], text_of(task.condition[1])], "asked": 0.05, **values} in told
    same = [one.simulation == task.simulation for one in sweep.tasks if one.policy == task.policy]
    assert len(told) == sum(same)
