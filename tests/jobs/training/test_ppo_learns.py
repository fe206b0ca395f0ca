"""PPO learns: our env runner and learner solve a task that needs nothing but to read the observation."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from ray.rllib.callbacks.callbacks import RLlibCallback
from ray.tune.registry import register_env

from jobs.training.algorithms import build_algorithm
from jobs.training.sampling.env_runner import PlainEnvRunner
from tests.support.configs import make_config

COLUMNS = np.array([10, 32, 54])  # of the only event of a step; its place names the action that is rewarded
STEPS = 25  # of an episode


class Identity(VectorEnv):
    """Rewards 1 for the action that the observation names; as stable-baselines3's IdentityEnv."""

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(self, num_envs):
        self.num_envs = num_envs
        self.single_observation_space = gymnasium.spaces.Box(-(2**31), 2**31 - 1, (2, 4), np.int32)
        self.single_action_space = gymnasium.spaces.Discrete(3)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def show(self):
        """Packed windows of one event each."""
        self.wanted = self.rng.integers(0, 3, self.num_envs)
        windows = np.zeros((self.num_envs, 2, 4), np.int32)
        windows[:, 0] = 1, 0, 5000, 0
        windows[:, 1, 0], windows[:, 1, 1], windows[:, 1, 3] = 1, COLUMNS[self.wanted], 1
        return windows

    def reset(self, *, seed=None, options=None):
        self.rng, self.taken = np.random.default_rng(0), np.zeros(self.num_envs, int)
        return self.show(), {}

    def step(self, actions):
        over = self.taken == STEPS
        rewards = np.where(over, 0.0, (actions == self.wanted).astype(float))
        self.taken = np.where(over, 0, self.taken + 1)
        return self.show(), rewards, np.zeros(self.num_envs, bool), self.taken == STEPS, {}


@pytest.mark.system
def test_ppo_learns_which_action_the_observation_names():
    config = make_config("model=event_columns", "algo.num_envs_per_env_runner=8", "algo.lr=1e-3")
    register_env("identity", lambda context: Identity(context["num_envs"]))
    ppo = build_algorithm(config).environment("identity", env_config={}).callbacks(RLlibCallback)
    runner = PlainEnvRunner(config=ppo, worker_index=0)
    learner = ppo.build_learner(env=runner.env)
    torch.manual_seed(0)
    shares = []
    for _ in range(12):
        runner.module.set_state(learner.module["default_policy"].get_state())
        episodes = runner.sample(num_timesteps=512)
        rewards = np.concatenate([episode.get_rewards() for episode in episodes])
        shares.append(rewards.mean())
        learner.update(episodes=episodes, num_epochs=10, minibatch_size=64)
    runner.stop()
    assert shares[0] < 0.5  # chance is a third
    assert shares[-1] > 0.9
