import dataclasses

import numpy as np
import pytest

from jobs.rollout import scheduler
from jobs.rollout.executors import evaluate_part, run_serially
from jobs.rollout.scheduler import NothingEvaluatedError, default_executor, evaluate_tasks, plan_parts
from jobs.rollout.store import EpisodeStore
from tests.support.configs import AXES, sweep_config
from tests.support.fake_executor import FakeExecutor
from tests.support.policies import save_training
from tests.support.runs import planned

SEEN = {"speed": {"env.speed_mps": [20, 10]}, "rate": AXES["rate"]}  # changes that baselines notice


@pytest.fixture
def store(tmp_path):
    return EpisodeStore(tmp_path / "sweep")


@pytest.fixture
def executor():
    return FakeExecutor()


def test_a_second_run_evaluates_nothing_twice(tmp_path, store, executor):
    tasks = planned(sweep_config(tmp_path, axes=SEEN), "straight", "oracle").tasks
    first, failed = evaluate_tasks(tasks, store, executor)
    assert len(executor.evaluated) == len(set(executor.evaluated)) == 12
    assert not failed
    again, _ = evaluate_tasks(tasks, store, executor)
    assert len(executor.evaluated) == 12
    for key, result in first.items():
        np.testing.assert_array_equal(result.episodes, again[key].episodes)


def test_more_trials_evaluate_only_the_new_corridors(tmp_path, store, executor):
    few, many = (planned(sweep_config(tmp_path, trials=trials), "straight").tasks for trials in (2, 5))
    evaluate_tasks(few, store, executor)
    executor.evaluated.clear()
    results, _ = evaluate_tasks(many, store, executor)
    assert sorted({seed for _, seed in executor.evaluated}) == [2, 3, 4]
    assert all(list(result.episodes["seed"]) == [0, 1, 2, 3, 4] for result in results.values())


def test_a_sweep_that_was_stopped_evaluates_what_is_missing(tmp_path, store, executor):
    tasks = planned(sweep_config(tmp_path), "straight").tasks
    evaluate_tasks(tasks, store, executor)
    (store.folder / "episodes" / f"{tasks[2].key}.json").unlink()
    executor.evaluated.clear()
    evaluate_tasks(tasks, store, executor)
    assert executor.evaluated == [(tasks[2].key, 0), (tasks[2].key, 1)]


def test_each_simulation_is_measured_once_whatever_is_evaluated_in_it(tmp_path, store, executor):
    tasks = planned(sweep_config(tmp_path), "straight", "oracle").tasks
    evaluate_tasks(tasks, store, executor)
    assert len(executor.measured) == len({task.simulation for task in tasks}) == 2
    more = planned(sweep_config(tmp_path, trials=3), "straight", "oracle", "random").tasks
    assert not any(part.measures_accuracy for part in plan_parts(more, store, True))


def test_of_spheres_no_accuracy_is_measured(tmp_path, store):
    (task, *_) = planned(sweep_config(tmp_path), "straight").tasks
    for renderer in ("raycast", "spheres"):
        env = dataclasses.replace(task.env, scene="spheres", layout={"passable": False}, renderer=renderer)
        (part,) = plan_parts([dataclasses.replace(task, env=env)], store, True)
        assert part.measures_accuracy == (renderer == "raycast")


def test_what_raises_or_dies_stops_no_other_and_is_evaluated_by_the_next_run(tmp_path, store, executor):
    tasks = planned(sweep_config(tmp_path, axes=SEEN), "straight").tasks
    keys = {task.condition: task.key for task in tasks}
    raised, died = ("speed", 10), ("rate", 100)
    executor.broken = {raised: "ValueError: no", died: ""}
    results, failed = evaluate_tasks(tasks, store, executor)
    assert failed == {keys[raised]: "ValueError: no", keys[died]: "its process ended 3 times"}
    assert set(results) == {keys["speed", 20]}
    executor.broken = {}
    executor.evaluated.clear()
    assert evaluate_tasks(tasks, store, executor)[1] == {}
    assert {key for key, _ in executor.evaluated} == {keys[raised], keys[died]}


def test_a_sweep_of_which_everything_fails_stops_with_the_reason(tmp_path, store, executor):
    tasks = planned(sweep_config(tmp_path), "straight").tasks
    executor.broken = {task.condition: "ValueError: no" for task in tasks}
    with pytest.raises(NothingEvaluatedError, match=r": ValueError: no; "):
        evaluate_tasks(tasks, store, executor)


def test_a_task_of_which_a_part_dies_keeps_the_others_and_tries_that_part_again(tmp_path, store, executor):
    tasks = planned(sweep_config(tmp_path, trials=24), "straight").tasks[:1]
    executor.dying = {(tasks[0].key, 8)}
    with pytest.raises(NothingEvaluatedError, match="its process ended 3 times"):
        evaluate_tasks(tasks, store, executor)
    assert {seed for _, seed in executor.evaluated} == {*range(8), *range(16, 24)}
    executor.dying = set()
    executor.evaluated.clear()
    (result,) = evaluate_tasks(tasks, store, executor)[0].values()
    assert sorted(seed for _, seed in executor.evaluated) == list(range(8, 16))
    assert list(result.episodes["seed"]) == list(range(24))
    assert result.restarts == 1


def test_a_policy_is_evaluated_alone_and_the_accuracy_measured_where_asked(tmp_path, store):
    config = sweep_config(tmp_path)
    path = save_training(tmp_path / "policy", "a", 0, config.env)
    (task, *_) = planned(config, path).tasks
    (part,), (unmeasured,) = (plan_parts([task], store, measure) for measure in (True, False))
    first, again = evaluate_part(part), evaluate_part(unmeasured)
    np.testing.assert_array_equal(first.episodes, again.episodes)
    assert list(first.episodes["seed"]) == [0, 1]
    assert 0 <= first.accuracy.event_error < 0.2
    assert again.accuracy is None
    results, _ = evaluate_tasks([task], store, run_serially)
    np.testing.assert_array_equal(results[task.key].episodes, first.episodes)
    assert store.accuracy(task) == first.accuracy


def test_an_evaluation_that_raises_in_this_process_is_reported_with_its_error(tmp_path, store, monkeypatch):
    monkeypatch.setattr("jobs.rollout.executors.roll_out", lambda *given: {}["no\nsuch"])
    tasks = planned(sweep_config(tmp_path), "straight").tasks
    with pytest.raises(NothingEvaluatedError, match=r"KeyError: 'no.*such'"):
        evaluate_tasks(tasks, store, run_serially)


@pytest.mark.parametrize(
    ("trials", "axes", "cluster", "here"),
    [
        (2, AXES, "local", True),
        (2, AXES, "ray", False),
        (6, AXES, "local", False),
        (2, {"renderer": {"renderer": ["raycast", "pyrender"]}}, "local", False),
    ],
)
def test_a_handful_of_episodes_does_without_ray(tmp_path, store, monkeypatch, trials, axes, cluster, here):
    config = sweep_config(tmp_path, trials=trials, axes=axes)
    used = []
    monkeypatch.setattr(scheduler, "run_serially", lambda *given: used.append(True))
    monkeypatch.setattr("jobs.rollout.tune_executor.run_with_tune", lambda *given: used.append(False))
    execute = default_executor(type(config.cluster)(**{**vars(config.cluster), "name": cluster}), tmp_path)
    execute(plan_parts(planned(config, "oracle").tasks[1:], store, False), None)
    assert used == [here]
