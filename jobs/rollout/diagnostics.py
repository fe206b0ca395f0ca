"""What a rollout can be trusted for: the event error of its simulation, and the drift of its encoder.

A frozen event VAE was pretrained on other episodes than the policy's own. `drift` is the mean
reconstruction error of a pixel over windows of one control step that the policy met, divided by the
same error over the held-out windows of one control step of the encoder's own recording: 1 where the
policy meets what the encoder knows, 1.2 where a pixel's error is a fifth larger. A picture with more
events has a larger error too; `policy_explained_loss` and `policy_auc` say whether it is told from
others as well as before.
"""

import statistics
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from envs.config import EnvConfig
from envs.corridor import CorridorEnv
from envs.event_error import measure_event_error
from jobs.run.progress import console
from models.encoder.evae import EventVAE, event_targets, validate
from models.encoder.event_batch import batch_packed, cut_packed
from models.encoder.weights import load_encoder
from models.policy.policy import ENCODER

DRIFT_METRICS = ("policy_reconstruction", "policy_kl", "policy_explained_loss", "policy_auc", "drift")
MAX_WINDOWS = 512


def report_event_error(config: EnvConfig) -> dict[str, float]:
    """Measure the event error of a simulation, print it, and return it as metrics.

    A camera that follows the paper's two-frame difference is measured against one that
    remembers, so its error is what that difference loses; the tolerance does not bind it.
    """
    accuracy = measure_event_error(config)
    asked = config.fidelity.tolerance
    text = (
        f"Event error in {config.scene}: {accuracy.error:.1%} (asked: at most {asked:.1%}), "
        f"{accuracy.renders:.1f} renders a step"
    )
    if config.camera.memory != "reference":
        text += f"; memory={config.camera.memory} is the cause of most of it"
    elif accuracy.error > asked:
        text += "; more than asked: lower fidelity.max_step_m, or raise fidelity.samples"
    console.print(text, markup=False)
    return {"sim/event_error": accuracy.error, "sim/renders_per_step": accuracy.renders}


class DriftSampler:
    """Samples event windows during a rollout, to measure how well the policy's encoder knows them.

    All windows at first, later those of every second, fourth, ... step of each episode: at most
    `MAX_WINDOWS`, the same steps of all episodes. For an agent without an encoder it samples nothing.
    """

    def __init__(self, agent: str | Path) -> None:
        """Sample for the policy of a folder; a baseline's name stands for an agent without encoder."""
        self._file = Path(agent) / ENCODER
        self._sampling = self._file.is_file()
        self._every, self._steps = 1, Counter[int]()
        self._kept: list[tuple[int, np.ndarray]] = []

    @property
    def windows(self) -> list[np.ndarray]:
        """Return the sampled windows, packed, in the order in which they were met."""
        return [window for _, window in self._kept]

    def add(self, env: CorridorEnv, seed: int, observation: np.ndarray) -> None:
        """Sample the window of a step, if it is its turn (`jobs.rollout.episodes.Watch`)."""
        if not self._sampling:
            return
        step = self._steps[seed]
        self._steps[seed] += 1
        if step % self._every == 0:
            self._kept.append((step, cut_packed(observation)))
        while len(self._kept) > MAX_WINDOWS:
            self._every *= 2
            self._kept = [kept for kept in self._kept if kept[0] % self._every == 0]

    def metrics(self) -> dict[str, float]:
        """Return the `drift_metrics` of the samples; empty without samples or without a decoder."""
        if not self.windows:
            return {}
        evae, manifest = load_encoder(self._file)
        if evae.decoder is None:
            return {}
        return drift_metrics(evae, self.windows, manifest.get("figures", {}))


def drift_metrics(
    evae: EventVAE, windows: Sequence[np.ndarray], held_out: Mapping[str, float]
) -> dict[str, float]:
    """Return metrics of an event VAE on the windows that a policy met.

    Args:
        evae: In eval mode.
        windows: Packed windows int32 (rows, 4), at least one.
        held_out: The encoder's own metrics, of its manifest.

    Returns:
        `policy_reconstruction`, `policy_kl`, `policy_explained_loss` and `policy_auc` as
        `models.encoder.evae.validate` defines them, and `drift` where the encoder's own error of one
        control step is known. Empty for the target "proximity", which nobody knows of these windows.
    """
    if evae.target == "proximity":
        return {}
    batch = batch_packed(windows, evae.grid)
    values = validate(evae, batch, event_targets(batch, evae.target))
    metrics = {f"policy_{name}": values[name] for name in ("reconstruction", "kl", "explained_loss", "auc")}
    own = held_out.get("reconstruction_step", 0.0)
    return metrics | ({"drift": values["reconstruction"] / own} if own > 0 else {})


def mean_drift(trainings: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Return the mean `drift_metrics` of trainings; those without an encoder are left out."""
    measured = [metrics for metrics in trainings if metrics]
    names = dict.fromkeys(name for metrics in measured for name in metrics)
    return {
        f"evae/{name}": statistics.fmean(metrics[name] for metrics in measured if name in metrics)
        for name in names
    }
