import csv
import os
from pathlib import Path

import numpy as np
import pytest

from envs.config import EnvConfig
from envs.corridor import CorridorEnv
from envs.events import EVENT, pack_window
from envs.recordings import write_events
from jobs.config.config import ConfigError, parse
from jobs.tools import replay as recording_replay
from models.policy import load_policy
from tests.support.configs import compose
from tests.support.event_files import some_events

ROOT = Path(__file__).resolve().parents[3]
POLICY = ROOT / "models" / "pretrained" / "bytestream-s0"
SLIDER = Path(os.environ.get("EVADE_DATA", ROOT.parent / "shared" / "data")) / "rpg_slider_depth"


def replayed(tmp_path, recording, **replay):
    words = [f"replay.{name}={value}" for name, value in {"policy": POLICY, **replay}.items()]
    words += [f"replay.recording={recording}", f"runs_dir={tmp_path / 'runs'}"]
    return recording_replay.run(parse(compose("+exp=replay", *words)))


def simulated(steps=6):
    """The events of an episode straight ahead."""
    env = CorridorEnv(EnvConfig(window_capacity=None))
    env.reset(seed=3)
    return np.concatenate([(env.step(0), env.events)[1] for _ in range(steps)])


def test_a_recording_of_the_simulator_is_seen_as_its_windows_are_and_left_in_table_and_film(tmp_path):
    events = simulated()
    write_events(tmp_path / "episode.h5", events, 64, 64)
    choices = replayed(tmp_path, tmp_path / "episode.h5")
    (table,) = (tmp_path / "runs").glob("*/replay/choices.csv")
    rows = list(csv.DictReader(table.open()))
    assert [int(row["events"]) for row in rows] == [choice.events.size for choice in choices]
    assert float(rows[0]["forward"]) == pytest.approx(choices[0].probabilities[0], abs=1e-4)
    assert table.with_name("replay.mp4").stat().st_size > 1000
    policy, begin = load_policy(POLICY), int(events["t"][0]) - 1
    policy.reset()
    assert len(choices) == (events["t"][-1] - begin) // 5000
    for step, choice in enumerate(choices):
        start = begin + 5000 * step
        inside = events[(events["t"] > start) & (events["t"] <= start + 5000)]
        logits = policy.logits(pack_window(inside, start, 5000, 10_000)[None])[0].astype(np.float64)
        odds = np.exp(logits - logits.max())
        assert choice.events.size == inside.size
        assert choice.probabilities == pytest.approx(odds / odds.sum(), abs=1e-6)


@pytest.mark.skipif(not SLIDER.is_dir(), reason=f"no recording in {SLIDER}; set EVADE_DATA")
def test_a_real_recording_is_read_downscaled_and_chosen_on(tmp_path):
    t, x, y, p = np.loadtxt(SLIDER / "events_chunk.txt").T
    events = np.empty(t.size, EVENT)
    events["t"], events["x"], events["y"], events["p"] = np.rint(t * 1e6), x, y, 2 * p - 1
    file = tmp_path / "slider.h5"
    write_events(file, events, 240, 180)
    choices = replayed(tmp_path, file)
    assert len(choices) == 34
    assert all(choice.probabilities.sum() == pytest.approx(1.0) for choice in choices)
    assert np.mean([choice.events.size for choice in choices]) > 50


def test_a_policy_without_events_and_a_file_without_any_are_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"replay\.policy: must see events"):
        replayed(tmp_path, tmp_path / "none.h5", policy=ROOT / "models" / "pretrained" / "rgb-s0")
    with pytest.raises(ConfigError, match=r"replay\.recording: "):
        replayed(tmp_path, tmp_path / "none.h5")
    write_events(tmp_path / "empty.npz", simulated()[:0], 64, 64)
    with pytest.raises(ConfigError, match="contains 0 events; name another file"):
        replayed(tmp_path, tmp_path / "empty.npz")


def test_a_scattered_recording_gives_steps_without_events_and_a_word_about_its_rate(tmp_path, capsys):
    few = some_events(0, 4000, 640, 480, 200_000)  # fewer in each block of pixels than it has pixels
    write_events(tmp_path / "few.raw", few, 640, 480)
    choices = replayed(tmp_path, tmp_path / "few.raw")
    assert sum(choice.events.size for choice in choices) == 0
    assert len(choices) == 39
    said = capsys.readouterr().out
    assert "The recording has 0.0 events a control step, and the policy was trained with about" in said


def test_the_gap_of_a_recording_is_closed_and_told(tmp_path, capsys):
    events = simulated()
    late = events.copy()
    late["t"] += 3_000_000_000
    write_events(tmp_path / "gap.npz", np.concatenate((events, late)), 64, 64)
    assert 11 <= len(replayed(tmp_path, tmp_path / "gap.npz")) <= 13
    said = capsys.readouterr().out
    assert "1 gaps, 3,000.0 s together, are closed" in said.replace("2,999.9", "3,000.0")
