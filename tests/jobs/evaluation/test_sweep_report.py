import numpy as np

from jobs.evaluation.sweep_plan import plan, read_entry
from jobs.evaluation.sweep_report import (
    about,
    contacts,
    exactness,
    film_crashes,
    summarise_sweep,
    typical_crashes,
)
from jobs.rollout.episodes import EPISODE
from jobs.rollout.scheduler import flown
from jobs.rollout.tasks import accuracy_file
from jobs.run.files import write_json
from jobs.run.folder import open_run
from tests.support.configs import sweep_config
from tests.support.episodes import flights
from tests.support.policies import save_training
from tests.support.runs import planned


def test_groups_are_compared_with_the_reference_under_the_same_condition(tmp_path):
    sweep = planned(sweep_config(tmp_path), "straight", "oracle", "random")
    won = {"straight": 5, "oracle": 20, "random": 0}
    episodes = {cell.key: flights(won[cell.entry.group]) for cell in sweep.cells}
    rows = summarise_sweep(sweep, episodes, "straight")
    assert [(row.condition, row.group) for row in rows[:4]] == [
        (("nominal", "poles_eval"), "straight"),
        (("nominal", "poles_eval"), "oracle"),
        (("nominal", "poles_eval"), "random"),
        (("sparsity", "0"), "straight"),
    ]
    assert [row.success_difference and row.success_difference.value for row in rows[:3]] == [
        None,
        0.75,
        -0.25,
    ]
    assert all(row.success_difference is None for row in summarise_sweep(sweep, episodes, "nobody"))


def test_a_group_of_which_nothing_was_flown_has_no_row(tmp_path):
    sweep = planned(sweep_config(tmp_path), "straight", "oracle")
    episodes = {cell.key: flights(3) for cell in sweep.cells if cell.entry.group == "straight"}
    assert {row.group for row in summarise_sweep(sweep, episodes, "oracle")} == {"straight"}


def test_contacts_of_the_sweeps_scene_are_told_by_what_was_changed_and_counted_once(tmp_path):
    axes = {"sparsity": {"faults.sparsity": [0.0, 0.5]}, "world": {"env.scene": ["poles_eval", "poles"]}}
    config = sweep_config(tmp_path, axes=axes)
    sweep = planned(config, save_training(tmp_path / "policy", "a", 0, config.env))
    usual, changed = contacts(sweep, "a", {cell.key: flights(3) for cell in sweep.cells})
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
    sweep = plan(config, [read_entry(agent) for agent in (*agents, "straight")])
    usual = [cell for cell in sweep.cells if cell.label[0] == "nominal"]
    rows = np.array([tuple(row) for row in flown(usual[0], False)["episodes"]], EPISODE)
    rows["collision"] = [True, False]
    episodes = {cell.key: rows for cell in usual}
    paths = film_crashes(tmp_path / "sweep", sweep, episodes)
    assert [path.name for path in paths] == [
        f"{cell.entry.group}-{cell.key[:8]}-corridor0.mp4" for cell in (usual[0], usual[2])
    ]
    before = [path.stat().st_mtime_ns for path in paths]
    film_crashes(tmp_path / "sweep", sweep, episodes)
    assert [path.stat().st_mtime_ns for path in paths] == before


def test_what_made_a_sweep_is_told_without_a_place_of_this_machine(tmp_path, monkeypatch):
    named = f"sweep.policies=[{tmp_path}/mine,oracle]"
    words = ["x", "+exp=robustness", named, f"runs_dir={tmp_path}", "tracking.uri=sqlite:///a.db"]
    monkeypatch.setattr("sys.argv", words)
    config = sweep_config(tmp_path)
    found = about(config, open_run(config), planned(config, "straight"), ["c0ffee"])
    assert found["command"] == "python -m platform.launch +exp=robustness 'sweep.policies=[mine,oracle]'"
    assert str(tmp_path) not in str(found)


def test_how_exact_a_condition_was_is_told_once_it_was_measured(tmp_path):
    sweep = planned(sweep_config(tmp_path), "straight", "oracle")
    assert exactness(tmp_path, sweep) == []
    cell = next(cell for cell in sweep.cells if cell.label[0] != "nominal")
    values = {"event_error": 0.01, "renders_per_step": 5.0}
    write_json(accuracy_file(tmp_path, cell.simulation), values)
    found = exactness(tmp_path, sweep)
    assert {"condition": list(cell.label), "asked": 0.05, **values} in found
    told = [one.simulation == cell.simulation for one in sweep.cells if one.entry == cell.entry]
    assert len(found) == sum(told)
