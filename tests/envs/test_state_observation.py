"""The wrapper that shows velocity and last command beside the events."""

import gymnasium
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.utils.env_checker import check_env as check_gymnasium
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_checker import check_env as check_sb3

from envs.config import CameraConfig
from envs.corridor import CorridorEnv
from envs.state_observation import StateObservation

WORLD = {"camera": CameraConfig(width=36, height=36), "observation": "event_image", "time_limit_s": 0.1}
BODY = {"vehicle": "point_mass", "speed_mps": 10.0, "control_hz": 100.0}


def make(**settings):
    return StateObservation(CorridorEnv(**{**WORLD, **BODY, **settings}))


def test_the_state_is_velocity_and_last_command():
    env = make()
    shown, _ = env.reset(seed=0)
    assert shown["state"].tolist() == [0.0, 10.0, 0.0, 0.0]
    shown, *_ = env.step(np.array([0.5, 0.25], np.float32))
    assert shown["state"][2:].tolist() == [0.5, 0.25]
    assert shown["state"][0] == pytest.approx(15.0 * 0.01, rel=0.02)  # at the limit of acceleration
    assert shown in env.observation_space
    assert np.array_equal(shown["events"], env.corridor.observe())


def test_a_kinematic_vehicle_has_the_velocity_of_its_step():
    env = make(vehicle="kinematic", speed_mps=20.0)
    assert env.reset(seed=0)[0]["state"].tolist() == [0.0, 0.0, -1.0]
    shown = env.step(1)[0]["state"]
    assert shown == pytest.approx([-20.0 * np.sqrt(0.5), 20.0 * np.sqrt(0.5), 1.0], rel=1e-6)


def test_noise_has_its_size_and_depends_on_the_episode_alone():
    env = make(velocity_noise_mps=0.3, time_limit_s=10.0)
    ahead = np.array([0.0, 1.0 / 3.0], np.float32)

    def states():
        env.reset(seed=4)
        return np.array([env.step(ahead)[0]["state"] for _ in range(100)])

    first = states()
    assert np.array_equal(first, states())
    assert np.std(first[:, 0]) == pytest.approx(0.3, rel=0.2)


def test_checkers_and_learners_of_other_libraries_take_it():
    check_gymnasium(make(), skip_render_check=True)
    check_sb3(make())
    PPO("MultiInputPolicy", make(), n_steps=16, batch_size=8, n_epochs=1, device="cpu").learn(16)
    SAC("MultiInputPolicy", make(), buffer_size=64, learning_starts=8, batch_size=8, device="cpu").learn(16)


def test_the_wrappers_of_cleanrl_for_continuous_actions_take_a_vector_of_it():
    def wrapped():
        env = wrappers.ClipAction(wrappers.RecordEpisodeStatistics(wrappers.FlattenObservation(make())))
        return wrappers.NormalizeReward(wrappers.NormalizeObservation(env), gamma=0.99)

    envs = gymnasium.vector.SyncVectorEnv([wrapped] * 2)
    shown, _ = envs.reset(seed=0)
    assert shown.shape == (2, 36 * 36 + 4)
    ended = 0
    for _ in range(12):  # of 10 steps, and beyond the limits of the commands
        shown, rewards, _, truncated, infos = envs.step(np.full((2, 2), 3.0, np.float32))
        ended += int(truncated.sum())
        assert np.isfinite(shown).all()
        assert np.isfinite(rewards).all()
        assert ("episode" in infos) == truncated.any()
    assert ended == 2
