import dataclasses

import numpy as np
import pytest

from envs.config import CameraConfig, EnvConfig
from envs.events import EVENT
from envs.recordings import read_recording, write_events
from jobs.config.config import ConfigError
from jobs.config.schema import RecordingConfig
from jobs.run.folder import open_run
from jobs.training import collect
from jobs.training.pretrain import _window_by_count, _window_by_time
from jobs.training.real_recordings import GAP_US, cropped, no_episodes, read_recorded, with_recorded
from tests.support.configs import small_config

ENV = EnvConfig(observation="events")
SELF_CONTAINED = RecordingConfig()  # for a file that states everything itself


def bright_bar(seconds=1.0, width=128, height=100, start_us=10**9):
    """Every pixel of a column brightens at once, a column every millisecond, from left to right and again."""
    columns = np.arange(int(seconds * 1000))
    events = np.zeros((columns.size, height), EVENT)
    events["t"] = start_us + 1000 * columns[:, None]
    events["x"], events["y"], events["p"] = (columns % width)[:, None], np.arange(height), 1
    return events.ravel()


@pytest.fixture
def bar(tmp_path):
    """The file of a second of it."""
    write_events(tmp_path / "bar.npz", bright_bar(), 128, 100)
    return tmp_path / "bar.npz"


def test_of_a_picture_the_middle_with_the_cameras_proportions_stays():
    events = bright_bar(0.128)
    kept, shape = cropped(events, (100, 128), CameraConfig(width=64, height=64))
    assert shape == (100, 100)
    assert (kept["x"].min(), kept["x"].max(), kept.size) == (0, 99, 100 * 100)
    assert np.array_equal(
        np.unique(events["t"][(events["x"] >= 14) & (events["x"] < 114)]), np.unique(kept["t"])
    )
    wide, shape = cropped(events, (100, 128), CameraConfig(width=64, height=25))
    assert shape == (50, 128)
    assert wide["y"].max() == 49


@pytest.mark.parametrize("control_hz", [200.0, 45.0])
def test_no_time_is_lost_and_none_is_in_both_parts(bar, control_hz):
    env = dataclasses.replace(ENV, control_hz=control_hz)
    parts = read_recorded(bar, env, 0.25, SELF_CONTAINED)
    train, validation = parts["train"], parts["validation"]
    steps = int(0.999 * control_hz)
    assert len(train.ends_us) == round(0.75 * steps)
    assert len(train.ends_us) + len(validation.ends_us) == steps
    for part in parts.values():
        assert (part.events["t"] > 0).all()
        assert part.events["t"].max() <= part.ends_us[-1]
        assert part.events["x"].max() == part.events["y"].max() == 63
    whole = read_recorded(bar, env, 1.5 / steps, SELF_CONTAINED)["train"].events.size
    assert train.events.size + validation.events.size == pytest.approx(whole, abs=2 * 64 * 64)


def test_parts_follow_a_recording_as_flights_of_its_own(bar):
    part = read_recorded(bar, ENV, 0.5, SELF_CONTAINED)["train"]
    (flown,) = collect.record([(ENV, 60)], 0, lambda count: None)
    joined = with_recorded(flown, [(part, 20), (part, 10**6)])
    start, end, flight = (joined.index[name] for name in ("step_t_us", "step_end_us", "step_flight"))
    assert len(start) == 60 + 20 + len(part.ends_us)
    assert joined.about["flights"] == flown.about["flights"] + 2 == flight[-1] + 1
    assert joined.about["recordings"] == ["bar.npz", "bar.npz"]
    assert joined.about["sensor"] == flown.about["sensor"]
    np.testing.assert_array_equal(joined.events[: len(flown.events)], flown.events)
    assert (np.diff(joined.events["t"]) >= 0).all()
    changes = np.flatnonzero(np.diff(flight))
    np.testing.assert_array_equal(start[changes + 1] - end[changes], GAP_US)
    step = np.searchsorted(start, joined.events["t"], side="left") - 1
    assert (joined.events["t"] <= end[step]).all()


def test_windows_are_drawn_from_recordings_alone(bar):
    part = read_recorded(bar, ENV, 0.5, SELF_CONTAINED)["train"]
    recording, rng = with_recorded(no_episodes(ENV), [(part, 100)]), np.random.default_rng(0)
    for draw in (_window_by_count, _window_by_time):
        for _ in range(20):
            events, start_us, window_us = draw(recording, 500, rng)
            assert events.size <= 500
            assert ((events["t"] > start_us - 1) & (events["t"] <= start_us + window_us)).all()


def collecting(tmp_path, path):
    config = small_config(tmp_path)
    changes = {"recordings": [str(path)], "num_steps": 60, "num_validation_steps": 20, "scenes": ["poles"]}
    settings = dataclasses.replace(config.collect, **changes)
    return dataclasses.replace(config, collect=settings)


def test_a_data_set_holds_equal_shares_of_flights_and_recordings(tmp_path, bar):
    config = collecting(tmp_path, bar)
    collect.run(config)
    for split, steps in (("train", 60), ("validation", 20)):
        recording = read_recording(open_run(config).data / f"{split}.h5")
        own = recording.index["step_flight"] == recording.index["step_flight"][-1]
        assert (own.sum(), (~own).sum()) == (steps // 2, steps // 2)
        assert recording.about["recordings"] == ["bar.npz"]


def test_what_cannot_be_taken_is_refused_before_anything_is_made(tmp_path):
    write_events(tmp_path / "short.npz", bright_bar(0.01), 128, 100)
    write_events(tmp_path / "small.npz", bright_bar(0.1, height=63), 128, 63)
    (tmp_path / "plain.txt").write_text("t_us,x,y,p\n1,2,3,1\n")
    for name, words in (
        ("gone.raw", "gone.raw"),
        ("short.npz", "must last at least 0.02 s, got"),
        ("small.npz", "at least 64x64 pixels, got 128x63"),
        ("plain.txt", "does not say its sensor's size"),
    ):
        with pytest.raises(ConfigError, match=rf"collect.recordings: .*{words}"):
            collect.run(collecting(tmp_path, tmp_path / name))
    assert not (tmp_path / "runs").exists()
