"""Composed configurations for tests; each is composed once a process, however many tests want it."""

import copy
import dataclasses
import functools
from pathlib import Path

import hydra
from omegaconf import OmegaConf

from jobs.config.command_line import hydra_words
from jobs.config.config import Config, parse

CONF = Path(__file__).resolve().parents[2] / "conf"
AXES = {
    "sparsity": {"faults.sparsity": [0.0, 0.5]},
    "rate": {"env.control_hz": [100, 200], "env.scene": ["poles_eval"]},
}
# Seven steps to an episode: every one is truncated, and no chunk of samples ends with one.
SHORT = ("env.time_limit_s=0.035", "algo.num_envs_per_env_runner=2", "algo.reward_scale=0.5")
TINY = (
    *SHORT,
    "algo.train_batch_size_per_learner=64",
    "algo.num_epochs=1",
    "train.env_steps=1600",
    "train.checkpoint_every=1",
)


@functools.cache
def _composed(*words: str) -> dict:
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        return OmegaConf.to_container(hydra.compose("config", hydra_words(words)), resolve=True)


def compose(*words: str) -> dict:
    """What Hydra composes of the words of a command line; the caller's own."""
    return copy.deepcopy(_composed(*words))


def small_config(tmp_path: Path, **changes: object) -> Config:
    """A checked configuration whose runs lie in a folder of the test's own."""
    job = f"job={changes.get('job', 'pipeline')}"
    values = compose("+exp=bytestream", "budget=smoke", "evaluate.beside=[]", job)
    return parse({**values, "runs_dir": str(tmp_path / "runs"), **changes})


def make_config(*overrides: str) -> Config:
    """The checked configuration of a training."""
    algo = [] if any(word.startswith("algo=") for word in overrides) else ["algo=ppo"]
    return parse(compose("+exp=train", *algo, *overrides))


def tune_config(*overrides: str) -> Config:
    """The checked configuration of a search."""
    return parse(compose("+exp=search", *overrides))


def sweep_config(tmp_path, trials=2, policies=("straight",), axes=AXES, **changes):
    """A sweep of short episodes."""
    own = {**compose("+exp=robustness")["study"], "families": {}, "figures": {}, "headline": {}}
    config = small_config(tmp_path, job="study", exp="robustness", study=own)
    settings = dataclasses.replace(config.own, axes=axes, trials=trials, policies=list(policies), **changes)
    return dataclasses.replace(config, own=settings, env=dataclasses.replace(config.env, time_limit_s=0.2))
