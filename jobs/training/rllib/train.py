"""Any RLlib algorithm with RLlib's default networks; its policy is exported like any other."""

from pathlib import Path
from typing import Any, cast

from ray.rllib.algorithms.registry import ALGORITHMS
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from torch import nn

from jobs.config.algorithms import RLlibConfig
from jobs.config.config import Config, ConfigError
from jobs.training.algorithms import Algorithm
from jobs.training.policy import policy_spec, pretrained_encoder
from jobs.training.rllib.observed import ObservedCorridor
from jobs.training.sampling.corridors import corridor_settings
from jobs.training.sampling.metrics import EPISODES, REWARD_SCALE, EpisodeMetrics
from jobs.training.trainable import guarded
from models.kinds import PolicySpec
from models.policy.networks import assemble

# Names of the acting networks (body, head) in RLlib's modules of algorithms with discrete actions.
ACTING = (("pi_encoder", "pi"), ("encoder.actor_encoder", "pi"), ("encoder.encoder", "pi"), ("encoder", "af"))


def build(config: Config, encoder_path: str | Path | None = None, init: Path | None = None) -> Any:
    """Return RLlib's configuration of the algorithm that `algo.algorithm` names.

    Raises:
        ConfigError: RLlib has no algorithm of this name, the algorithm lacks a setting, the policy is not
            made of dense layers, or `train.init` is set.
    """
    algo, spec = cast(RLlibConfig, config.algo), policy_spec(config)
    _check(config, spec)
    pretrained_encoder(config, encoder_path)
    context = {
        **corridor_settings(config),
        "spec": spec,
        REWARD_SCALE: algo.reward_scale,
        "encoder_file": str(encoder_path) if spec.frozen else None,
    }
    built = (
        _registered(algo)[1]
        .environment(ObservedCorridor, env_config=context, disable_env_checking=True)
        .framework("torch")
        .env_runners(
            num_env_runners=algo.num_env_runners,
            num_envs_per_env_runner=algo.num_envs_per_env_runner,
        )
        .learners(num_learners=0)
        .rl_module(model_config=DefaultModelConfig(fcnet_hiddens=spec.hidden, fcnet_activation="tanh"))
        .callbacks(EpisodeMetrics)
        .reporting(metrics_num_episodes_for_smoothing=EPISODES, min_time_s_per_iteration=0)
        .debugging(seed=config.seed, log_level="ERROR")
    )
    settings = dict(algo.settings)
    if algo.lr_schedule == "linear" and isinstance(settings.get("lr"), float):
        settings["lr"] = [[0, settings["lr"]], [config.train.env_steps, 0.0]]
    try:
        return built.training(**settings)
    except TypeError as error:
        raise ConfigError(f"algo.settings: {algo.algorithm} has no such setting: {error}") from None


def _check(config: Config, spec: PolicySpec) -> None:
    """Raise ConfigError if RLlib's default networks cannot be the policy, or if `train.init` is set."""
    if config.train.init is not None:
        raise ConfigError(f"train.init: must be null for algo.name=rllib, got {config.train.init!r}")
    if spec.finetuned or "hidden" not in spec.manifest():
        rule = "must be event_columns, bytestream or another of dense layers for algo.name=rllib"
        raise ConfigError(f"model.name: {rule}, got {config.model.name!r}")


def _registered(algo: RLlibConfig) -> Any:
    """Return RLlib's class of the algorithm, and its default configuration."""
    if algo.algorithm not in ALGORITHMS:
        names = ", ".join(ALGORITHMS)
        raise ConfigError(f"algo.algorithm: must be one of {names}, got {algo.algorithm!r}")
    return ALGORITHMS[algo.algorithm]()


def trainable(config: Config) -> type:
    """Return RLlib's class of the algorithm, `guarded` for Tune."""
    return guarded(_registered(cast(RLlibConfig, config.algo))[0])


def networks(module: Any, spec: PolicySpec) -> nn.ModuleDict:
    """Return the policy's networks with copies of the dense layers of a trained RLlib module.

    The logits of a Q-network are its Q-values, of a dueling Q-network its advantages, so the likeliest action
    is the greedy one. The value network is set to zero, because only training reads it.

    Raises:
        ValueError: The layers of the module differ from the policy's.
    """
    own, names = assemble(spec), {name for name, _ in module.named_modules()}
    where: tuple[str, ...] = next((pair for pair in ACTING if names.issuperset(pair)), ())
    theirs = [layer for name in where for layer in _linear(module.get_submodule(name))]
    ours = _linear(own["pi"])
    if [layer.weight.shape for layer in theirs] != [layer.weight.shape for layer in ours]:
        got = [tuple(layer.weight.shape) for layer in theirs]
        raise ValueError(f"the trained module must have the layers of model.hidden={spec.hidden}, got {got}")
    for layer, trained in zip(ours, theirs, strict=True):
        layer.load_state_dict(trained.state_dict())
    for layer in _linear(own["vf"]):
        nn.init.zeros_(layer.weight)
        nn.init.zeros_(layer.bias)
    return own


def _linear(module: nn.Module) -> list[nn.Linear]:
    return [layer for layer in module.modules() if isinstance(layer, nn.Linear)]


RLLIB = Algorithm(build, trainable, networks, losses={"train/loss": "total_loss"}, figures={})
