import dataclasses

import numpy as np
import pytest

from jobs.rollout import scheduler
from jobs.rollout.episodes import roll_out_together
from jobs.rollout.executors import evaluate_part, evaluate_together, run_serially
from jobs.rollout.scheduler import default_executor, evaluate_tasks, plan_parts
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


def test_runs_in_which_some_raise_or_die_lead_to_the_results_of_one_run_and_evaluate_nothing_twice(
    tmp_path, store, executor
):
    few, many = (
        planned(sweep_config(tmp_path, trials=trials, axes=SEEN), "straight").tasks for trials in (2, 24)
    )
    keys = {task.condition: task.key for task in many}
    raised, died = ("speed", 10), ("rate", 100)
    executor.broken = {raised: "ValueError: no", died: ""}
    results, failed = evaluate_tasks(few, store, executor)
    assert failed == {keys[raised]: "ValueError: no", keys[died]: "its process ended 3 times"}
    assert set(results) == {keys["speed", 20]}
    executor.broken, executor.dying = {}, {(keys[raised], 8)}  # one of three parts
    assert evaluate_tasks(many, store, executor)[1] == {keys[raised]: "its process ended 3 times"}
    executor.dying = set()
    results, failed = evaluate_tasks(many, store, executor)
    assert not failed
    assert results[keys[raised]].restarts == 1
    assert len(executor.evaluated) == len(set(executor.evaluated)) == 3 * 24
    once, _ = evaluate_tasks(many, EpisodeStore(tmp_path / "once"), FakeExecutor())
    for key, result in once.items():
        assert list(result.episodes["seed"]) == list(range(24))
        np.testing.assert_array_equal(result.episodes, results[key].episodes)


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


def test_parts_in_one_batch_have_the_results_of_each_alone(tmp_path, store, monkeypatch):
    faults = {"faults.sparsity": [0.2], "faults.background_activity": [0.3]}
    axes = SEEN | {
        "late": {"env.action_delay_ms": [25]},
        "faults": faults,
        "long": {"env.time_limit_s": [0.3]},
    }
    config = sweep_config(tmp_path, axes=axes)
    path = save_training(tmp_path / "policy", "a", 0, config.env)
    parts = plan_parts(planned(config, path).tasks, store, False)
    alone, together = [evaluate_part(part) for part in parts], evaluate_together(parts)
    assert len({result.episodes["steps"][0] for result in alone}) > 2  # they end one after the other
    for own, shared in zip(alone, together, strict=True):
        assert shared.episodes.tobytes() == own.episodes.tobytes()
        assert shared.drift == own.drift
    monkeypatch.setattr("jobs.rollout.executors.roll_out_together", without_faults)
    failing = evaluate_together(parts)
    assert [isinstance(result, str) for result in failing] == [
        part.task.env.faults.sparsity > 0 for part in parts
    ]


def without_faults(agent, flights):
    if any(flight.config.faults.sparsity for flight in flights):
        raise ValueError("no")
    return roll_out_together(agent, flights)


def test_a_sweep_of_which_every_evaluation_raises_stops_with_the_reason(tmp_path, store, monkeypatch):
    monkeypatch.setattr("jobs.rollout.executors.roll_out_together", lambda *given: {}["no\nsuch"])
    tasks = planned(sweep_config(tmp_path), "straight").tasks
    with pytest.raises(RuntimeError, match=r"KeyError: 'no.*such'"):
        evaluate_tasks(tasks, store, run_serially)


DRAWN = {"renderer": {"renderer": ["raycast", "pyrender"]}}
FEW = [
    (2, AXES, "local", True),
    (2, AXES, "ray", False),
    (6, AXES, "local", False),
    (2, DRAWN, "local", False),
]


@pytest.mark.parametrize(("trials", "axes", "cluster", "here"), FEW)
def test_a_handful_of_episodes_does_without_ray(tmp_path, store, monkeypatch, trials, axes, cluster, here):
    config = sweep_config(tmp_path, trials=trials, axes=axes)
    used = []
    monkeypatch.setattr(scheduler, "run_serially", lambda *given: used.append(True))
    monkeypatch.setattr("jobs.rollout.tune_executor.run_with_tune", lambda *given: used.append(False))
    execute = default_executor(type(config.cluster)(**{**vars(config.cluster), "name": cluster}), tmp_path)
    execute(plan_parts(planned(config, "oracle").tasks[1:], store, False), None)
    assert used == [here]
