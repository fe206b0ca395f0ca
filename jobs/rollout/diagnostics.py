"""Diagnostics of a rollout: the event error of its simulation, and the drift of the policy's encoder.

A frozen event VAE was pretrained on other episodes than the policy's own. `drift` is the mean
reconstruction error per pixel on event windows of the rollout, divided by the same error on held-out
windows of the encoder's own recording; all windows last one control step. It is 1 if the encoder
reconstructs both equally well, and 1.2 if the error in the rollout is a fifth larger. A picture with more
events has a larger error too; `policy_explained_loss` and `policy_auc` show whether the reconstruction
still follows the single window.
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

    The reference always keeps a level per pixel (`memory=reference`). For a camera that uses the paper's
    two-frame difference, the error is therefore mostly that of the difference, which the tolerance does
    not limit.
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
    """Samples event windows during a rollout, to measure how well the policy's encoder reconstructs them.

    It starts with every step. Whenever it has more than `MAX_WINDOWS`, it drops every other sampled step, so
    that it samples every second, fourth, ... step, the same steps in all episodes.
    """

    def __init__(self, agent: str | Path) -> None:
        """Sample for the policy in the folder `agent`; a baseline's name samples nothing."""
        self._file = Path(agent) / ENCODER
        self._samples = self._file.is_file()  # False for an agent without an encoder
        self._every, self._steps = 1, Counter[int]()
        self._kept: list[tuple[int, np.ndarray]] = []

    @property
    def windows(self) -> list[np.ndarray]:
        """Return the sampled windows, packed, in the order of sampling."""
        return [window for _, window in self._kept]

    def add(self, env: CorridorEnv, seed: int, observation: np.ndarray) -> None:
        """Sample the window of this step if the step is due (a `jobs.rollout.episodes.Watch`)."""
        if not self._samples:
            return
        step = self._steps[seed]
        self._steps[seed] += 1
        if step % self._every == 0:
            self._kept.append((step, cut_packed(observation)))
        while len(self._kept) > MAX_WINDOWS:
            self._every *= 2
            self._kept = [kept for kept in self._kept if kept[0] % self._every == 0]

    def metrics(self) -> dict[str, float]:
        """Return the `drift_metrics` of the samples; empty if there are no samples or no decoder."""
        if not self.windows:
            return {}
        evae, manifest = load_encoder(self._file)
        if evae.decoder is None:
            return {}
        return drift_metrics(evae, self.windows, manifest.get("figures", {}))


def drift_metrics(
    evae: EventVAE, windows: Sequence[np.ndarray], held_out: Mapping[str, float]
) -> dict[str, float]:
    """Return metrics of an event VAE on windows from a policy's episodes.

    Args:
        evae: In eval mode.
        windows: Packed windows int32 (rows, 4), at least one.
        held_out: Held-out metrics from the encoder's manifest.

    Returns:
        `policy_reconstruction`, `policy_kl`, `policy_explained_loss` and `policy_auc` as
        `models.encoder.evae.validate` defines them, and `drift` if the manifest has the error of one
        control step. Empty for the target "proximity": the true proximity of these windows is unknown.
    """
    if evae.target == "proximity":
        return {}
    batch = batch_packed(windows, evae.grid)
    values = validate(evae, batch, event_targets(batch, evae.target))
    metrics = {f"policy_{name}": values[name] for name in ("reconstruction", "kl", "explained_loss", "auc")}
    own = held_out.get("reconstruction_step", 0.0)
    return metrics | ({"drift": values["reconstruction"] / own} if own > 0 else {})


def mean_drift(trainings: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Return the mean `drift_metrics` of trainings, without the trainings that have no encoder."""
    measured = [metrics for metrics in trainings if metrics]
    names = dict.fromkeys(name for metrics in measured for name in metrics)
    return {
        f"evae/{name}": statistics.fmean(metrics[name] for metrics in measured if name in metrics)
        for name in names
    }
