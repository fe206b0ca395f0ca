"""PPO as appendix D.1.2 states it, in RLlib's words; what the learner is told and what it counts."""

import dataclasses
import math
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.callbacks.callbacks import RLlibCallback
from ray.tune.registry import register_env

from envs.config import Observation, sensor_settings, settings_hash
from envs.corridor import CorridorVectorEnv
from envs.kinematics import NUM_ACTIONS
from jobs.config.conditions import episode_draw
from jobs.config.config import Config, ConfigError
from jobs.config.errors import differences
from jobs.config.plugins import plugin_digests
from jobs.rollout.diagnostics import drift_metrics
from jobs.run.files import RunError
from jobs.training.env_runner import PlainEnvRunner
from jobs.training.imitation import IMITATION, MIRRORED, ImitationLearner, TaughtEnvRunner
from jobs.training.ppo_learner import REWARD_SCALE, SHAPING, VALUE_WARMUP, PlainPPOLearner
from jobs.training.rounds import MAX_RESTARTS, SAMPLE_TIMEOUT_S
from jobs.training.teacher import SIGHT_M, PricedEnvRunner
from models.encoder.evae import EventVAE
from models.encoder.weights import EncoderFileError, EncoderManifest, load_encoder
from models.kinds import KINDS, PolicySpec
from models.policy.rllib_module import module_spec

ENV = "evade-corridors"
EPISODES = 100  # that a rate is averaged over
DRIFT_EVERY = 10  # rounds of sampling: a measurement takes a tenth of a second
WAITING_CPUS = 0.1  # of a core, for a process that waits most of the time; RLlib cannot do with none


class EpisodeMetrics(RLlibCallback):
    """Metrics of episodes, from the environments' infos; rewards are not scaled.

    An iteration ends two or three episodes, so metrics are means over the last `EPISODES`. Episodes
    count in the order in which they began, those of one round of sampling together: of those begun
    at once the short ones end first, and these are crashes.

    Attributes:
        rounds: Of sampling, so far.
    """

    def __init__(self) -> None:
        """Begin without episodes."""
        self._episodes: deque[dict[str, float]] = deque(maxlen=EPISODES)
        self._begun: deque[dict[str, dict[str, float] | None]] = deque()  # of each round; None: in the air
        self._unfinished: dict[str, float] = {}
        self.rounds = 0
        self._encoder: tuple[EventVAE, EncoderManifest] | None = None

    def on_sample_end(
        self, *, metrics_logger: Any, samples: Any, env_runner: Any = None, **kwargs: Any
    ) -> None:
        """Count events and the outcome of each episode that ended; measure drift at times."""
        if env_runner is not None and self.rounds % DRIFT_EVERY == 0:
            for name, value in self._drift(env_runner.module).items():
                metrics_logger.log_value(name, value, window=1)
        self.rounds += 1
        events, dropped = (
            np.concatenate([chunk.get_infos()[key][1:] for chunk in samples])
            for key in ("num_events", "dropped_events")
        )
        metrics_logger.log_value("events_per_step", float(events.mean()), window=1)
        metrics_logger.log_value("dropped_events", float(dropped.sum()), window=1)
        self._count(samples)
        for name in self._episodes[0] if self._episodes else ():
            mean = float(np.mean([episode[name] for episode in self._episodes]))
            metrics_logger.log_value(name, mean, window=1)

    def _count(self, samples: Any) -> None:
        """Add the episodes that ended to those of the metrics, as soon as it is their turn."""
        self._begun.append({chunk.id_: None for chunk in samples if chunk.id_ not in self._unfinished})
        for chunk in samples:
            self._unfinished[chunk.id_] = self._unfinished.get(chunk.id_, 0.0) + float(chunk.get_return())
            if chunk.is_done:
                ended = outcome(chunk.get_infos(-1), self._unfinished.pop(chunk.id_))
                next(begun for begun in self._begun if chunk.id_ in begun)[chunk.id_] = ended
        broken_off = self._unfinished.keys() - {chunk.id_ for chunk in samples}
        for name in broken_off:
            del self._unfinished[name], next(begun for begun in self._begun if name in begun)[name]
        while self._begun and None not in self._begun[0].values():
            self._episodes.extend(ended for ended in self._begun.popleft().values() if ended)

    def state(self) -> dict[str, Any]:
        """What the next metrics depend on, for JSON."""
        return {
            "rounds": self.rounds,
            "episodes": list(self._episodes),
            "begun": [dict(begun) for begun in self._begun],
            "unfinished": dict(self._unfinished),
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on from a `state`."""
        self.rounds = state["rounds"]
        self._episodes = deque(state["episodes"], maxlen=EPISODES)
        self._begun = deque(dict(begun) for begun in state["begun"])
        self._unfinished = dict(state["unfinished"])

    def _drift(self, module: Any) -> dict[str, float]:
        """The `jobs.rollout.diagnostics.drift_metrics` of the windows that the module met.

        None without an encoder, or where its file is no longer there or lean: the frozen part that
        acts has no decoder.
        """
        file = module.model_config["encoder_file"]
        if file is None or not module.met:
            return {}
        if self._encoder is None:
            try:
                with torch.random.fork_rng(devices=[]):  # a model is made with random weights first
                    self._encoder = load_encoder(file.path)
            except EncoderFileError:
                return {}
        evae, manifest = self._encoder
        if manifest["sha256"] != file.digest or evae.decoder is None:
            return {}
        return drift_metrics(evae, module.met, manifest.get("figures", {}))


def outcome(info: Mapping[str, float], episode_return: float) -> dict[str, float]:
    """The metrics of an episode that has ended, from its last info."""
    return {
        "episode_return": episode_return,
        "success_rate": float(info["success"]),
        "collision_rate": float(info["collision"]),
        "distance_m": float(info["distance_m"]),
    }


def build_ppo(config: Config, encoder_path: str | Path | None = None, init: Path | None = None) -> PPOConfig:
    """The algorithm of an experiment; every default of RLlib that differs from the paper's is set.

    Args:
        config: The experiment.
        encoder_path: The pretrained encoder's file, for a policy that has one.
        init: The file of networks to begin from instead of random weights.

    Raises:
        ConfigError: If the encoder was made for another sensor, or for another model than the
            one to fine-tune.
    """
    algo = config.algo
    # The learner works while the env runners, if any, wait: together they need a core for each of these.
    runners = algo.num_env_runners
    own_cpus = WAITING_CPUS if runners else 1
    register_env(ENV, make_corridors)
    spec = module_spec(
        policy_spec(config),
        config.seed,
        pretrained_encoder(config, encoder_path),
        init,
        privileged=int(algo.critic == "teacher" and not algo.imitation),
    )
    return (
        _optimiser(PPOConfig(), config)
        .environment(ENV, env_config=corridor_settings(config), disable_env_checking=True)
        .framework("torch")
        .env_runners(
            num_env_runners=runners,
            num_cpus_per_env_runner=1.0 - WAITING_CPUS / max(1, runners),
            num_envs_per_env_runner=algo.num_envs_per_env_runner,
            sample_timeout_s=SAMPLE_TIMEOUT_S,
            gym_env_vectorize_mode="vector_entry_point",
            env_runner_cls=env_runner(config),
            merge_env_runner_states=False,  # of connectors, which these env runners have none of
            broadcast_env_runner_states=False,
        )
        .resources(num_cpus_for_main_process=own_cpus)
        .learners(
            num_learners=0,
            num_cpus_per_learner=own_cpus,
            learner_class=ImitationLearner if algo.imitation else PlainPPOLearner,
        )
        .rl_module(rl_module_spec=spec)
        .callbacks(EpisodeMetrics)
        .reporting(metrics_num_episodes_for_smoothing=EPISODES)
        .fault_tolerance(max_num_env_runner_restarts=MAX_RESTARTS, delay_between_env_runner_restarts_s=1.0)
        .debugging(seed=config.seed, log_level="ERROR")
    )


def env_runner(config: Config) -> type[PlainEnvRunner]:
    """Which env runners a training needs."""
    if config.algo.imitation is not None:
        return TaughtEnvRunner
    return PricedEnvRunner if config.algo.critic == "teacher" or config.algo.shaping else PlainEnvRunner


def _optimiser(ppo: PPOConfig, config: Config) -> PPOConfig:
    """PPO's loss, batches and step sizes.

    `vf_clip_param` is infinite because RLlib clips the squared error, which with rewards of
    +-100 would leave the value network without a gradient.
    """
    algo = config.algo
    return ppo.training(
        learner_config_dict=learner_settings(config),
        lr=learning_rate(config),
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


def learner_settings(config: Config) -> dict[str, object]:
    """What the learner is told beside RLlib's own settings."""
    settings: dict[str, object] = {REWARD_SCALE: config.algo.reward_scale}
    if config.algo.teacher_sight_m is not None:
        settings[SIGHT_M] = config.algo.teacher_sight_m
    if config.algo.imitation is not None:
        own = dataclasses.asdict(config.algo.imitation)
        if config.algo.mirrored:  # only if it is: Tune continues a training only under the keys it began with
            own[MIRRORED] = True
        return settings | {IMITATION: {**own, "env_steps": config.train.env_steps}}
    if config.algo.shaping:
        settings[SHAPING] = config.algo.shaping
    if config.train.init is not None:
        settings[VALUE_WARMUP] = config.train.value_warmup
    return settings


def learning_rate(config: Config) -> float | list[list[float]]:
    """Adam's step size: one number, or (environment step, value) pairs between which RLlib interpolates."""
    if config.algo.lr_schedule == "constant" or config.algo.imitation is not None:
        return config.algo.lr
    return [[0, config.algo.lr], [config.train.env_steps, 0.0]]


def corridor_settings(config: Config) -> dict[str, object]:
    """What `make_corridors` makes the environments of a training from.

    Tune continues a stopped training only under the keys and kinds of values that it began with,
    so a setting of later versions appears only where it is used.
    """
    observation = KINDS[config.model.name].observation
    settings: dict[str, object] = {
        "config": dataclasses.replace(config.env, split="train", observation=cast(Observation, observation))
    }
    if config.train.conditions != [{}]:
        settings["conditions"] = config.train.conditions
    return settings


def make_corridors(context: dict[str, Any]) -> CorridorVectorEnv:
    """The environments of one env runner; each episode draws one of the conditions of the training."""
    draw = episode_draw(context.get("conditions", [{}]))
    return CorridorVectorEnv(context["num_envs"], context["config"], draw=draw)


def policy_spec(config: Config) -> PolicySpec:
    """What the policy's networks are built from."""
    camera = config.env.camera
    return PolicySpec(config.model, camera.width, camera.height, NUM_ACTIONS)


def policy_about(config: Config) -> dict[str, object]:
    """What a policy's manifest records of its environment and training, beside its `policy_spec`."""
    sensor = sensor_settings(config.env)
    return {
        "exp": config.exp,
        "observation": KINDS[config.model.name].observation,
        "window_capacity": config.env.window_capacity,
        "sensor": sensor,
        "sensor_hash": settings_hash(sensor),
        "world": {name: getattr(config.env, name) for name in ("scene", "layout")}
        | {"faults": dataclasses.asdict(config.env.faults)}
        | ({"action_delay_ms": config.env.action_delay_ms} if config.env.action_delay_ms > 0 else {}),
        "conditions": config.train.conditions,
        "seed": config.seed,
        "algo": dataclasses.asdict(config.algo),
        **({} if config.train.init is None else {"init": config.train.init}),
        **({"plugins": plugin_digests()} if config.plugins else {}),
    }


def pretrained_encoder(config: Config, path: str | Path | None) -> tuple[str | Path, EncoderManifest] | None:
    """The encoder file with its manifest; None for a policy without one.

    Raises:
        ConfigError: It was made for another sensor, or for another model than the one to fine-tune.
        RunError: It is damaged.
        ValueError: A policy that needs one got none, or the other way round.
    """
    name, needed = config.model.name, KINDS[config.model.name].encoder
    if policy_spec(config).finetuned and config.train.init is not None:  # its networks hold their encoder
        return None
    if needed != (path is not None):
        raise ValueError(f"encoder_path must be {'a file' if needed else 'None'} for {name}, got {path!r}")
    if path is None:
        return None
    try:
        _, about = load_encoder(path)
    except EncoderFileError as error:
        marker = Path(path).parent.parent / "stages" / "pretrain.json"
        raise RunError(f"{error}; delete {marker}, and the same command makes the encoder anew") from None
    differ = differences(about["sensor"], sensor_settings(config.env))
    if differ:
        remedy = "use its settings, or pretrain an encoder for these"
        raise ConfigError(f"encoder: was made for another sensor: {differ}; {remedy}")
    spec = policy_spec(config)
    if spec.finetuned and spec.evae != about["model"]:
        raise ConfigError(f"encoder: must be one of {spec.evae} to be fine-tuned, got {about['model']}")
    return path, about
