"""RLlib's configuration of imitation: PPO's env runners and checkpoints, with another learner."""

import dataclasses
from pathlib import Path
from typing import cast

from ray.rllib.algorithms.ppo import PPOConfig

from envs.vehicles.dynamics import make_dynamics, mirrored_actions
from jobs.config.algorithms import AlgoConfig
from jobs.config.config import Config
from jobs.training.imitation.env_runner import TaughtEnvRunner
from jobs.training.imitation.labelled_steps import MIRRORED, SETTINGS
from jobs.training.imitation.learner import AGREEMENT_KEY, ImitationLearner
from jobs.training.ppo.train import PPO, Parts, build_of, shared_settings


def build(config: Config, encoder_path: str | Path | None = None, init: Path | None = None) -> PPOConfig:
    """Return RLlib's configuration of imitation; arguments and errors as in PPO's `build`."""
    algo = cast(AlgoConfig, config.algo)
    parts = Parts(TaughtEnvRunner, ImitationLearner, learner_settings(config), algo.lr)
    return build_of(parts, config, encoder_path, init)


def learner_settings(config: Config) -> dict[str, object]:
    """Return the settings of the imitation learner and its env runners."""
    algo = cast(AlgoConfig, config.algo)
    own = dataclasses.asdict(algo.imitation) if algo.imitation else {}
    if algo.mirrored:  # only then: Tune resumes a training only with the keys with which it started
        kinematic = config.env.vehicle == "kinematic"
        own[MIRRORED] = True if kinematic else mirrored_actions(make_dynamics(config.env))
    return shared_settings(algo) | {SETTINGS: {**own, "env_steps": config.train.env_steps}}


LOSSES = {name: key for name, key in PPO.losses.items() if name != "train/value_loss"}
IMITATION = PPO._replace(build=build, losses=LOSSES, figures={"train/agreement": AGREEMENT_KEY})
