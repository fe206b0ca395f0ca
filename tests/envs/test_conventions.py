"""What clients of Gymnasium expect of an environment: exceptions, copies, autoreset, limits of steps."""

import copy
import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode

from envs.config import CameraConfig, EnvConfig
from envs.corridor import CorridorEnv, CorridorVectorEnv

NAME = "envs.corridor:evade/Corridor-v0"
SMALL = {"camera": {"width": 24, "height": 24}, "observation": "event_image"}


def test_a_mapping_of_fields_is_taken_as_rllib_hands_it_and_an_unknown_field_raises_what_python_does():
    env = CorridorEnv({"observation": "event_image", "scene": "gates"}, control_hz=100.0)
    assert env.config == EnvConfig(observation="event_image", scene="gates", control_hz=100.0)
    for make, fields in (
        (CorridorEnv, {}),
        (CorridorVectorEnv, {}),
        (CorridorEnv, {"config": {"scene": "gates"}}),
    ):
        with pytest.raises(TypeError, match="unexpected keyword argument 'frameskip'"):
            make(**fields, frameskip=1)


def test_integers_of_numpy_are_settings_and_others_are_refused_as_before():
    config = EnvConfig(window_capacity=np.int64(64), camera={"width": np.int32(32), "height": np.uint8(20)})
    assert config == EnvConfig(window_capacity=64, camera=CameraConfig(width=32, height=20))
    assert type(config.camera.width) is int
    assert CameraConfig(np.int64(32), np.int64(32)) == CameraConfig(32, 32)
    for wrong in (np.float64(32.5), "32", True, np.bool_(True)):
        with pytest.raises(ValueError, match="width"):
            CameraConfig(width=wrong)


def test_a_copy_in_mid_episode_goes_on_with_the_same_bytes_and_leaves_the_original_alone():
    env = gymnasium.make(NAME, **SMALL)
    copy.deepcopy(env)  # before the first reset
    env.reset(seed=3)
    for action in (0, 1, 2):
        env.step(action)
    other, before = copy.deepcopy(env), env.unwrapped.info()
    theirs = [other.step(action) for action in (2, 0, 1)]
    assert env.unwrapped.info() == before
    mine = [env.step(action) for action in (2, 0, 1)]
    assert [step[0].tobytes() for step in theirs] == [step[0].tobytes() for step in mine]
    assert [step[1:] for step in theirs] == [step[1:] for step in mine]
    assert other.reset()[0].tobytes() == env.reset()[0].tobytes()
    assert other.unwrapped.series == env.unwrapped.series


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_a_vector_environment_is_copied_with_the_episodes_that_are_over(mode):
    envs = CorridorVectorEnv(3, autoreset_mode=mode, max_episode_steps=4, **SMALL)
    envs.reset(seed=3)
    for _ in range(4):
        truncated = envs.step(np.array([0, 1, 2]))[3]
    assert truncated.all()
    other = pickle.loads(pickle.dumps(envs))
    for _ in range(5):
        theirs, mine = (made.step(np.array([2, 0, 1])) for made in (other, envs))
        assert all(np.array_equal(a, b) for a, b in zip(theirs[:4], mine[:4], strict=True))


def ran(envs, reset_mask):
    """Observations, rewards and truncations of nine steps; episodes are reset by a mask if asked for."""
    steps = [envs.reset(seed=[3, 4])[0]]
    for number in range(9):
        observation, reward, terminated, truncated, info = envs.step(np.array([number % 3, 0]))
        steps += [observation, reward, terminated, truncated]
        for name in ("final_obs", "_final_obs"):
            if name in info:
                steps += [part for part in info[name] if part is not None]
        ended = terminated | truncated
        if reset_mask and ended.any():
            steps.append(envs.reset(options={"reset_mask": ended})[0])
    return steps


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_autoreset_does_as_gymnasium_around_single_environments(mode):
    ours = gymnasium.make_vec(NAME, 2, max_episode_steps=4, autoreset_mode=mode, **SMALL)
    sync = gymnasium.vector.SyncVectorEnv(
        [lambda: gymnasium.make(NAME, max_episode_steps=4, **SMALL)] * 2, autoreset_mode=mode
    )
    assert ours.metadata["autoreset_mode"] is ours.unwrapped.autoreset_mode is mode  # TorchRL reads both
    masked = mode is AutoresetMode.DISABLED
    for mine, theirs in zip(ran(ours, masked), ran(sync, masked), strict=True):
        assert np.array_equal(mine, theirs)


def test_without_autoreset_an_episode_that_is_over_takes_no_step():
    envs = CorridorVectorEnv(2, autoreset_mode=AutoresetMode.DISABLED, max_episode_steps=1, **SMALL)
    envs.reset(seed=0)
    envs.step(np.zeros(2, int))
    with pytest.raises(ResetNeeded):
        envs.step(np.zeros(2, int))
    with pytest.raises(ValueError, match="reset_mask must be bool"):
        envs.reset(options={"reset_mask": np.array([1, 0])})


def test_attributes_and_methods_of_all_environments_are_read_and_called():
    envs = CorridorVectorEnv(2, **SMALL)
    envs.reset(seed=[5, 6])
    assert envs.np_random_seed == (5, 6)
    assert envs.get_attr("series") == ((5, 0), (6, 0))
    assert [info["t_us"] for info in envs.call("info")] == [0, 0]
    envs.set_attr("note", [1, 2])
    assert envs.get_attr("note") == (1, 2)
    for wrong in (np.array([[0], [1]]), 1):
        with pytest.raises(ValueError, match=r"actions must .* shape"):
            envs.step(wrong)
