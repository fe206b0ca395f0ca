"""Gymnasium's wrappers, stable-baselines3 and CleanRL's loop run the corridor as they come."""

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import FrameStackObservation, RecordEpisodeStatistics, RecordVideo, RenderCollection
from gymnasium.wrappers.vector import RecordEpisodeStatistics as RecordVectorStatistics
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
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


@pytest.mark.parametrize("observation", ["window", "events"])
def test_no_key_of_info_is_reserved(observation):
    single = CorridorEnv(**WORLD, observation=observation)
    vector = CorridorVectorEnv(2, **WORLD, observation=observation)
    infos = [single.reset(seed=0)[1], vector.reset(seed=0)[1]]
    for _ in range(STEPS):
        infos += [single.step(0)[4], vector.step(np.array([0, 0]))[4]]
    infos += [single.reset()[1], vector.step(np.array([0, 0]))[4]]
    names = set(Info.__annotations__)
    assert not names & (GYMNASIUM_KEYS | SB3_KEYS)
    assert not any(name.startswith("_") for name in names)
    assert all(set(info) == names for info in infos[::2])
    assert all(set(info) == names | {f"_{name}" for name in names} for info in infos[1::2])


def test_episode_statistics_are_recorded():
    _, rewards, info = run_episode(RecordEpisodeStatistics(make()))
    statistics = statistics_of(info)
    assert statistics["r"] == sum(rewards)
    assert statistics["l"] == STEPS


def test_observations_are_stacked():
    stacks, _, info = run_episode(RecordEpisodeStatistics(FrameStackObservation(make(), 4)))
    alone = run_episode(CorridorEnv(**WORLD))[0]
    assert statistics_of(info)["l"] == STEPS
    for step, stack in enumerate(stacks):
        assert stack.tolist() == [alone[max(0, step - back)].tolist() for back in (3, 2, 1, 0)]


def test_frames_are_collected():
    env = RecordEpisodeStatistics(RenderCollection(make(render_mode="rgb_array")))
    assert statistics_of(run_episode(env)[2])["l"] == STEPS
    frames = env.render()
    assert len(frames) == STEPS + 1
    assert {(frame.shape, frame.dtype.name) for frame in frames} == {((64, 128, 3), "uint8")}


def test_a_video_is_recorded(tmp_path):
    pytest.importorskip("moviepy", reason="gymnasium's RecordVideo writes with the package moviepy")
    env = RecordVideo(RecordEpisodeStatistics(make(render_mode="rgb_array")), str(tmp_path), lambda n: True)
    assert statistics_of(run_episode(env)[2])["l"] == STEPS
    env.close()
    assert [path.stat().st_size > 0 for path in tmp_path.glob("*.mp4")] == [True]


@pytest.mark.filterwarnings("ignore::UserWarning")  # a window is neither an image nor a vector
def test_stable_baselines3_accepts_it():
    check_env(make())
    monitored = Monitor(make())
    _, rewards, info = run_episode(monitored)
    statistics = statistics_of(info)
    assert statistics["r"] == pytest.approx(sum(rewards), abs=1e-6)
    assert statistics["l"] == STEPS
    policy = PPO("MlpPolicy", monitored, device="cpu")
    assert evaluate_policy(policy, monitored, 2, return_episode_rewards=True)[1] == [STEPS, STEPS]


@pytest.mark.parametrize("kind", [DummyVecEnv, pytest.param(SubprocVecEnv, marks=pytest.mark.system)])
def test_stable_baselines3_trains(kind):
    envs = make_vec_env(NAME, 2, seed=0, env_kwargs=WORLD, vec_env_cls=kind)
    policy = PPO("MlpPolicy", envs, n_steps=64, batch_size=32, n_epochs=2, device="cpu").learn(256)
    envs.close()
    assert policy.num_timesteps == 256
    assert [ended["l"] for ended in policy.ep_info_buffer] == [STEPS] * (256 // STEPS // 2 * 2)


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


@pytest.mark.parametrize("kind", [SyncVectorEnv, pytest.param(AsyncVectorEnv, marks=pytest.mark.system)])
def test_the_loop_of_cleanrl_reads_the_last_info_of_each_episode(kind):
    thunks = [lambda: RecordEpisodeStatistics(make())] * 2
    envs = kind(thunks, autoreset_mode=AutoresetMode.SAME_STEP)
    envs.reset(seed=0)
    lengths = []
    for _ in range(2 * STEPS):
        infos = envs.step(np.array([0, 1]))[4]
        if "final_info" in infos:
            lengths += infos["final_info"]["episode"]["l"].tolist()
            assert infos["final_info"]["t_us"].tolist() == [STEPS * 5000] * 2
    envs.close()
    assert lengths == [STEPS] * 4


PICTURES = {"camera": CameraConfig(width=36, height=36), "time_limit_s": 0.05}


@pytest.mark.filterwarnings("ignore:.*is not within the observation space")
def test_event_images_train_the_cnn_of_stable_baselines3(tmp_path):
    envs = make_vec_env(NAME, 2, seed=0, env_kwargs=PICTURES | {"observation": "event_image"})
    stacked = VecFrameStack(envs, 3)
    for world, shape in ((envs, (36, 36, 1)), (stacked, (36, 36, 3))):
        assert world.observation_space.shape == shape
        policy = PPO("CnnPolicy", world, n_steps=8, batch_size=16, n_epochs=1, device="cpu").learn(16)
        assert policy.num_timesteps == 16
    envs.close()


@pytest.mark.system
def test_event_images_fit_the_default_encoder_of_rllib():
    import torch
    from ray.rllib.algorithms.ppo.ppo_catalog import PPOCatalog
    from ray.rllib.algorithms.ppo.torch.default_ppo_torch_rl_module import DefaultPPOTorchRLModule
    from ray.rllib.core.columns import Columns
    from ray.rllib.core.rl_module.rl_module import RLModuleSpec

    env = CorridorEnv(observation="event_image")
    module = RLModuleSpec(
        module_class=DefaultPPOTorchRLModule,
        observation_space=env.observation_space,
        action_space=env.action_space,
        catalog_class=PPOCatalog,
    ).build()
    seen = torch.from_numpy(env.reset(seed=0)[0][None].astype(np.float32))
    assert module.forward_inference({Columns.OBS: seen})[Columns.ACTION_DIST_INPUTS].shape == (1, 3)


def test_rllib_hands_the_class_its_env_config():
    from ray.rllib.env.env_context import EnvContext

    context = EnvContext({"observation": "event_image", "scene": "gates"}, worker_index=1)
    env = CorridorEnv(context)
    assert (env.config.observation, env.config.scene) == ("event_image", "gates")
    with pytest.raises(ValueError, match="no_such_field"):
        CorridorEnv(EnvContext({"no_such_field": 1}, worker_index=1))


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
