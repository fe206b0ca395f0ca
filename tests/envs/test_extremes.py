"""The corridor at the ends of every range: what it does is defined, finite and bounded."""

import math

import numpy as np
import pytest

from envs.config import CameraConfig, FaultsConfig
from envs.corridor import CorridorEnv
from envs.events.windows import MAX_WINDOW_US
from envs.kinematics import Outcome, clock_us
from envs.scene import BOX, CONE, ELLIPSOID, OBSTACLE, POLE, Scene
from envs.sensor import Sensor
from envs.vehicles.step import step_all
from tests.support.sensing import step_sensor

TINY = CameraConfig(width=8, height=8)


def check_step(env, action=0):
    """One step, with the laws that hold for every step."""
    window, reward, terminated, truncated, info = env.step(action)
    count, dropped, window_us = window[0, :3]
    assert math.isfinite(reward)
    assert not (terminated and truncated)
    assert 0 <= count <= env.config.window_capacity
    assert 0 < window_us <= MAX_WINDOW_US
    assert info["dropped_events"] >= dropped >= 0
    times = env.events["t"]
    assert (np.diff(times) >= 0).all()
    assert np.isfinite(env.luminance).all()
    assert (env.luminance >= 0).all()
    assert (env.events["x"] < env.config.camera.width).all()
    assert (env.events["y"] < env.config.camera.height).all()
    return window, reward, terminated, truncated, info


@pytest.mark.parametrize(
    "settings",
    [
        *[{"control_hz": hz, "time_limit_s": 1e3} for hz in (0.1, 12_345.6, 1e6)],
        *[{"fidelity": {"tolerance": tolerance}} for tolerance in (1e-3, 1.0)],
        *[{"camera_height_m": m, "scene": "gates"} for m in (0.0, 8.0, 1000.0)],
        {"camera_height_m": 1000.0, "scene": "dynamic", "layout": {"passable": False}},
        {"layout": {"num_obstacles": 0}},
        {"layout": {"num_obstacles": 10_000, "width_m": 2000.0, "passable": False}},
    ],
)
def test_the_ends_of_ranges_fly(settings):
    env = CorridorEnv(camera=TINY, **settings)
    env.reset(seed=1)
    for step in range(1, 4):
        *_, terminated, truncated, info = check_step(env, step % 3)
        assert info["t_us"] == clock_us(step, env.config.control_hz)
        if terminated or truncated:
            break


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[("control_hz", hz) for hz in (0.0, math.nan, 1.000001e6, True, "200")],
        *[("action_delay_ms", delay_ms) for delay_ms in (-5.0, 1000.1)],
        ("fidelity", {"tolerance": 0.0}),
        ("scene", "moon"),
        ("render_mode", "human"),
    ],
)
def test_settings_that_make_no_sense_are_refused(name, value):
    with pytest.raises(ValueError, match=f"{name}|{value}|tolerance"):
        CorridorEnv(**{name: value}).reset(seed=0)


@pytest.mark.parametrize("threshold", [1e-6, 0.05, 10.0])
@pytest.mark.parametrize("memory", ["reference", "legacy"])
def test_any_threshold_gives_a_bounded_window_and_counts_what_it_lost(threshold, memory):
    camera = CameraConfig(16, 16, contrast_threshold=threshold, memory=memory)
    env = CorridorEnv(camera=camera, window_capacity=512)
    env.reset(seed=0)
    lost = found = 0
    for _ in range(3):
        window, *_, info = check_step(env)
        lost, found = lost + info["dropped_events"], found + int(window[0, 0])
    assert (lost > 1000) == (threshold == 1e-6)
    assert (found > 0) == (threshold <= 0.05) or (memory != "reference" and threshold == 0.05)


def test_any_size_of_sensor_flies_by_one_compiled_step():
    """To numba an image of one row or column has a layout of its own, for which it would compile a minute."""
    for width, height in ((1, 1), (1, 9), (9, 1), (1280, 720)):
        env = CorridorEnv(camera=CameraConfig(width, height), window_capacity=1_000_000)
        env.reset(seed=0)
        *_, info = check_step(env)
        assert env.luminance.shape == (height, width)
        assert (info["num_events"] > 1000) == (width == 1280)
    assert len(step_all.signatures) == 1


@pytest.mark.parametrize("speed_mps", [1e-6, 1e6])
def test_any_speed_ends_at_the_goal_in_an_empty_lane_or_goes_on(speed_mps):
    env = CorridorEnv(speed_mps=speed_mps, layout={"num_obstacles": 0}, camera=TINY)
    env.reset(seed=0)
    *_, terminated, _, info = check_step(env)
    assert terminated == info["success"] == (speed_mps / 200.0 >= 100.0)
    assert info["y_m"] == pytest.approx(min(speed_mps / 200.0, 100.0), abs=1e-12)


def test_events_keep_their_microsecond_after_ten_million_seconds():
    env, start_us = CorridorEnv(), 10_000_000 * 1_000_000
    env.reset(seed=0)
    env.step(0)
    early = env.events.copy()
    later = Sensor(env.config)
    later.reset(env.scene, (env.camera_pose()[0], 0.0), np.random.default_rng(0), start_us)
    place = env.camera_pose()
    outcome = Outcome(place[:2], 1.0, 0.0, False, False)
    step_sensor(env.config, later, (place[0], 0.0), outcome, start_us + 5000)
    assert len(early) > 10
    np.testing.assert_array_equal(later.events["t"] - start_us, early["t"])
    np.testing.assert_array_equal(later.events[["x", "y", "p"]], early[["x", "y", "p"]])


@pytest.mark.parametrize("kind", [POLE, CONE, ELLIPSOID, BOX])
def test_a_spawn_inside_an_obstacle_is_a_collision_at_the_first_step(monkeypatch, kind):
    obstacle = np.array([(kind, 0.0, 0.0, 2.0, 1.0, 1.0, 2.0, 0.5)], OBSTACLE)
    scene = Scene("hand", obstacle, spawn_range_m=(0.0, 0.0))
    monkeypatch.setattr("envs.corridor.make_scene", lambda *_, **__: scene)
    env = CorridorEnv(camera=TINY)
    env.reset(seed=0)
    _, reward, terminated, _, info = check_step(env)
    assert terminated
    assert info["collision"]
    assert not info["success"]
    assert (reward, info["y_m"]) == (-100.0, 0.0)


@pytest.mark.parametrize("sparsity", [0.0, 1.0])
def test_dead_sensors_stay_silent_whatever_the_noise(sparsity):
    faults = FaultsConfig(sparsity=sparsity, background_activity=10.0, background_activity_hz=1e4)
    env = CorridorEnv(camera=TINY, faults=faults)
    env.reset(seed=0)
    *_, info = check_step(env)
    assert (info["num_events"] == 0) == (sparsity == 1.0)
