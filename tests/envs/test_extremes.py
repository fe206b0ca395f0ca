"""The corridor at the ends of every range: what it does is defined, finite and bounded."""

import math

import numpy as np
import pytest

from envs.config import CameraConfig, EnvConfig, FaultsConfig, FidelityConfig
from envs.corridor import CorridorEnv
from envs.events.windows import MAX_WINDOW_US
from envs.kinematics import Outcome, clock_us
from envs.scene import BOX, CONE, ELLIPSOID, OBSTACLE, POLE, Scene
from envs.sensor import Sensor
from envs.vehicles.step import step_all
from tests.support.sensing import step_sensor

TINY = CameraConfig(width=8, height=8)
FREE = {"num_obstacles": 0}


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


@pytest.mark.parametrize("control_hz", [0.1, 45.0, 400.0, 12_345.6, 999_999.5, 1e6])
def test_any_control_rate_flies(control_hz):
    env = CorridorEnv(control_hz=control_hz, camera=TINY, time_limit_s=1e3)
    env.reset(seed=1)
    for step in range(1, 6):
        *_, terminated, _, info = check_step(env, step % 3)
        assert info["t_us"] == clock_us(step, control_hz)
        if terminated:
            break


@pytest.mark.parametrize("control_hz", [0.0, -1.0, math.nan, math.inf, 1e-3, 1.000001e6, True, "200"])
def test_a_control_rate_that_cannot_be_is_refused(control_hz):
    with pytest.raises(ValueError, match="control_hz"):
        EnvConfig(control_hz=control_hz)


@pytest.mark.parametrize("threshold", [1e-6, 1e-3, 0.05, 1.0, 10.0])
@pytest.mark.parametrize("memory", ["reference", "frame", "legacy"])
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


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 9), (9, 1), (1280, 720)])
def test_any_size_of_sensor(width, height):
    env = CorridorEnv(camera=CameraConfig(width, height), window_capacity=1_000_000)
    env.reset(seed=0)
    *_, info = check_step(env)
    assert env.luminance.shape == (height, width)
    assert (info["num_events"] > 1000) == (width == 1280)


def test_sensors_of_every_size_share_one_compiled_step():
    """To numba an image of one row or column has a layout of its own, for which it would compile a minute."""
    for width, height in ((8, 8), (1, 1), (1, 8), (8, 1)):
        env = CorridorEnv(camera=CameraConfig(width, height))
        env.reset(seed=0)
        env.step(0)
    assert len(step_all.signatures) == 1


@pytest.mark.parametrize(("count", "width_m"), [(0, 30.0), (10_000, 2000.0)])
def test_any_number_of_obstacles(count, width_m):
    layout = {"num_obstacles": count, "width_m": width_m, "passable": False}
    env = CorridorEnv(layout=layout, camera=TINY)
    env.reset(seed=0)
    assert len(env.scene.obstacles) == count
    for action in range(3):
        check_step(env, action)


@pytest.mark.parametrize("speed_mps", [1e-6, 20.0, 1e3, 1e6])
def test_any_speed_ends_at_the_goal_in_an_empty_lane_or_goes_on(speed_mps):
    env = CorridorEnv(speed_mps=speed_mps, layout=FREE, camera=TINY)
    env.reset(seed=0)
    *_, terminated, _, info = check_step(env)
    assert terminated == info["success"] == (speed_mps / 200.0 >= 100.0)
    assert info["y_m"] == pytest.approx(min(speed_mps / 200.0, 100.0), abs=1e-12)


@pytest.mark.parametrize("start_us", [10 * 3_600_000_000, 10_000_000 * 1_000_000])
def test_events_keep_their_microsecond_after_ten_hours_and_after_ten_million_seconds(start_us):
    env = CorridorEnv()
    env.reset(seed=0)
    env.step(0)
    early = env.events.copy()
    later = Sensor(env.config)
    later.reset(env.scene, (env.camera_pose()[0], 0.0), np.random.default_rng(0), start_us)
    place = env.camera_pose()
    outcome = Outcome((place[0], place[1]), 1.0, 0.0, False, False)
    step_sensor(env.config, later, (place[0], 0.0), outcome, start_us + 5000)
    assert len(early) > 10
    np.testing.assert_array_equal(later.events["t"] - start_us, early["t"])
    np.testing.assert_array_equal(later.events[["x", "y", "p"]], early[["x", "y", "p"]])


@pytest.mark.parametrize("height_m", [0.0, 1e-9, 6.0, 8.0, 20.0, 1000.0])
def test_any_camera_height_sees_something_finite(height_m):
    for scene in ("poles", "gates", "dynamic"):
        env = CorridorEnv(scene=scene, camera_height_m=height_m, camera=TINY, layout={"passable": False})
        env.reset(seed=0)
        for action in range(3):
            *_, terminated, truncated, _ = check_step(env, action)
            if terminated or truncated:
                break


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
    assert reward == -100.0
    assert info["y_m"] == 0.0


@pytest.mark.parametrize("sparsity", [0.0, 1.0])
@pytest.mark.parametrize("activity", [0.0, 10.0])
def test_dead_sensors_stay_silent_whatever_the_noise(sparsity, activity):
    faults = FaultsConfig(sparsity=sparsity, background_activity=activity, background_activity_hz=1e4)
    env = CorridorEnv(camera=TINY, faults=faults)
    env.reset(seed=0)
    *_, info = check_step(env)
    assert (info["num_events"] == 0) == (sparsity == 1.0)


@pytest.mark.parametrize("tolerance", [1e-3, 1.0])
def test_any_tolerance_flies(tolerance):
    env = CorridorEnv(fidelity=FidelityConfig(tolerance), camera=TINY)
    env.reset(seed=0)
    check_step(env)


@pytest.mark.parametrize("tolerance", [0.0, -0.1, 1.1, math.nan, math.inf])
def test_a_tolerance_that_cannot_be_is_refused(tolerance):
    with pytest.raises(ValueError, match="tolerance"):
        FidelityConfig(tolerance=tolerance)


def test_a_bad_frame_is_refused_with_its_place_and_the_next_episode_flies():
    env = CorridorEnv(camera=TINY)
    env.reset(seed=3)
    env._sensor._renderer.frame["sky"] = np.nan
    with pytest.raises(ValueError, match=r"episode 0, step 1, seed 3: luminance must be finite"):
        env.step(0)
    env.reset()
    check_step(env)
