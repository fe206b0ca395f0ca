import dataclasses
import json

import numpy as np
import pytest

from envs.event_error import NO_CULLING_M
from jobs.config.config import ConfigError
from jobs.rollout.executors import evaluate_part
from jobs.rollout.policies import read_policy
from jobs.run.folder import locate_run
from jobs.studies.replays import Measured
from jobs.studies.trade import trade
from jobs.tracking.store import check_metrics
from models.encoder.weights import load_encoder
from models.policy.policy import ENCODER
from tests.support.configs import small_config
from tests.support.episodes import flights
from tests.support.fake_executor import FakeExecutor
from tests.support.policies import save_training
from tests.support.runs import in_store, tracked_sweeps


def trade_config(tmp_path, policy="bytestream-s0", **changes):
    config = small_config(tmp_path, job="trade", exp="trade")
    settings = dataclasses.replace(config.trade, policy=policy, **changes)
    return in_store(
        dataclasses.replace(config, trade=settings, env=dataclasses.replace(config.env, time_limit_s=0.05)),
        tmp_path,
    )


def planned(config, policy):
    return trade.plan(config, read_policy(policy), load_encoder(f"{policy}/{ENCODER}")[0])


@pytest.fixture
def policy(tmp_path):
    return save_training(tmp_path / "policy", "a", 0, small_config(tmp_path).env, "bytestream")


def test_the_default_comes_first_the_most_exact_last_and_nothing_twice(tmp_path, policy):
    tasks = planned(trade_config(tmp_path, pyrender_trials=1), policy)
    assert tasks[0].condition == ("default", "")
    assert tasks[-1].condition == ("most exact", "")
    assert len({task.key for task in tasks}) == len({task.condition for task in tasks}) == len(tasks) == 27
    assert ("tolerance", "tolerance 0.05") not in {task.condition for task in tasks}  # the default's
    assert tasks[-1].env.fidelity.cull_m == NO_CULLING_M
    assert dict(tasks[-1].table) == {"time_bins": 65536}
    drawn = {task.condition[0]: len(task.seeds) for task in tasks}
    assert (drawn["pyrender"], drawn["default"]) == (1, 2)


def test_one_thing_is_changed_at_a_time_but_for_what_goes_together(tmp_path, policy):
    tasks = planned(trade_config(tmp_path), policy)
    usual = tasks[0]
    for task in tasks[1:-1]:
        changed = (task.env != usual.env) + (task.table != usual.table)
        assert changed == (2 if task.condition == ("together", "coarse") else 1), task.condition
    assert {task.env.split for task in tasks} == {"eval"}


def test_another_table_is_another_cell_and_none_is_as_before_there_were_tables(tmp_path, policy):
    tasks = {task.condition: task for task in planned(trade_config(tmp_path), policy)}
    rounded = tasks["precision", "int8"]
    assert rounded.env == tasks["default", ""].env
    assert rounded.key != tasks["precision", "int16"].key != tasks["default", ""].key


def test_a_policy_without_such_an_encoder_is_refused_before_anything_is_written(tmp_path):
    for name in ("event_columns-s0", "pretrained", "oracle"):
        with pytest.raises(
            ConfigError, match=f"^trade.policy: must be one policy with a frozen.*got '{name}'"
        ):
            trade.run(trade_config(tmp_path, name))
    with pytest.raises(ConfigError, match=r"^trade.policy: must be 'pretrained', .*got 'nobody'"):
        trade.run(trade_config(tmp_path, "nobody"))
    assert not list(tmp_path.iterdir())


@pytest.fixture
def executor(monkeypatch):
    """Rolls out in this process."""
    monkeypatch.setattr(trade, "SPANS", {"tolerance": slice(5, None), "pyrender": slice(1)})
    return FakeExecutor(evaluate_part)


@pytest.mark.system
@pytest.mark.timeout(900)  # where no kernel is compiled yet
def test_the_job_leaves_table_figure_and_page_and_a_second_run_evaluates_only_what_failed(
    tmp_path, policy, executor
):
    config = trade_config(tmp_path, policy)
    executor.broken = {"pyrender": "RuntimeError: no OpenGL"}
    metrics = trade.run(config, executor)
    assert not executor.measured
    place = locate_run(config).path / "trade"
    table = (place / "table.md").read_text().splitlines()[2:]
    knobs = [line.split("|")[1].strip() for line in table]
    encoder = ["precision"] * 2 + ["time bins"] * 3 + ["newest events"] * 2
    assert knobs == ["default", "tolerance", *encoder, "together", "together", "most exact"]
    assert (place / "images" / "trade.png").is_file()
    assert (
        "pyrender renderer pyrender, samples 1: RuntimeError: no OpenGL." in (place / "trade.md").read_text()
    )
    assert str(tmp_path) not in (place / "trade.md").read_text()
    assert json.loads((place / "about.json").read_text())["policy"] == "a-s0"
    assert check_metrics(metrics)["perf/env_steps_per_second"] > 0
    assert 0 < metrics["sim/event_error"] < 1
    executor.evaluated.clear()
    trade.run(config, executor)
    assert executor.evaluated == []
    _, runs = tracked_sweeps(config, "setting", "trade")
    ((_, children),) = runs.items()
    assert len(children) == len(table)
    assert children["most exact"].data.metrics["sim/event_error"] == 0.0
    assert children["most exact"].data.tags["verdict"] in ("as good", "undecided", "worse")


@pytest.mark.system
def test_without_the_default_there_is_nothing_to_compare(tmp_path, policy, executor):
    executor.broken = {"default": "RuntimeError: no OpenGL"}
    with pytest.raises(RuntimeError, match=r"^default: .*RuntimeError: no OpenGL"):
        trade.run(trade_config(tmp_path, policy), executor)


def test_a_difference_is_taken_on_the_corridors_that_both_flew(tmp_path, policy):
    task = planned(trade_config(tmp_path), policy)[0]
    usual, few = flights(18), flights(5)[:10]
    row = trade.traded_setting(task, Measured(1.0, 0.0, 0.0, 0.0), few, usual)
    assert row.difference.value == pytest.approx(-0.5)
    assert row.summary.episodes == 10
    assert np.isfinite(row.difference.interval).all()
