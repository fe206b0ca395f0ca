"""Gymnasium's wrappers, stable-baselines3 and CleanRL's loop run the corridor as they come."""

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import FrameStackObservation, RecordEpisodeStatistics, RenderCollection
from gymnasium.wrappers.vector import RecordEpisodeStatistics as RecordVectorStatistics
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack

from envs.config import CameraConfig
from envs.corridor import CorridorEnv, CorridorVectorEnv, Info

NAME = "envs.corridor:evade/Corridor-v0"
STEPS = 10  # of an episode, which ends by its time limit
WORLD = {"camera": CameraConfig(width=16, height=16), "window_capacity": 32, "time_limit_s": STEPS / 200.0}
GYMNASIUM_KEYS = {"episode", "final_obs", "final_info", "final_observation"}
SB3_KEYS = {"episode", "TimeLimit.truncated", "terminal_observation"}


def make(**settings):
    return gymnasium.make(NAME, **WORLD, **settings)


def run_episode(env, seed=0):
    """Reset and step forward to the end: the observations, the rewards, and the last info."""
    observation, info = env.reset(seed=seed)
    observations, rewards, over = [observation], [], False
    while not over:
        observation, reward, terminated, truncated, info = env.step(0)
        observations.append(observation)
        rewards.append(reward)
        over = terminated or truncated
    return observations, rewards, info


def statistics_of(info):
    """Take the statistics out of an info; the rest must be what the corridor alone gives."""
    statistics = info.pop("episode")
    assert info == run_episode(CorridorEnv(**WORLD))[2]
    return statistics


def test_no_key_of_info_is_reserved():
    single, vector = CorridorEnv(**WORLD), CorridorVectorEnv(2, **WORLD)
    infos = [single.reset(seed=0)[1], vector.reset(seed=0)[1]]
    infos += [single.step(0)[4], vector.step(np.array([0, 0]))[4]]
    names = set(Info.__annotations__)
    assert not names & (GYMNASIUM_KEYS | SB3_KEYS)
    assert not any(name.startswith("_") for name in names)
    assert all(set(info) == names for info in infos[::2])
    assert all(set(info) == names | {f"_{name}" for name in names} for info in infos[1::2])


def test_observations_are_stacked_and_episode_statistics_recorded():
    stacks, rewards, info = run_episode(RecordEpisodeStatistics(FrameStackObservation(make(), 4)))
    alone = run_episode(CorridorEnv(**WORLD))[0]
    statistics = statistics_of(info)
    assert (statistics["r"], statistics["l"]) == (sum(rewards), STEPS)
    for step, stack in enumerate(stacks):
        assert stack.tolist() == [alone[max(0, step - back)].tolist() for back in (3, 2, 1, 0)]


def test_frames_are_collected():
    env = RecordEpisodeStatistics(RenderCollection(make(render_mode="rgb_array")))
    assert statistics_of(run_episode(env)[2])["l"] == STEPS
    frames = env.render()
    assert len(frames) == STEPS + 1
    assert {(frame.shape, frame.dtype.name) for frame in frames} == {((64, 128, 3), "uint8")}


@pytest.mark.parametrize("kind", [DummyVecEnv, pytest.param(SubprocVecEnv, marks=pytest.mark.system)])
def test_stable_baselines3_trains_and_evaluates(kind):
    envs = make_vec_env(NAME, 2, seed=0, env_kwargs=WORLD, vec_env_cls=kind)
    policy = PPO("MlpPolicy", envs, n_steps=32, batch_size=32, n_epochs=1, device="cpu").learn(64)
    assert policy.num_timesteps == 64
    assert evaluate_policy(policy, envs, 2, return_episode_rewards=True)[1] == [STEPS, STEPS]
    envs.close()
    assert [ended["l"] for ended in policy.ep_info_buffer] == [STEPS] * 6


@pytest.mark.parametrize(
    "mode", ["vector_entry_point", "sync", pytest.param("async", marks=pytest.mark.system)]
)
def test_the_loop_of_cleanrl_reads_statistics_of_a_vector(mode):
    envs = RecordVectorStatistics(gymnasium.make_vec(NAME, 2, vectorization_mode=mode, **WORLD))
    envs.reset(seed=0)
    totals, returns, lengths = np.zeros(2), [], []
    for _ in range(2 * STEPS + 1):  # the step between two episodes resets
        _, rewards, terminated, truncated, infos = envs.step(np.array([0, 1]))
        totals += rewards
        assert ("episode" in infos) == (terminated | truncated).any()
        if "episode" in infos:
            ended = infos["_episode"]
            assert ended.tolist() == (terminated | truncated).tolist()
            returns += infos["episode"]["r"][ended].tolist()
            lengths += infos["episode"]["l"][ended].tolist()
    envs.close()
    assert lengths == [STEPS] * 4
    assert sum(returns) == pytest.approx(totals.sum())


@pytest.mark.filterwarnings("ignore:.*is not within the observation space")
def test_event_images_train_the_cnn_of_stable_baselines3():
    pictures = {
        "camera": CameraConfig(width=36, height=36),
        "time_limit_s": 0.05,
        "observation": "event_image",
    }
    stacked = VecFrameStack(make_vec_env(NAME, 2, seed=0, env_kwargs=pictures), 3)
    assert stacked.observation_space.shape == (36, 36, 3)
    policy = PPO("CnnPolicy", stacked, n_steps=8, batch_size=16, n_epochs=1, device="cpu").learn(16)
    assert policy.num_timesteps == 16
    stacked.close()


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize(
    ("name", "sizes"),
    [
        ("PPO", {"train_batch_size_per_learner": 32, "minibatch_size": 16, "num_epochs": 1}),
        ("SAC", {"train_batch_size_per_learner": 32, "num_steps_sampled_before_learning_starts": 16}),
    ],
)
def test_rllib_trains_a_body_by_continuous_commands_as_a_user_configures_it(name, sizes):
    import ray
    from gymnasium.wrappers import DtypeObservation
    from ray.tune.registry import get_trainable_cls, register_env

    # RLlib's convolutions take floating-point numbers alone.
    register_env("floats", lambda given: DtypeObservation(CorridorEnv(given), np.float32))
    settings = {"vehicle": "point_mass", "observation": "event_image", "time_limit_s": 0.1, "speed_mps": 10.0}
    config = get_trainable_cls(name).get_default_config().environment("floats", env_config=settings)
    ray.init(num_cpus=1, include_dashboard=False)
    try:
        algorithm = config.env_runners(num_env_runners=0).training(**sizes).build_algo()
        result = algorithm.train()
        algorithm.stop()
    finally:
        ray.shutdown()
    assert result["num_env_steps_sampled_lifetime"] > 0
    learned = result["learners"]["default_policy"].values()
    assert np.isfinite([value for value in learned if isinstance(value, float)]).all()
