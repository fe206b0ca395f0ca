import dataclasses

import numpy as np
import pytest
from test_runs import small_config

from envs.config import EnvConfig, FaultsConfig
from envs.recordings import read_recording
from jobs import collect
from jobs.collect import FLIGHT_GAP_US, record
from jobs.runs import open_run


def flights(**fields):
    return [(EnvConfig(observation="events", **fields), 900)]


@pytest.fixture(scope="module")
def recording():
    return record(flights(), 0, lambda count: None)


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(recording):
    assert record(flights(), 0, lambda count: None).events.tobytes() == recording.events.tobytes()
    assert record(flights(), 1, lambda count: None).events.tobytes() != recording.events.tobytes()


def test_another_seed_flies_other_corridors(monkeypatch):
    seen = []

    def look(env, rng, most_steps):
        seen.append(env.scene.obstacles.tobytes())
        return [env.events], [5000]

    monkeypatch.setattr(collect, "fly_at_random", look)
    for seed in (0, 1):
        record([(EnvConfig(observation="events"), 3)], seed, lambda count: None)
    assert len(set(seen)) == len(seen) == 6


def test_every_event_lies_in_a_step_and_no_step_spans_two_flights(recording):
    start, end, flight = (recording.index[name] for name in ("step_t_us", "step_end_us", "step_flight"))
    assert len(start) == 900
    assert np.all(end > start)
    same = flight[1:] == flight[:-1]
    assert np.all(start[1:][same] == end[:-1][same])
    assert np.all(start[1:][~same] == end[:-1][~same] + FLIGHT_GAP_US)
    step = np.searchsorted(start, recording.t_us, side="left") - 1
    assert np.all(recording.t_us <= end[step])


def test_events_are_in_time_order_and_on_the_sensor(recording):
    assert np.all(np.diff(recording.t_us) >= 0)
    assert recording.events["x"].max() < 64
    assert len(recording.events) > 900 * 50


def test_splits_share_no_flight(recording):
    other = record(flights(split="validation"), 0, lambda count: None)
    assert other.events.tobytes() != recording.events.tobytes()


def test_the_facts_name_sensor_scenes_and_faults():
    about = record(flights(faults=FaultsConfig(sparsity=0.5)), 4, lambda count: None).about
    assert about["sensor"]["contrast_threshold"] == 0.2
    assert about["scenes"] == ["poles"]
    assert about["faults"][0]["sparsity"] == 0.5
    assert about["seed"] == 4


def test_a_resumed_job_works_with_the_stored_settings(tmp_path):
    stored = open_run(small_config(tmp_path))
    collect.run(dataclasses.replace(small_config(tmp_path), seed=99, resume=str(stored.path)))
    assert read_recording(stored.data / "train.h5").about["seed"] == stored.config.seed
