"""Mains flicker: the light's factor, and the events that it makes in a simulated flight."""

import math

import numpy as np

from envs.config import CameraConfig, EnvConfig, FaultsConfig, hashed_settings
from envs.corridor import CorridorEnv
from envs.event_error import event_error
from envs.events import EventCamera
from envs.events.flicker import NO_FLICKER, Flicker, brightness_at, draw_flicker, looks_needed
from envs.raycast import RaycastRenderer

STEPS, STEP_US, STEP_M = 8, 5000, 0.1


def flown(**fields):
    """The camera's events in `STEPS` steps straight ahead, and the environment."""
    env = CorridorEnv(EnvConfig(observation="events", **fields))
    env.reset(seed=3)
    return np.concatenate([(env.step(0), env.events)[1] for _ in range(STEPS)]), env


def densely(env, flicker, renders=64):
    """The same flight from `renders` whole images a step, each under the light of its time."""
    times = np.arange(STEPS * renders + 1) * STEP_US // renders
    poses = np.zeros((times.size, 5))
    poses[:, 0], poses[:, 2], poses[:, 4] = env.camera_pose()[0], 2.0, times * 1e-6
    poses[:, 1] = np.arange(times.size) * STEP_M / renders
    frames = RaycastRenderer(env.scene, 64, 64, 90.0, 1).render_way(poses)
    lit = [1.0 + flicker.depth * math.sin(2 * math.pi * (flicker.per_us * t + flicker.phase)) for t in times]
    frames = (frames * np.array(lit)[:, None, None]).astype(np.float32)
    camera = EventCamera(env.config.camera)
    camera.reset(frames[0], 0)
    return camera.steps(frames[1:], times[1:].tolist())


def test_the_factor_is_that_of_a_sine():
    times = np.random.default_rng(0).integers(0, 10**9, 10_000)
    for flicker in (Flicker(0.3, 1e-4, 0.7), Flicker(1.0, 1.2e-4, 0.0), Flicker(0.05, 1e-3, 0.999)):
        whole = (times * flicker.per_us + flicker.phase) % 1.0
        expected = 1.0 + flicker.depth * np.sin(2 * np.pi * whole)
        assert np.abs(brightness_at(flicker, times) - expected).max() < 1.2e-7
    assert brightness_at(Flicker(1.0, 1e-4, 0.0), np.array([7500]))[0] >= 0.0


def test_events_under_flicker_are_those_of_many_whole_images():
    events, env = flown(faults=FaultsConfig(flicker_depth=0.3, flicker_hz=120.0))
    truth = densely(env, env._sensor._flicker)
    without = densely(env, NO_FLICKER)
    assert event_error(events, truth, 0.05 * STEP_US) < 0.05
    assert len(truth) > 5 * len(without)


def test_what_is_off_draws_nothing_and_changes_no_byte():
    rng = np.random.default_rng(0)
    for off in (FaultsConfig(), FaultsConfig(flicker_hz=100.0), FaultsConfig(flicker_depth=0.5)):
        assert draw_flicker(off, rng) == NO_FLICKER
    assert rng.random() == np.random.default_rng(0).random()
    assert looks_needed(NO_FLICKER, 5000) == 0


def test_whole_images_see_the_flicker_too_and_a_camera_of_two_frames_sees_it_once_a_step():
    faults = FaultsConfig(flicker_depth=0.3, flicker_hz=100.0)
    slow, env = flown(faults=faults, camera=CameraConfig(refractory_us=1))  # which needs whole images
    assert env._sensor.renders == 8
    fast = flown(faults=faults)[0]
    assert abs(len(slow) - len(fast)) < 0.03 * len(fast)
    assert flown(faults=faults, camera=CameraConfig(memory="frame"))[1]._sensor.renders == 1


def test_faults_that_came_later_leave_older_hashes_as_they_were():
    faults = hashed_settings(EnvConfig())["faults"]
    assert not {name for name in faults if name.startswith(("flicker", "burst")) or name == "dead_block"}
    assert hashed_settings(EnvConfig(faults=FaultsConfig(dead_block=0.1)))["faults"]["dead_block"] == 0.1
