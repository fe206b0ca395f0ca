import dataclasses
import functools
import os
import pickle
import shutil
import signal
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from jobs.rollout import tune_executor
from jobs.rollout.executors import Part, Recorder, evaluate_part
from jobs.rollout.scheduler import plan_parts
from jobs.rollout.store import EpisodeStore
from jobs.rollout.tasks import split
from jobs.rollout.tune_executor import (
    BATCHES_PER_CORE,
    MAX_FAILURES,
    MAX_ROWS,
    UNKNOWN_END,
    TrialCallback,
    batches_of,
    policy_files,
    run_trial,
    run_with_tune,
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
def part(tmp_path):
    return first_part(sweep_config(tmp_path))


@pytest.fixture
def recorder(tmp_path):
    return Recorder(EpisodeStore(tmp_path / "sweep"), lambda count, note: None)


@pytest.fixture
def tell(part, recorder):
    """Tell the callback what happens to the trial of the part."""
    trial = SimpleNamespace(config={"trial": {"batch": (part,)}}, error_file=None)

    def tell(what, *result, error_file=None):
        trial.error_file = error_file
        getattr(tell.callback, f"on_trial_{what}")(1, [], trial, *result)

    tell.callback = TrialCallback(recorder)
    return tell


def test_a_part_whose_process_ends_is_counted_and_its_restarts_are_stored(part, tell, recorder, tmp_path):
    for _ in range(2):
        tell("start")
        tell("recover")
    assert recorder.reason(part) == f"its process ended ({UNKNOWN_END}) 2 times"
    tell("result", {"outcomes": [made_up(part)]})
    assert EpisodeStore(tmp_path / "sweep").result(part.task).restarts == 2


def test_a_part_that_ends_after_its_limit_is_said_to_be_late(part, tell, recorder, monkeypatch, capsys):
    monkeypatch.setattr(tune_executor, "MAX_START_S", 0.0)
    monkeypatch.setattr(tune_executor, "MAX_FAILURES", 0)
    tell("start")
    tell("error")
    assert recorder.reason(part) == f"its process ended ({UNKNOWN_END}) 1 times"
    monkeypatch.setattr(tune_executor, "MAX_STEP_S", 0.0)
    tell("start")
    tell("error")
    assert recorder.reason(part) == "its process ended (it may take 0 s) 2 times"
    assert f"given up: {part.task.name}" in capsys.readouterr().out


def test_a_longer_part_may_take_longer(part, tmp_path):
    longer = first_part(sweep_config(tmp_path, trials=9))
    assert 900 < time_limit_s((part,)) < time_limit_s((longer,)) < time_limit_s((part, longer)) < 1800


def test_a_part_that_ray_ended_for_lack_of_memory_says_so(part, tell, recorder, tmp_path):
    errors, begin = tmp_path / "error.txt", "Failure # {} (occurred at 2026-01-31_23-59-59)\n"
    low = (
        "1 worker(s) were killed due to the node running low on memory. Memory on the node (IP: 127.0.0.1, "
        "ID: d3) was 6.76GB used / 23.54GB limit (0.287376)\nOOM kill reason: Memory usage exceeded\n"
    )
    errors.write_text(begin.format(1) + low)
    tell("recover", error_file=str(errors))
    reason = "its process ended (by Ray, for lack of memory: 6.76GB of 23.54GB in use) 1 times"
    assert recorder.reason(part) == reason
    errors.write_text(begin.format(1) + low + begin.format(2) + "The actor died unexpectedly.\n")
    tell("error", error_file=str(errors))
    assert recorder.reason(part) == f"its process ended ({UNKNOWN_END}) 2 times"


def test_a_part_that_tune_gives_up_too_early_is_tried_again(part, tell, capsys):
    for left in [[(part,)]] * MAX_FAILURES + [[]]:
        tell("error")
        assert tell.callback.take_unfinished() == left
        assert ("tried again" if left else "given up") in capsys.readouterr().out


def test_a_batch_that_ends_its_process_is_tried_part_by_part(tmp_path, recorder):
    batch = first_part(sweep_config(tmp_path)), first_part(sweep_config(tmp_path, trials=1), "random")
    callback = TrialCallback(recorder)
    trial = SimpleNamespace(config={"trial": {"batch": batch}}, error_file=None)
    callback.on_trial_error(1, [], trial)
    assert callback.take_unfinished() == [(part,) for part in batch]
    assert all("its process ended" in recorder.reason(part) for part in batch)


def test_the_end_of_a_process_counts_once_for_a_task(tmp_path, recorder):
    config = sweep_config(tmp_path, trials=24)
    batch = tuple(map(Part, split(planned(config, "straight").tasks[0])))
    callback, trial = (
        TrialCallback(recorder),
        SimpleNamespace(config={"trial": {"batch": batch}}, error_file=None),
    )
    callback.on_trial_error(1, [], trial)
    callback.on_trial_result(1, [], trial, {"outcomes": list(map(made_up, batch))})
    assert len(batch) == 3
    assert EpisodeStore(tmp_path / "sweep").result(planned(config, "straight").tasks[0]).restarts == 1


@pytest.mark.system
def test_a_batch_of_which_one_part_ends_its_process_leaves_the_episodes_of_each_alone(
    tmp_path, recorder, monkeypatch
):
    config, store = (
        sweep_config(tmp_path, axes={"rate": {"env.control_hz": [50, 70, 90]}}),
        EpisodeStore(tmp_path / "sweep"),
    )
    parts = plan_parts(planned(config, "random").tasks, store, False)
    ended = []
    monkeypatch.setattr(tune_executor, "batches_of", lambda some, cores: [tuple(some[:2]), tuple(some[2:])])
    monkeypatch.setattr(recorder, "lose", lambda part, *said: ended.append((part.task.key, said[1])))
    first = parts[0].task.key
    monkeypatch.setattr(
        tune_executor, "run_trial", functools.partial(run_until, first, tmp_path / "was there")
    )
    run_with_tune(parts, recorder, config.cluster, tmp_path / "run")
    for part in parts:
        assert store.result(part.task).episodes.tobytes() == evaluate_part(part).episodes.tobytes()
    assert {(part.task.key, "each part tried alone") for part in parts[:2]} == set(ended)


def run_until(key, mark, params, files):
    """Kill the process of the first batch that contains a task."""
    if any(part.task.key == key for part in params["trial"]["batch"]) and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    run_trial(params, files)


def test_batches_hold_every_part_once_and_only_what_one_call_can_step(tmp_path):
    task = first_part(sweep_config(tmp_path, trials=7)).task
    small = dataclasses.replace(task.env.camera, width=32)
    settings = [{"control_hz": 45.0}, {"camera": small}, {"renderer": "pyrender"}, {"action_delay_ms": 50.0}]
    tasks = [task, *(dataclasses.replace(task, env=dataclasses.replace(task.env, **one)) for one in settings)]
    parts = [Part(dataclasses.replace(one, key=f"{k} {n}")) for k in range(80) for n, one in enumerate(tasks)]
    batches = batches_of(parts, 4)
    assert sorted(p.task.part_id for batch in batches for p in batch) == sorted(p.task.part_id for p in parts)
    assert len(batches) >= 4 * BATCHES_PER_CORE
    for batch in batches:
        assert len({part.task.env.camera.width for part in batch}) == 1
        assert len(batch) == 1 or all(part.task.env.renderer != "pyrender" for part in batch)
    rows = [sum(len(part.task.seeds) for part in batch) for batch in batches]
    assert MAX_ROWS - 7 < max(rows) <= MAX_ROWS
    assert all(len(batch) == 1 for batch in batches_of(parts[:9], 4))


def test_the_reason_that_a_part_gave_comes_before_the_end_of_its_process(part, tell, recorder):
    tell("result", {"outcomes": ["ValueError: no"]})
    tell("error")
    assert recorder.reason(part) == "ValueError: no"
    assert isinstance(pickle.loads(pickle.dumps(tell.callback)), TrialCallback)  # without its recorder


def test_a_worker_evaluates_the_policy_of_the_driver_though_it_cannot_see_its_folder(tmp_path, part):
    config = sweep_config(tmp_path)
    path = Path(save_training(tmp_path / "policy", "a", 0, config.env))
    trained = first_part(config, str(path))
    here, files = evaluate_part(trained), policy_files([trained])
    shutil.rmtree(path)
    there = with_files(trained, files)
    assert there.task.policy.agent != trained.task.policy.agent
    assert there.task.key == trained.task.key
    np.testing.assert_array_equal(evaluate_part(there).episodes, here.episodes)
    assert with_files(trained, files).task.policy.agent == there.task.policy.agent  # written once
    assert with_files(part, policy_files([part])) == part  # a baseline has no files
