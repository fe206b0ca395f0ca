"""Every command reads recordings by the same keys, and every remedy that a refusal names works."""

import re

import h5py
import numpy as np
import pytest

from envs.config import CameraConfig, EnvConfig
from envs.recordings import write_events
from jobs.config.config import ConfigError, parse
from jobs.config.schema import RecordingConfig
from jobs.run.recordings import read_recording, recording_parts, refusing
from jobs.training.real_recordings import fit
from tests.support.configs import compose
from tests.support.event_files import some_events

ENV = EnvConfig(camera=CameraConfig(width=16, height=12))


def settings(*words: str) -> RecordingConfig:
    """The settings of a command line."""
    return parse(compose("+exp=replay", *words)).recording


def test_bare_rows_of_the_event_camera_dataset_need_only_the_size(tmp_path):
    events, path = some_events(0, 50, 64, 48, 900_000), tmp_path / "events.txt"
    path.write_text("".join(f"{t / 1e6:.6f} {x} {y} {int(p > 0)}\n" for t, x, y, p in events.tolist()))
    named = r"give width and height.* \(as recording\.width=WIDTH recording\.height=HEIGHT\)$"
    with pytest.raises(ConfigError, match=named), refusing("replay.recording", path):
        fit(path, ENV, settings())
    sized = settings("recording.width=64", "recording.height=48")
    assert fit(path, ENV, sized).num_events == 50


def test_a_refusal_names_keys_and_the_command_with_them_reads_the_file(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("1000,3,4,1\n2000,5,6,0\n")
    with pytest.raises(ConfigError, match="columns") as caught, refusing("x", path):
        read_recording(path, settings())
    named = re.findall(r"recording\.(\w+)=", str(caught.value))
    assert named == ["columns", "time_unit"]
    words = ["recording.columns=[t,x,y,p]", "recording.time_unit=us"]
    assert read_recording(path, settings(*words)).events["x"].tolist() == [3, 5]


def test_a_group_and_a_range_of_times_are_keys_too(tmp_path, capsys):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for side, scale in (("left", 1), ("right", 2)):
            for name in "txy":
                file[f"prophesee/{side}/{name}"] = scale * np.arange(4)
            file[f"prophesee/{side}/p"] = [0, 1, 0, 1]
    read_recording(tmp_path / "a.h5", settings())
    assert "recording.group chooses another of prophesee/left, prophesee/right" in capsys.readouterr().out
    right = settings("recording.group=prophesee/right", "recording.start_us=2", "recording.end_us=6")
    assert read_recording(tmp_path / "a.h5", right).events["t"].tolist() == [2, 4]


def test_damage_is_printed_and_refused_if_the_command_says_so(tmp_path, capsys):
    write_events(tmp_path / "a.dat", some_events(0, 50, 64, 48, 1000), 64, 48)
    with (tmp_path / "a.dat").open("ab") as file:
        file.write(b"abc")
    assert sum(len(part.events) for part in recording_parts(tmp_path / "a.dat", settings())) == 50
    assert "recording.strict=true refuses such a file" in capsys.readouterr().out
    with pytest.raises(ValueError, match="read it without strict"):
        read_recording(tmp_path / "a.dat", settings("recording.strict=true"))


def test_too_many_events_are_refused_and_a_part_is_read(tmp_path):
    events = some_events(0, 50, 64, 48, 1000)
    write_events(tmp_path / "a.dat", events, 64, 48)
    for read in (read_recording, lambda *words: list(recording_parts(*words))):
        with pytest.raises(ValueError, match="max_events=9"):
            read(tmp_path / "a.dat", settings("recording.max_events=9"))
    fewer = settings("recording.max_events=49", "recording.start_us=500")
    assert len(read_recording(tmp_path / "a.dat", fewer).events) == np.sum(events["t"] >= 500)


def test_gaps_are_closed_and_the_steps_are_those_of_the_events(tmp_path):
    events = some_events(1, 4000, 64, 48, 400_000)
    late = events.copy()
    late["t"] += 3_000_000_000
    write_events(tmp_path / "a.npz", np.concatenate((events, late)), 64, 48)
    fitted = fit(tmp_path / "a.npz", ENV, RecordingConfig())
    assert fitted.gaps == 1
    assert fitted.steps == pytest.approx(2 * 80, abs=2)
    assert np.all(np.diff(fitted.events["t"]) >= 0)
    assert fitted.events["t"][-1] < 900_000
