"""Compare environment steps per second of whole PPO training with stable-baselines3 in the same corridors.

Run: OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python -m benchmarks.ppo
Expect: two tables in about eight minutes. "Ours" is a job's loop with `jobs.training.ppo.learner`; "tensor by
tensor" is the same without `models.policy.dense_update`; "RLlib's learner" is RLlib's unchanged loop with our
env runner; "stable-baselines3" is its PPO with the same networks, encoder, corridors and settings. All take
turns in one process; an iteration samples 2,048 steps in 16 corridors and learns 10 epochs. Seconds are wall
time, medians over the rounds. The machine should be idle, because `ppo_fast` samples in separate processes.
The second table has our loop for every kind of policy.
"""

import dataclasses
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
import torch
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.algorithms.ppo.torch.ppo_torch_learner import PPOTorchLearner
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv

from benchmarks.throughput import composed, encoder_file
from envs.config import EnvConfig
from envs.corridor import CorridorEnv
from jobs.analysis.tables import show_table
from jobs.config.algorithms import AlgoConfig
from jobs.config.config import Config
from jobs.measure.timing import interleaved
from jobs.run.ray_cluster import start_ray
from jobs.training.algorithms import algorithm_of, build_algorithm
from jobs.training.policy import policy_spec
from jobs.training.ppo.learner import PlainPPOLearner
from jobs.training.pretrain import evae_settings
from models.encoder.evae import EventVAE
from models.encoder.table import EncoderTable
from models.kinds import KINDS
from models.policy.features import push_features

ROUNDS, FEW_ROUNDS = 5, 2
MINIBATCHES = (32, 256)
STEPS = 2048  # steps of an iteration (appendix D.1.2)
CONSTANT = "algo.lr_schedule=constant"
RIVALS = tuple(f"stable-baselines3, {size}" for size in MINIBATCHES)


class TensorByTensor(PlainPPOLearner):
    """A learner that updates dense networks like all others, without compiled updates."""

    _compiled = False


class EncodedCorridors(VecEnv):
    """Corridors for stable-baselines3: they return stacks of latents and restart after each episode."""

    def __init__(self, num_envs: int, config: EnvConfig, table: EncoderTable, stack: int) -> None:
        """Create `num_envs` corridors, whose windows `table` encodes."""
        self.corridors = [CorridorEnv(config) for _ in range(num_envs)]
        self.table, self.shape = table, (num_envs, stack, len(table.head[1]))
        space = gymnasium.spaces.Box(-np.inf, np.inf, self.shape[1:], np.float32)
        super().__init__(num_envs, space, self.corridors[0].action_space)

    def reset(self) -> np.ndarray:
        """Start all episodes."""
        windows = [env.reset(seed=k << 32)[0] for k, env in enumerate(self.corridors)]
        self.stacks = np.zeros(self.shape, np.float32)
        self.stacks = self._push(windows, np.ones(self.num_envs, bool))
        return self.stacks

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions."""
        self._actions = actions

    def step_wait(self) -> Any:
        """Simulate one step in every corridor."""
        results = [env.step(int(action)) for env, action in zip(self.corridors, self._actions, strict=True)]
        done = np.array([result[2] or result[3] for result in results])
        stacks = self._push([result[0] for result in results], np.zeros(self.num_envs, bool))
        infos: list[dict[str, object]] = [{} for _ in results]
        if done.any():
            windows = [result[0] for result in results]
            for k in np.flatnonzero(done):
                infos[k] |= {"terminal_observation": stacks[k], "TimeLimit.truncated": results[k][3]}
                windows[k] = self.corridors[k].reset()[0]
            stacks = np.where(done[:, None, None], self._push(windows, done), stacks)
        self.stacks = stacks
        return stacks, np.array([result[1] for result in results], np.float32), done, infos

    def _push(self, windows: list[np.ndarray], first: np.ndarray) -> np.ndarray:
        return push_features(self.stacks, self.table.encode_windows(windows), first)

    def close(self) -> None:
        """Do nothing."""

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Return False for every corridor: none is wrapped."""
        return [False] * self.num_envs

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Call a method of every corridor."""
        return [getattr(env, method_name)(*args, **kwargs) for env in self.corridors]

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of every corridor."""
        return [getattr(env, attr_name) for env in self.corridors]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of every corridor."""
        for env in self.corridors:
            setattr(env, attr_name, value)


def main() -> None:
    """Measure and print both tables."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        show("bytestream", interleaved(against_others(Path(folder)), ROUNDS), RIVALS)
        kinds = interleaved(every_kind(Path(folder)), FEW_ROUNDS)
        show("every policy, minibatches of 32", kinds, ("bytestream",))


def show(title: str, seconds: dict[str, float], units: tuple[str, ...]) -> None:
    """Print environment steps per second, and as multiples of some rows."""
    rows = [
        (name, f"{STEPS / value:,.0f}", *(f"{seconds[unit] / value:.2f}x" for unit in units))
        for name, value in seconds.items()
    ]
    title = f"PPO, {title}: iterations of {STEPS:,} steps that take turns, medians"
    show_table(title, ("training loop", "steps/s", *(f"of {unit}" for unit in units)), rows)


def against_others(folder: Path) -> dict[str, Callable[[], object]]:
    """Return a function for one iteration on bytestream of each learner, ours also without compiled steps."""
    evae = EventVAE.of(evae_settings(composed())).freeze()
    path, table = encoder_file(evae, folder), EncoderTable.from_evae(evae)
    work: dict[str, Callable[[], object]] = {}
    for size in MINIBATCHES:
        config = composed(f"algo.minibatch_size={size}", CONSTANT)
        start_ray(config.cluster, folder)
        ppo = build_algorithm(config, path)
        slower = ppo.copy(copy_frozen=False).learners(learner_class=TensorByTensor)
        plain = ppo.copy(copy_frozen=False).learners(learner_class=PPOTorchLearner)
        work[f"ours, {size}"] = built(config, ppo).train
        work[f"tensor by tensor, {size}"] = built(config, slower).train
        work[f"RLlib's learner, {size}"] = plain.build_algo().train
        rival = stable_baselines(config, table)
        work[f"stable-baselines3, {size}"] = partial(rival.learn, STEPS, reset_num_timesteps=False)
    fast = composed("algo=ppo_fast", CONSTANT)
    ours = built(fast, build_algorithm(fast, path))
    work["ours, algo=ppo_fast"], work["its sampling alone"] = ours.train, ours._rounds.take
    return work


def built(config: Config, algorithm: AlgorithmConfig) -> Any:
    """Build the algorithm that Tune runs in a job."""
    return algorithm_of(config).trainable(config)(config=algorithm)


def every_kind(folder: Path) -> dict[str, Callable[[], object]]:
    """Return a function for one iteration of our learner, for each kind of policy."""
    work: dict[str, Callable[[], object]] = {}
    rows = {name: [f"model={name}"] for name in KINDS}
    rows["bytestream, fine-tuned"] = ["model=bytestream", "model.encoder=finetuned"]
    for name, words in rows.items():
        config = composed(*words, CONSTANT)
        needed = KINDS[config.model.name].encoder
        evae = EventVAE.of(evae_settings(config)).freeze() if needed else None
        path = encoder_file(evae, folder) if evae else None
        work[name] = built(config, build_algorithm(config, path)).train
    return work


def stable_baselines(config: Config, table: EncoderTable) -> PPO:
    """Return PPO of stable-baselines3 with an experiment's settings."""
    algo, env = (
        cast(AlgoConfig, config.algo),
        dataclasses.replace(config.env, split="train", observation="window"),
    )
    corridors = EncodedCorridors(algo.num_envs_per_env_runner, env, table, config.model.stack)
    return PPO(
        "MlpPolicy",
        corridors,
        learning_rate=algo.lr,
        n_steps=algo.train_batch_size_per_learner // algo.num_envs_per_env_runner,
        batch_size=algo.minibatch_size,
        n_epochs=algo.num_epochs,
        gamma=algo.gamma,
        gae_lambda=algo.lambda_,
        clip_range=algo.clip_param,
        vf_coef=algo.vf_loss_coeff,
        ent_coef=algo.entropy_coeff,
        max_grad_norm=algo.grad_clip,
        policy_kwargs={"net_arch": policy_spec(config).hidden},
        device="cpu",
    )


if __name__ == "__main__":
    main()
