"""RLlib's configuration of PPO, as appendix D.1.2 states it."""

import math
from pathlib import Path
from typing import Any, NamedTuple, cast

from ray.rllib.algorithms.ppo import PPOConfig
from torch import nn

from jobs.config.algorithms import AlgoConfig
from jobs.config.config import Config
from jobs.training.algorithms import Algorithm
from jobs.training.policy import policy_spec, pretrained_encoder
from jobs.training.ppo.algorithm import PPO as PPOAlgorithm
from jobs.training.ppo.learner import REWARD_SCALE, SHAPING, VALUE_WARMUP, PlainPPOLearner
from jobs.training.sampling.corridors import TrainingCorridors, corridor_settings
from jobs.training.sampling.env_runner import PlainEnvRunner
from jobs.training.sampling.metrics import EPISODES, EpisodeMetrics
from jobs.training.sampling.rounds import MAX_RESTARTS, SAMPLE_TIMEOUT_S
from jobs.training.sampling.teacher import SIGHT_M, PricedEnvRunner
from models.kinds import PolicySpec
from models.policy.rllib_module import module_spec

WAITING_CPUS = 0.1  # cores of a process that waits most of the time; RLlib does not accept 0
LOSSES = {
    "train/policy_loss": "policy_loss",
    "train/value_loss": "vf_loss",
    "train/entropy": "entropy",
    "train/gradient_norm": "gradients_default_optimizer_global_norm",
}
FIGURES = {"train/explained_variance": "vf_explained_var"}


class Parts(NamedTuple):
    """The parts in which algorithms with PPO's sampling differ.

    Attributes:
        env_runner: Class of the env runners.
        learner: Class of the learner.
        settings: The learner's settings in addition to RLlib's own.
        lr: Adam's step size: a number, or (environment step, value) pairs between which RLlib interpolates.
        privileged: How many numbers per step only the value network reads.
    """

    env_runner: type
    learner: type
    settings: dict[str, object]
    lr: float | list[list[float]]
    privileged: int = 0


def build(config: Config, encoder_path: str | Path | None = None, init: Path | None = None) -> PPOConfig:
    """Return RLlib's configuration of PPO; set every default of RLlib that differs from the paper's.

    Args:
        config: The experiment.
        encoder_path: The pretrained encoder's file, for a policy that has one.
        init: The file of networks to start from instead of random weights.

    Raises:
        ConfigError: The encoder was trained for another sensor, or is another model than the
            one to fine-tune.
    """
    algo = cast(AlgoConfig, config.algo)
    priced = algo.critic == "teacher" or algo.shaping > 0.0
    parts = Parts(
        PricedEnvRunner if priced else PlainEnvRunner,
        PlainPPOLearner,
        learner_settings(config),
        learning_rate(config),
        privileged=int(algo.critic == "teacher"),
    )
    return build_of(parts, config, encoder_path, init)


def build_of(parts: Parts, config: Config, encoder_path: str | Path | None, init: Path | None) -> PPOConfig:
    """Return RLlib's configuration of an algorithm with these parts; other arguments as in `build`."""
    algo = cast(AlgoConfig, config.algo)
    # The learner works while the env runners, if any, wait: one core per env runner is enough for all.
    runners = algo.num_env_runners
    own_cpus = WAITING_CPUS if runners else 1
    encoder = pretrained_encoder(config, encoder_path)
    spec = module_spec(policy_spec(config), config.seed, encoder, init, parts.privileged)
    return (
        _optimiser(PPOConfig(), algo, parts)
        .environment(TrainingCorridors, env_config=corridor_settings(config), disable_env_checking=True)
        .framework("torch")
        .env_runners(
            num_env_runners=runners,
            num_cpus_per_env_runner=1.0 - WAITING_CPUS / max(1, runners),
            num_envs_per_env_runner=algo.num_envs_per_env_runner,
            sample_timeout_s=SAMPLE_TIMEOUT_S,
            gym_env_vectorize_mode="vector_entry_point",
            env_runner_cls=parts.env_runner,
            merge_env_runner_states=False,  # states of connectors: these env runners have none
            broadcast_env_runner_states=False,
        )
        .resources(num_cpus_for_main_process=own_cpus)
        .learners(num_learners=0, num_cpus_per_learner=own_cpus, learner_class=parts.learner)
        .rl_module(rl_module_spec=spec)
        .callbacks(EpisodeMetrics)
        .reporting(metrics_num_episodes_for_smoothing=EPISODES)
        .fault_tolerance(max_num_env_runner_restarts=MAX_RESTARTS, delay_between_env_runner_restarts_s=1.0)
        .debugging(seed=config.seed, log_level="ERROR")
    )


def _optimiser(ppo: PPOConfig, algo: AlgoConfig, parts: Parts) -> PPOConfig:
    """Set PPO's loss, batches and step sizes.

    `vf_clip_param` is infinite because RLlib clips the squared error, which with rewards of
    +-100 would leave the value network without a gradient.
    """
    return ppo.training(
        learner_config_dict=parts.settings,
        lr=parts.lr,
        gamma=algo.gamma,
        lambda_=algo.lambda_,
        clip_param=algo.clip_param,
        num_epochs=algo.num_epochs,
        minibatch_size=algo.minibatch_size,
        train_batch_size_per_learner=algo.train_batch_size_per_learner,
        vf_loss_coeff=algo.vf_loss_coeff,
        vf_clip_param=math.inf,
        use_kl_loss=False,
        kl_coeff=0.0,
        entropy_coeff=algo.entropy_coeff,
        grad_clip=algo.grad_clip,
        grad_clip_by="global_norm",
    )


def shared_settings(algo: AlgoConfig) -> dict[str, object]:
    """Return the settings that all learners on these env runners share."""
    settings: dict[str, object] = {REWARD_SCALE: algo.reward_scale}
    return settings if algo.teacher_sight_m is None else {**settings, SIGHT_M: algo.teacher_sight_m}


def learner_settings(config: Config) -> dict[str, object]:
    """Return the settings of PPO's learner in addition to RLlib's own."""
    algo = cast(AlgoConfig, config.algo)
    settings = shared_settings(algo)
    if algo.shaping:
        settings[SHAPING] = algo.shaping
    if config.train.init is not None:
        settings[VALUE_WARMUP] = config.train.value_warmup
    return settings


def learning_rate(config: Config) -> float | list[list[float]]:
    """Return Adam's step size: one number, or (environment step, value) pairs."""
    algo = cast(AlgoConfig, config.algo)
    return algo.lr if algo.lr_schedule == "constant" else [[0, algo.lr], [config.train.env_steps, 0.0]]


def networks(module: Any, spec: PolicySpec) -> nn.ModuleDict:
    """Return the networks of a trained `PolicyModule`."""
    own: nn.ModuleDict = module.networks()
    return own


PPO = Algorithm(build, lambda config: PPOAlgorithm, networks, LOSSES, FIGURES)
