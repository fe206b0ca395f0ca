import pickle
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from jobs.rollout import tune_executor
from jobs.rollout.executors import Part, Recorder, evaluate_part
from jobs.rollout.store import EpisodeStore
from jobs.rollout.tune_executor import (
    MAX_FAILURES,
    UNKNOWN_END,
    TrialCallback,
    policy_files,
    time_limit_s,
    with_files,
)
from tests.support.configs import sweep_config
from tests.support.fake_executor import made_up
from tests.support.policies import save_training
from tests.support.runs import planned


def first_part(config, agent="straight"):
    return Part(planned(config, agent).tasks[0])


@pytest.fixture
def recorder(tmp_path):
    return Recorder(EpisodeStore(tmp_path / "sweep"), lambda count, note: None)


def trial_of(part, error_file=None):
    return SimpleNamespace(config={"trial": {"part": part}}, error_file=error_file)


def test_a_part_whose_process_ends_is_counted_and_its_restarts_are_stored(tmp_path, recorder):
    part, callback = first_part(sweep_config(tmp_path)), TrialCallback(recorder)
    trial = trial_of(part)
    for _ in range(2):
        callback.on_trial_start(1, [], trial)
        callback.on_trial_recover(1, [], trial)
    assert recorder.reason(part) == f"its process ended ({UNKNOWN_END}) 2 times"
    callback.on_trial_result(1, [], trial, {"outcome": made_up(part)})
    assert EpisodeStore(tmp_path / "sweep").result(part.task).restarts == 2


def test_a_part_that_ends_after_its_limit_is_said_to_be_late(tmp_path, recorder, monkeypatch, capsys):
    monkeypatch.setattr(tune_executor, "MAX_START_S", 0.0)
    monkeypatch.setattr(tune_executor, "MAX_STEP_S", 0.0)
    monkeypatch.setattr(tune_executor, "MAX_FAILURES", 0)
    part, callback = first_part(sweep_config(tmp_path)), TrialCallback(recorder)
    callback.on_trial_start(1, [], trial_of(part))
    callback.on_trial_error(1, [], trial_of(part))
    assert recorder.reason(part) == "its process ended (it may take 0 s) 1 times"
    assert f"given up: {part.task.name}" in capsys.readouterr().out


def test_a_part_that_ray_ended_for_lack_of_memory_says_so(tmp_path, recorder):
    part, callback, errors = (
        first_part(sweep_config(tmp_path)),
        TrialCallback(recorder),
        tmp_path / "error.txt",
    )
    low = (
        "1 worker(s) were killed due to the node running low on memory. Memory on the node (IP: 127.0.0.1, "
        "ID: d3) was 6.76GB used / 23.54GB limit (0.287376)\nOOM kill reason: Memory usage exceeded\n"
    )
    begin = "Failure # {} (occurred at 2026-01-31_23-59-59)\n"
    errors.write_text(begin.format(1) + low)
    callback.on_trial_recover(1, [], trial_of(part, str(errors)))
    reason = "its process ended (by Ray, for lack of memory: 6.76GB of 23.54GB in use) {} times"
    assert recorder.reason(part) == reason.format(1)
    errors.write_text(begin.format(1) + low + begin.format(2) + "The actor died unexpectedly.\n")
    callback.on_trial_error(1, [], trial_of(part, str(errors)))
    assert recorder.reason(part) == f"its process ended ({UNKNOWN_END}) 2 times"


def test_a_part_that_tune_gives_up_too_early_is_tried_again(tmp_path, recorder, capsys):
    part, callback = first_part(sweep_config(tmp_path)), TrialCallback(recorder)
    for _ in range(MAX_FAILURES):
        callback.on_trial_error(1, [], trial_of(part))
        assert callback.take_unfinished() == [part]
        assert "tried again" in capsys.readouterr().out
    callback.on_trial_error(1, [], trial_of(part))
    assert callback.take_unfinished() == []
    assert "given up" in capsys.readouterr().out


def test_the_reason_that_a_part_gave_comes_before_the_end_of_its_process(tmp_path, recorder):
    part, callback = first_part(sweep_config(tmp_path)), TrialCallback(recorder)
    callback.on_trial_result(1, [], trial_of(part), {"outcome": "ValueError: no"})
    callback.on_trial_error(1, [], trial_of(part))
    assert recorder.reason(part) == "ValueError: no"


def test_the_callback_can_be_pickled_without_its_progress_bar(recorder):
    callback = pickle.loads(pickle.dumps(TrialCallback(recorder)))
    assert isinstance(callback, TrialCallback)


def test_a_longer_part_may_take_longer(tmp_path):
    short, long = (first_part(sweep_config(tmp_path, trials=trials)) for trials in (1, 9))
    assert 900 < time_limit_s(short) < time_limit_s(long)


def test_a_worker_evaluates_the_policy_of_the_driver_though_it_cannot_see_its_folder(tmp_path):
    config = sweep_config(tmp_path)
    path = Path(save_training(tmp_path / "policy", "a", 0, config.env))
    part = first_part(config, str(path))
    here = evaluate_part(part)
    files = policy_files([part])
    shutil.rmtree(path)
    there = with_files(part, files)
    assert there.task.policy.agent != part.task.policy.agent
    assert there.task.key == part.task.key
    np.testing.assert_array_equal(evaluate_part(there).episodes, here.episodes)
    assert with_files(part, files).task.policy.agent == there.task.policy.agent  # written once
    baseline = first_part(config)
    assert with_files(baseline, policy_files([baseline])) == baseline
