import dataclasses
import json

import numpy as np
import pytest

from envs.event_error import NO_CULLING_M
from jobs.config.config import ConfigError
from jobs.evaluation.sweep_plan import read_entry
from jobs.rollout import scheduler as flying
from jobs.run.folder import locate_run
from jobs.studies.replays import Measured
from jobs.studies.trade import trade
from jobs.tracking.store import check_metrics
from models.encoder.weights import load_encoder
from models.policy.policy import ENCODER
from tests.support.configs import small_config
from tests.support.episodes import flights
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
    return trade.plan(config, read_entry(policy), load_encoder(f"{policy}/{ENCODER}")[0])


@pytest.fixture
def policy(tmp_path):
    return save_training(tmp_path / "policy", "a", 0, small_config(tmp_path).env, "bytestream")


def test_the_default_comes_first_the_most_exact_last_and_nothing_twice(tmp_path, policy):
    cells = planned(trade_config(tmp_path, pyrender_trials=1), policy)
    assert cells[0].label == ("default", "")
    assert cells[-1].label == ("most exact", "")
    assert len({cell.key for cell in cells}) == len({cell.label for cell in cells}) == len(cells) == 27
    assert ("tolerance", "tolerance 0.05") not in {cell.label for cell in cells}  # the default's
    assert cells[-1].env.fidelity.cull_m == NO_CULLING_M
    assert dict(cells[-1].table) == {"time_bins": 65536}
    drawn = {cell.label[0]: len(cell.seeds) for cell in cells}
    assert (drawn["pyrender"], drawn["default"]) == (1, 2)


def test_one_thing_is_changed_at_a_time_but_for_what_goes_together(tmp_path, policy):
    cells = planned(trade_config(tmp_path), policy)
    usual = cells[0]
    for cell in cells[1:-1]:
        changed = (cell.env != usual.env) + (cell.table != usual.table)
        assert changed == (2 if cell.label == ("together", "coarse") else 1), cell.label
    assert {cell.env.split for cell in cells} == {"eval"}


def test_another_table_is_another_cell_and_none_is_as_before_there_were_tables(tmp_path, policy):
    cells = {cell.label: cell for cell in planned(trade_config(tmp_path), policy)}
    rounded = cells["precision", "int8"]
    assert rounded.env == cells["default", ""].env
    assert rounded.key != cells["precision", "int16"].key != cells["default", ""].key


def test_a_policy_without_such_an_encoder_is_refused_before_anything_is_written(tmp_path):
    for name in ("event_columns-s0", "pretrained", "oracle"):
        with pytest.raises(
            ConfigError, match=f"^trade.policy: must be one policy with a frozen.*got '{name}'"
        ):
            trade.run(trade_config(tmp_path, name))
    with pytest.raises(ConfigError, match=r"^trade.policy: must be 'pretrained', .*got 'nobody'"):
        trade.run(trade_config(tmp_path, "nobody"))
    assert not list(tmp_path.iterdir())


class StubTuner:
    """Flies in this process; a `broken` knob raises."""

    broken = ""
    flown: list[str] = []  # noqa: RUF012

    def __init__(self, place, missing, measured, keep):
        assert not measured
        self.missing, self.keep = missing, keep

    def fit(self):
        for cell in self.missing:
            result = {"key": cell.key, "label": list(cell.label)}
            if cell.label[0] == self.broken:
                self.keep.on_trial_result(1, [], None, {**result, "failed": "RuntimeError: no OpenGL"})
                continue
            self.flown.append(cell.key)
            self.keep.on_trial_result(1, [], None, result | flying.flown(cell, False))


@pytest.fixture
def stub(monkeypatch):
    StubTuner.broken, StubTuner.flown = "", []
    monkeypatch.setattr(flying, "_tuner", StubTuner)
    monkeypatch.setattr(flying, "start_ray", lambda *given: None)
    monkeypatch.setattr(trade, "SPANS", {"tolerance": slice(5, None), "pyrender": slice(1)})
    return StubTuner


@pytest.mark.system
@pytest.mark.timeout(900)  # where no kernel is compiled yet
def test_the_job_leaves_table_figure_and_page_and_a_second_run_flies_only_what_failed(tmp_path, policy, stub):
    config = trade_config(tmp_path, policy)
    stub.broken = "pyrender"
    metrics = trade.run(config)
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
    stub.flown.clear()
    trade.run(config)
    assert stub.flown == []
    _, runs = tracked_sweeps(config, "setting", "trade")
    ((_, children),) = runs.items()
    assert len(children) == len(table)
    assert children["most exact"].data.metrics["sim/event_error"] == 0.0
    assert children["most exact"].data.tags["verdict"] in ("as good", "undecided", "worse")


def test_without_the_default_there_is_nothing_to_compare(tmp_path, policy, stub):
    stub.broken = "default"
    with pytest.raises(
        RuntimeError, match=r"^default: not evaluated: RuntimeError: no OpenGL; the same command"
    ):
        trade.run(trade_config(tmp_path, policy))


def test_a_difference_is_taken_on_the_corridors_that_both_flew(tmp_path, policy):
    cell = planned(trade_config(tmp_path), policy)[0]
    usual, few = flights(18), flights(5)[:10]
    row = trade.traded_setting(cell, Measured(1.0, 0.0, 0.0, 0.0), few, usual)
    assert row.difference.value == pytest.approx(-0.5)
    assert row.summary.episodes == 10
    assert np.isfinite(row.difference.interval).all()
