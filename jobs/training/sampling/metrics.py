"""Metrics of the episodes that an env runner samples."""

from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from ray.rllib.callbacks.callbacks import RLlibCallback

from jobs.rollout.diagnostics import drift_metrics
from jobs.training.sampling.env_runner import PlainEnvRunner
from models.encoder.evae import EventVAE
from models.encoder.weights import EncoderFileError, EncoderManifest, load_encoder

EPISODES = 100  # newest ones, over which metrics are averaged
REWARD_SCALE = "reward_scale"  # in an `env_config`: the factor by which environments multiply rewards
DRIFT_EVERY = 10  # rounds of sampling: a measurement takes a tenth of a second


class EpisodeMetrics(RLlibCallback):
    """Metrics of episodes, from the environments' infos; returns are of unscaled rewards.

    Only two or three episodes end per iteration, so metrics are means over the last `EPISODES`. Episodes
    count in the order of their start, and all that start in one round of sampling count together. In the
    order of their end, short episodes, which are crashes, would count first.

    Attributes:
        rounds: Number of rounds of sampling so far.
    """

    def __init__(self) -> None:
        """Start without episodes."""
        self._episodes: deque[dict[str, float]] = deque(maxlen=EPISODES)
        self._begun: deque[dict[str, dict[str, float] | None]] = deque()  # per round; None: running
        self._unfinished: dict[str, float] = {}
        self.rounds = 0
        self._encoder: tuple[EventVAE, EncoderManifest] | None = None

    def on_sample_end(self, *, metrics_logger: Any, samples: Any, env_runner: Any, **kwargs: Any) -> None:
        """Log events, means over ended episodes and, every `DRIFT_EVERY` rounds, the encoder's drift."""
        if isinstance(env_runner, PlainEnvRunner) and self.rounds % DRIFT_EVERY == 0:
            for name, value in self._drift(env_runner).items():
                metrics_logger.log_value(name, value, window=1)
        self.rounds += 1
        events, dropped = (
            np.concatenate([_column(chunk, key) for chunk in samples])
            for key in ("num_events", "dropped_events")
        )
        metrics_logger.log_value("events_per_step", float(events.mean()), window=1)
        metrics_logger.log_value("dropped_events", float(dropped.sum()), window=1)
        self._count(samples, env_runner.config.env_config.get(REWARD_SCALE, 1.0))
        for name in self._episodes[0] if self._episodes else ():
            mean = float(np.mean([episode[name] for episode in self._episodes]))
            metrics_logger.log_value(name, mean, window=1)

    def _count(self, samples: Any, reward_scale: float) -> None:
        """Store ended episodes; add a round's to the averaged ones once they and all earlier ones ended."""
        self._begun.append({chunk.id_: None for chunk in samples if chunk.id_ not in self._unfinished})
        for chunk in samples:
            earned = float(chunk.get_return()) / reward_scale
            self._unfinished[chunk.id_] = self._unfinished.get(chunk.id_, 0.0) + earned
            if chunk.is_done:
                ended = outcome(chunk.get_infos(-1), self._unfinished.pop(chunk.id_))
                next(begun for begun in self._begun if chunk.id_ in begun)[chunk.id_] = ended
        broken_off = self._unfinished.keys() - {chunk.id_ for chunk in samples}
        for name in broken_off:
            del self._unfinished[name], next(begun for begun in self._begun if name in begun)[name]
        while self._begun and None not in self._begun[0].values():
            self._episodes.extend(ended for ended in self._begun.popleft().values() if ended)

    def state(self) -> dict[str, Any]:
        """Return the state on which the next metrics depend, as values for JSON."""
        return {
            "rounds": self.rounds,
            "episodes": list(self._episodes),
            "begun": [dict(begun) for begun in self._begun],
            "unfinished": dict(self._unfinished),
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Restore a `state`."""
        self.rounds = state["rounds"]
        self._episodes = deque(state["episodes"], maxlen=EPISODES)
        self._begun = deque(dict(begun) for begun in state["begun"])
        self._unfinished = dict(state["unfinished"])

    def _drift(self, runner: PlainEnvRunner) -> dict[str, float]:
        """Return the `jobs.rollout.diagnostics.drift_metrics` of the windows that the encoder has read.

        They are empty without an encoder, or if its file is missing, changed or has no decoder: the frozen
        part that acts has no decoder either.
        """
        file, windows = runner.module.model_config["encoder_file"], runner.shown.windows
        if file is None or not windows:
            return {}
        if self._encoder is None:
            try:
                with torch.random.fork_rng(devices=[]):  # a new model draws random weights
                    self._encoder = load_encoder(file.path)
            except EncoderFileError:
                return {}
        evae, manifest = self._encoder
        if manifest["sha256"] != file.digest or evae.decoder is None:
            return {}
        return drift_metrics(evae, windows, manifest.get("figures", {}))


def outcome(info: Mapping[str, float], episode_return: float) -> dict[str, float]:
    """Return the metrics of an episode that has ended, from its last info."""
    return {
        "episode_return": episode_return,
        "success_rate": float(info["success"]),
        "collision_rate": float(info["collision"]),
        "distance_m": float(info["distance_m"]),
    }


def _column(chunk: Any, key: str) -> np.ndarray:
    """Return the value `key` of the infos after each step of an episode's piece, (T,)."""
    infos = chunk.get_infos()
    return infos[key][1:] if isinstance(infos, Mapping) else np.array([info[key] for info in infos[1:]])
