"""Of several trainings the best under drawn faults becomes the policy, and says of what it is the best."""

import dataclasses
import itertools
import math
import shutil

import pytest

from jobs.config.conditions import axis_points
from jobs.rollout.executors import run_serially
from jobs.rollout.policies import PRETRAINED, read_policy
from jobs.run.files import write_atomic, write_json
from jobs.run.folder import finish, finished, open_run
from jobs.training import candidates
from jobs.training import train as training
from jobs.training.candidates import CORRIDORS, FAULTS, best_of, candidate_run, validation_tasks
from models.policy import load_policy
from models.policy.policy import MANIFEST, read_policy_manifest
from tests.support.configs import TINY, compose, make_config

LINE = '{"env_steps": 64, "train/success_rate": 0.5, "perf/trial_restarts": null}\n'


def config_of(tmp_path, count, *words):
    found = make_config("model=event_columns", f"train.candidates={count}", "seed=2", *words)
    return dataclasses.replace(found, runs_dir=str(tmp_path))


def tasks_of(config, seed=0):
    return validation_tasks(read_policy(str(PRETRAINED / f"event_columns-s{seed}")), "stochastic", config.env)


def test_all_candidates_meet_the_same_drawn_faults_in_corridors_that_no_evaluation_uses(tmp_path):
    config = config_of(tmp_path, 2)
    first, again, other = tasks_of(config), tasks_of(config), tasks_of(config, seed=1)
    assert [(task.key, task.seeds) for task in first] == [(task.key, task.seeds) for task in again]
    assert [(task.env, task.seeds) for task in first] == [(task.env, task.seeds) for task in other]
    assert not {task.key for task in first} & {task.key for task in other}
    assert {task.env.split for task in first} == {"validation"}
    by_condition = itertools.groupby(first, lambda task: task.condition[0])
    corridors = [sorted(seed for task in own for seed in task.seeds) for _, own in by_condition]
    assert corridors == [list(range(CORRIDORS))] * len(FAULTS)
    assert len({task.key for task in first}) == len(first)  # every draw is another simulation


def test_no_level_that_a_sweep_tests_decides(tmp_path):
    tasks = tasks_of(config_of(tmp_path, 2))
    drawn = {
        "faults.sparsity": {task.env.faults.sparsity for task in tasks},
        "faults.background_activity": {task.env.faults.background_activity for task in tasks},
        "camera.contrast_threshold": {task.env.camera.contrast_threshold for task in tasks},
        "env.control_hz": {task.env.control_hz for task in tasks},
    }
    usual = {0.0, 0.2, 200.0}
    for axis in compose("+exp=robustness")["study"]["axes"].values():
        for key in set(axis) & set(drawn):
            assert not {float(point[key]) for point in axis_points(axis)} & (drawn[key] - usual), key
    assert all(len(values) == 5 for values in drawn.values())


def test_the_best_succeeds_most_then_gets_farthest_then_comes_first():
    assert best_of({4: (0.5, 60.0), 5: (0.7, 50.0), 6: (0.7, 55.0), 7: (0.7, 55.0)}) == 6


@pytest.fixture
def trained(monkeypatch):
    """Let a training be the copy of a shipped one; return the trained seeds, and those at which it stops."""
    seeds, stops = [], set()

    def train_one(folder, encoder_path, on_result):
        config = folder.config
        if finished(folder, "train") is not None:
            return
        if config.seed in stops:
            raise KeyboardInterrupt
        shutil.copytree(PRETRAINED / f"event_columns-s{config.seed % 3}", folder.policy)
        manifest = read_policy_manifest(folder.policy / MANIFEST)
        write_json(folder.policy / MANIFEST, {**manifest, "seed": config.seed, "exp": config.exp})
        write_atomic(folder.train / "results.jsonl", LINE)
        finish(folder, "train", {"train/success_rate": 0.5})
        seeds.append(config.seed)

    monkeypatch.setattr(training, "train_one", train_one)
    monkeypatch.setattr(candidates, "default_executor", lambda *_: run_serially)
    monkeypatch.setattr(candidates, "CORRIDORS", 2)
    monkeypatch.setattr(candidates, "DRAWS", 1)
    monkeypatch.setattr(candidates, "FAULTS", FAULTS[:3])
    return seeds, stops


def test_the_best_is_shipped_and_says_so_and_a_stopped_choice_goes_on(tmp_path, trained, capsys):
    seeds, stops = trained
    folder, rows = open_run(config_of(tmp_path, 3, "env.time_limit_s=0.5")), []
    stops.add(8)
    with pytest.raises(KeyboardInterrupt):
        training.train(folder, None, lambda *row: rows.append(row))
    assert (seeds, rows, finished(folder, "train")) == ([6, 7], [], None)
    stops.clear()
    place = training.train(folder, None, lambda *row: rows.append(row))
    assert seeds == [6, 7, 8]  # those of seed 2; a run of seed 1 has 3, 4 and 5
    manifest = load_policy(place).manifest
    said = manifest["candidates"]
    assert manifest["seed"] == 2
    assert list(said["validation_success"]) == ["6", "7", "8"]
    assert said["validation_success"][str(said["chosen"])] == max(said["validation_success"].values())
    best = load_policy(candidate_run(folder, said["chosen"]).policy).manifest
    assert {**manifest, "candidates": 0, "seed": 0} == {**best, "candidates": 0, "seed": 0}
    assert "taken" in capsys.readouterr().out
    assert rows[0][0] == 64
    assert rows[0][1]["train/success_rate"] == 0.5
    assert math.isnan(rows[0][1]["perf/trial_restarts"])
    training.train(folder, None, rows.append)
    assert (len(seeds), len(rows)) == (3, 1)  # what is finished stays


@pytest.mark.slow
def test_two_candidates_are_trained_and_one_is_taken(tmp_path):
    config = config_of(tmp_path, 2, *TINY, "env.time_limit_s=0.035")
    training.run(config)
    folder = open_run(config)
    manifest = load_policy(folder.policy).manifest
    assert set(manifest["candidates"]["validation_success"]) == {"4", "5"}
    kept = {path: path.stat().st_mtime_ns for path in folder.path.rglob("*.json")}
    training.run(config)
    assert kept == {path: path.stat().st_mtime_ns for path in folder.path.rglob("*.json")}
