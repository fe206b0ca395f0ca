import dataclasses

import imageio_ffmpeg
import numpy as np
import pytest

from jobs.analysis.demo_film import write_film
from jobs.analysis.tables import events_texts
from jobs.config.config import ConfigError, parse
from jobs.evaluation import demo
from jobs.rollout.agents import PolicyAgent
from jobs.rollout.executors import Part, evaluate_part
from jobs.rollout.policies import find_policies, with_own_parts
from jobs.rollout.recorded import record_episode
from jobs.rollout.tasks import make_task
from jobs.run.folder import locate_run
from models.policy import load_policy
from tests.support.configs import compose
from tests.support.policies import HELD_OUT, save_training


def demo_config(tmp_path, *words):
    return parse({**compose("+exp=demo", *words), "runs_dir": str(tmp_path / "runs")})


def frames_of(film):
    frames = imageio_ffmpeg.read_frames(str(film))
    about = next(frames)
    return about, [np.frombuffer(frame, np.uint8).reshape(*about["size"][::-1], 3) for frame in frames]


def test_the_printed_line_is_the_evaluations_own_row_and_the_film_shows_every_second_step_and_the_last(
    tmp_path, capsys
):
    name = "bytestream_hold-s0"
    words = ("env.time_limit_s=0.1", "seed=3", "faults.background_activity=0.1", f"demo.policy={name}")
    config = demo_config(tmp_path, *words)
    demo.run(config)
    printed = capsys.readouterr().out
    (policy,) = find_policies("demo.policy", name, config, locate_run(config))
    env = with_own_parts(policy, dataclasses.replace(config.env, split="eval"))
    assert env.filter_support == 1
    task = make_task(("poles_eval", "raycast"), policy, config.evaluate.action, env, 4)
    row = evaluate_part(Part(task)).episodes[3]
    assert row["seed"] == 3
    cells = next(line for line in printed.splitlines() if f" {name} " in line).split("│")[1:-1]
    ended = (name, "poles_eval", "3", "no", "time limit", f"{row['distance_m']:.1f}", str(row["steps"]))
    events = events_texts(row["events_per_step"], row["dropped"])
    assert [cell.strip() for cell in cells] == [*ended, *events, "0.10"]
    (film,) = (tmp_path / "runs").glob("demo-*/demo/*.mp4")
    assert f"Film: {film}" in printed
    about, frames = frames_of(film)
    assert (len(frames), about["fps"]) == (len({*range(0, row["steps"], 2), row["steps"] - 1}), 25.0)


@pytest.mark.parametrize(
    ("words", "speed_mps", "control_hz", "time_limit_s"),
    [
        ((), 10.0, 100.0, 20.0),
        (("env.speed_mps=15.0",), 15.0, 100.0, 10.0),
        (("vehicle=point_mass", "env.speed_mps=20.0"), 20.0, 100.0, 20.0),
    ],
)
def test_another_vehicle_has_the_pace_of_its_training_unless_one_is_asked_for(
    tmp_path, words, speed_mps, control_hz, time_limit_s
):
    _, env, _ = demo.find_shown(demo_config(tmp_path, "demo.policy=body_hold-s0", *words))
    assert env.vehicle == "point_mass"
    assert (env.speed_mps, env.control_hz, env.time_limit_s) == (speed_mps, control_hz, time_limit_s)


def test_the_film_shows_the_way_that_was_taken_and_how_it_ended(tmp_path):
    env = dataclasses.replace(HELD_OUT, time_limit_s=0.1)
    folder = save_training(tmp_path / "policy", "a", 0, HELD_OUT, "bytestream")
    recorded = record_episode(PolicyAgent(load_policy(folder)), env, 0)
    film = write_film(tmp_path / "film.mp4", recorded, "a", lambda window: np.ones((64, 64)))
    _, frames = frames_of(film)
    first, last = frames[0].astype(int), frames[-1].astype(int)
    assert np.abs(first - last).mean() > 0.1
    decoded = last[100:300, 700:1000].mean(axis=(0, 1))
    assert decoded[2] > decoded[0] + 50  # all ON, which is blue


@pytest.mark.parametrize("name", ["moon", "bytestream", "oracle"])
def test_another_name_than_one_policys_is_refused_before_anything_is_written(tmp_path, name):
    rule = rf"demo\.policy: must be one trained policy: .* bytestream-s0, .* rgb-s2, .*got '{name}'"
    with pytest.raises(ConfigError, match=rule):
        demo.run(demo_config(tmp_path, f"demo.policy={name}"))
    assert not (tmp_path / "runs").exists()


def test_a_policy_of_ones_own_with_its_decoder_is_shown_and_another_sensor_is_named(tmp_path, capsys):
    folder = save_training(tmp_path / "policy", "own", 5, HELD_OUT, "bytestream")
    words = ("env.time_limit_s=0.02", "camera.contrast_threshold=0.1", f"demo.policy={folder}")
    demo.run(demo_config(tmp_path, *words))
    printed = capsys.readouterr().out
    assert "Another sensor than in training: contrast_threshold=0.1 (trained: 0.2)" in printed
    assert "own-s5" in printed
    assert "without a decoder" not in printed


def test_a_film_opens_only_for_a_person_at_a_display(monkeypatch, tmp_path):
    started = []
    monkeypatch.setattr(demo.subprocess, "Popen", lambda words, **_: started.append(words))
    monkeypatch.setattr(demo.shutil, "which", lambda name: f"/bin/{name}")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    for display, at_terminal, shown in (("", True, False), (":0", False, False), (":0", True, True)):
        monkeypatch.setenv("DISPLAY", display)
        monkeypatch.setattr(demo.sys.stdout, "isatty", lambda yes=at_terminal: yes, raising=False)
        demo.show(tmp_path)
        assert started == ([["/bin/xdg-open", str(tmp_path)]] if shown else [])
