import dataclasses
import json

import numpy as np
import pytest
import torch

from envs.event_error import NO_CULLING_M
from jobs.config.config import ConfigError
from jobs.measure import trade
from jobs.measure.replays import Measured
from jobs.rollout.executors import evaluate_part
from jobs.rollout.policies import read_policy
from jobs.rollout.store import TaskResult
from jobs.run.folder import locate_run
from jobs.run.torch_threads import torch_threads
from jobs.tracking.store import check_metrics
from tests.support.configs import small_config
from tests.support.episodes import flights
from tests.support.fake_executor import FakeExecutor
from tests.support.policies import save_training
from tests.support.runs import in_store, tracked_sweeps


def trade_config(tmp_path, *policies, **changes):
    config = small_config(tmp_path, job="trade", exp="trade")
    settings = dataclasses.replace(config.own, policies=list(policies or ["bytestream-s0"]), **changes)
    return in_store(
        dataclasses.replace(config, own=settings, env=dataclasses.replace(config.env, time_limit_s=0.05)),
        tmp_path,
    )


@pytest.fixture
def policy(tmp_path):
    return save_training(tmp_path / "policy", "a", 0, small_config(tmp_path).env, "bytestream")


def test_the_default_comes_first_the_most_exact_last_and_one_thing_is_changed_at_a_time(tmp_path, policy):
    tasks = trade.plan(trade_config(tmp_path, pyrender_trials=1), read_policy(policy), "poles_eval").tasks
    assert tasks[0].condition == ("default", "")
    assert tasks[-1].condition == ("most exact", "")
    assert len({task.key for task in tasks}) == len({task.condition for task in tasks}) == len(tasks) == 27
    assert ("tolerance", "tolerance 0.05") not in {task.condition for task in tasks}  # the default's
    assert tasks[-1].env.fidelity.cull_m == NO_CULLING_M
    assert dict(tasks[-1].table) == {"time_bins": 65536}
    drawn = {task.condition[0]: len(task.seeds) for task in tasks}
    assert (drawn["pyrender"], drawn["default"]) == (1, 2)
    usual = tasks[0]
    for task in tasks[1:-1]:
        changed = (task.env != usual.env) + (task.table != usual.table)
        assert changed == (2 if task.condition == ("together", "coarse") else 1), task.condition
    assert {task.env.split for task in tasks} == {"eval"}


def test_a_policy_without_such_an_encoder_is_refused_before_anything_is_written(tmp_path):
    encoder = "must have a frozen encoder"
    refused = {"event_columns-s0": encoder, "pretrained": encoder, "nobody": "must be 'pretrained'"}
    for name, rule in refused.items():
        with pytest.raises(ConfigError, match=f"^trade.policies: {rule}.*got '{name}'"):
            trade.run(trade_config(tmp_path, name))
    assert not list(tmp_path.iterdir())


@pytest.fixture
def executor(monkeypatch):
    """Rolls out in this process."""
    monkeypatch.setattr(trade, "SPANS", {"tolerance": slice(-1, None), "pyrender": slice(1)})
    return FakeExecutor(evaluate_part)


@pytest.mark.system
def test_the_job_leaves_table_figure_and_page_and_a_second_run_evaluates_only_what_failed(
    tmp_path, policy, executor
):
    config = trade_config(tmp_path, policy)
    executor.broken = {"pyrender": "RuntimeError: no OpenGL"}
    metrics = trade.run(config, executor)
    assert not executor.measured
    place = locate_run(config).path / "trade"
    table = (place / "table.md").read_text().splitlines()[2:]
    knobs = [line.split("|")[2].strip() for line in table]
    encoder = ["precision"] * 2 + ["time bins"] * 3 + ["newest events"] * 2
    assert knobs == ["default", "tolerance", *encoder, "together", "together", "most exact"]
    assert (place / "images" / "trade.png").is_file()
    page = (place / "trade.md").read_text()
    assert "pyrender renderer pyrender, samples 1 of a s0 in poles_eval: RuntimeError: no OpenGL." in page
    assert "- **For speed**, " in page
    assert str(tmp_path) not in page
    assert json.loads((place / "about.json").read_text())["policies"] == {"a": 1}
    assert check_metrics(metrics)["perf/env_steps_per_second"] > 0
    assert 0 < metrics["sim/event_error"] < 1
    executor.evaluated.clear()
    trade.run(config, executor)
    assert executor.evaluated == []
    _, runs = tracked_sweeps(config, "setting", "trade")
    ((_, children),) = runs.items()
    assert len(children) == 2 * len(table)  # of the group, and of all
    exact = children["poles_eval most exact all"].data
    assert exact.metrics["sim/event_error"] == 0.0
    assert exact.tags["verdict"] in ("as good", "undecided", "worse")


@pytest.mark.system
def test_without_the_default_there_is_nothing_to_compare(tmp_path, policy, executor):
    executor.broken = {"default": "RuntimeError: no OpenGL"}
    with pytest.raises(RuntimeError, match=r"^default of a s0 in poles_eval: .*RuntimeError: no OpenGL"):
        trade.run(trade_config(tmp_path, policy), executor)


def test_costs_are_measured_with_one_thread_which_is_given_back(tmp_path, policy, monkeypatch):
    config, threads = trade_config(tmp_path), []
    monkeypatch.setattr(trade, "_measured", lambda *asked: threads.append(torch.get_num_threads()) or {})
    with torch_threads(3):
        trade.measure_plans(config, [trade.plan(config, read_policy(policy), "poles_eval")], {})
        assert (threads, torch.get_num_threads()) == ([1], 3)


def measured(*steps_us):
    return Measured(steps_us, 0.1, 0.2, 0.05)


def result(won, trials=20):
    return TaskResult(flights(won)[:trials], {}, ("c0ffee",), 0)


def test_trainings_are_compared_with_their_own_default_in_the_corridors_that_both_saw(tmp_path):
    """Two trainings whose default reaches 18 and 9 of 20; the setting loses 0 and 3 of the first 10."""
    config = trade_config(tmp_path)
    places = [save_training(tmp_path / f"{seed}", "a", seed, config.env, "bytestream") for seed in (0, 1)]
    plans = [trade.plan(config, read_policy(place), "poles_eval") for place in places]
    condition = plans[0].tasks[1].condition
    results = {
        plans[0].tasks[0].key: result(18), plans[0].tasks[1].key: result(18, 10),
        plans[1].tasks[0].key: result(9), plans[1].tasks[1].key: result(6, 10),
    }  # fmt: skip
    costs = [{("default", ""): measured(200.0, 100.0), condition: measured(50.0, 25.0)}] * 2
    row = trade.traded_setting(condition, list(zip(plans, costs, strict=True)), results)
    assert row.outcomes["a"] == row.outcomes["all"]
    assert (row.together.trainings, row.together.episodes) == (2, 20)
    assert row.together.difference.value == pytest.approx(-0.15)
    assert row.together.success.value == pytest.approx(0.8)
    assert row.speed.value == pytest.approx(4.0)
    assert row.speed.interval == pytest.approx((4.0, 4.0))
    usual = trade.traded_setting(("default", ""), list(zip(plans, costs, strict=True)), results)
    assert usual.together.difference.value == 0.0
    assert usual.speed.value == 1.0


def test_repeated_ratios_hold_the_true_one_as_often_as_they_say_and_turn_round():
    rng, held = np.random.default_rng(0), 0
    for _ in range(500):
        ratios = np.exp(rng.normal(0.3, 0.1, 8))
        (low, high), back = trade.speed_ratio(ratios).interval, trade.speed_ratio(1 / ratios)
        assert back.interval == pytest.approx((1 / high, 1 / low))
        held += low <= np.exp(0.3) <= high
    assert 0.92 <= held / 500 <= 0.98
    assert trade.speed_ratio([2.0]) == (2.0, None)


def test_a_row_needs_no_policy_that_lacks_its_setting_and_scenes_are_apart(tmp_path):
    """A training without time has no bins of it; what fails in one scene is not said of the other."""
    config = trade_config(tmp_path)
    timed, untimed = (
        read_policy(save_training(tmp_path / group, group, 0, config.env, "bytestream"))
        for group in ("timed", "untimed")
    )
    plans = [trade.plan(config, policy, "poles") for policy in (timed, untimed)]
    plans[1] = plans[1]._replace(tasks=[one for one in plans[1].tasks if one.condition[0] != "time bins"])
    conditions = [[task.condition for task in own.tasks] for own in plans]
    results = {task.key: result(10) for own in plans for task in own.tasks}
    costs = [dict.fromkeys(known, measured(100.0, 90.0)) for known in conditions]
    row = trade.traded_setting(("time bins", "16"), list(zip(plans, costs, strict=True)), results)
    assert set(row.outcomes) == {"timed", "all"}
    assert row.together.trainings == 1
    other = trade.plan(config, timed, "poles_dense")
    assert {task.key for task in other.tasks}.isdisjoint(task.key for task in plans[0].tasks)
    assert trade.met_fidelity([timed]) == {}
