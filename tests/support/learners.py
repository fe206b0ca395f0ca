"""Env runners and learners of RLlib, as the tests of training handle them."""

import copy

import torch

from envs.scene.planning import cost_to_go
from models.kinds import KINDS
from tests.support.runs import write_encoder

MODULE = "default_policy"


def words_of(kind):
    """The words that choose a kind of policy, or "finetuned": bytestream with an encoder that learns on."""
    return ("model.encoder=finetuned",) if kind == "finetuned" else (f"model={kind}",)


def encoder_of(config, folder):
    """The file of an untrained encoder for a policy that has one, else None."""
    return write_encoder(folder, config) if KINDS[config.model.name].encoder else None


def module_of(learner):
    return learner.module[MODULE].unwrapped()


def weights(learner):
    return {name: value.clone() for name, value in module_of(learner).state_dict().items()}


def moved(before, learner):
    """Names of the weights that are no longer those before."""
    return {name for name, value in weights(learner).items() if not torch.equal(value, before[name])}


def learn(learner, episodes, sampled=0, **asked):
    """Update on copies of some episodes, after so many environment steps; return the figures."""
    counters = {"num_env_steps_sampled_lifetime": sampled}
    asked = {"num_epochs": 1, **asked}
    told = learner.update(episodes=copy.deepcopy(episodes), timesteps=counters, **asked)[MODULE]
    return {name: float(value.peek() if hasattr(value, "peek") else value) for name, value in told.items()}


def plan_of(env, scene=None):
    """The teacher's plan of an environment's scene, or of another one."""
    return cost_to_go(scene or env.scene, env.config.vehicle_radius_m, env.config.camera_height_m)


def start_of(infos):
    """How an environment is reset to the start of the episode of some infos."""
    info = infos[0]
    return {"seed": int(info["episode_seed"]), "options": {"episode_number": int(info["episode_number"])}}


def plan_again(env, infos):
    """The plan of the episode of some infos; the environment shows its scene again."""
    env.reset(**start_of(infos))
    return plan_of(env)
