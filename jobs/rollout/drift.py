"""Drift: how well a frozen event VAE knows the windows that a policy meets.

It was pretrained on other flights than the policy's own. `drift` is the mean reconstruction
error of a pixel over windows of one control step that the policy met, divided by the same error
over the held-out windows of one control step of the encoder's own recording: 1 where the policy
meets what the encoder knows, 1.2 where a pixel's error is a fifth larger. A picture with more
events has a larger error too; `policy_explained_loss` and `policy_auc` say whether it is told from
others as well as before.
"""

import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from models.encoder.evae import EventVAE, event_targets, validate
from models.encoder.event_batch import batch_packed, cut_packed
from models.encoder.weights import load_encoder
from models.policy.policy import ENCODER

FIGURES = ("policy_reconstruction", "policy_kl", "policy_explained_loss", "policy_auc", "drift")
MAX_WINDOWS = 512


class DriftWatch:
    """Keeps windows while a policy with an event VAE is flown, and says how well that knows them.

    All windows at first, and of many those of every second, fourth, ... step of each flight: at most
    `MAX_WINDOWS`, the same steps of all flights. Of an agent without an encoder it keeps nothing.
    """

    def __init__(self, agent: str | Path) -> None:
        """Watch the policy of a folder; a bound's name stands for an agent without encoder."""
        self._file = Path(agent) / ENCODER
        self._watching = self._file.is_file()
        self._every, self._steps = 1, Counter[int]()
        self._kept: list[tuple[int, np.ndarray]] = []

    @property
    def windows(self) -> list[np.ndarray]:
        """The windows kept, packed, in the order in which they were met."""
        return [window for _, window in self._kept]

    def add(self, env: Any, seed: int, observation: np.ndarray, info: Mapping[str, Any]) -> None:
        """Keep the window of a step, if it is its turn (`jobs.rollout.episodes.Watch`)."""
        if not self._watching:
            return
        step = self._steps[seed]
        self._steps[seed] += 1
        if step % self._every == 0:
            self._kept.append((step, cut_packed(observation)))
        while len(self._kept) > MAX_WINDOWS:
            self._every *= 2
            self._kept = [kept for kept in self._kept if kept[0] % self._every == 0]

    def figures(self) -> dict[str, float]:
        """The `drift_figures` of what was met; none if nothing was, or if a lean encoder draws nothing."""
        if not self.windows:
            return {}
        evae, manifest = load_encoder(self._file)
        if evae.decoder is None:
            return {}
        return drift_figures(evae, self.windows, manifest.get("figures", {}))


def drift_figures(
    evae: EventVAE, windows: Sequence[np.ndarray], held_out: Mapping[str, float]
) -> dict[str, float]:
    """Figures of an event VAE on the windows that a policy met.

    Args:
        evae: In eval mode.
        windows: Packed windows int32 (rows, 4), at least one.
        held_out: The encoder's own figures, of its manifest.

    Returns:
        `policy_reconstruction`, `policy_kl`, `policy_explained_loss` and `policy_auc` as
        `models.encoder.evae.validate` defines them, and `drift` where the encoder's own error of one
        control step is known.
    """
    batch = batch_packed(windows, evae.grid)
    values = validate(evae, batch, event_targets(batch, evae.target))
    figures = {f"policy_{name}": values[name] for name in ("reconstruction", "kl", "explained_loss", "auc")}
    own = held_out.get("reconstruction_step", 0.0)
    return figures | ({"drift": values["reconstruction"] / own} if own > 0 else {})


def mean_figures(kept: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Mean over trainings of what each policy's encoder made of its flights; none without encoders."""
    names = dict.fromkeys(name for values in kept for name in values["encoder"])
    return {
        f"evae/{name}": statistics.fmean(
            values["encoder"][name] for values in kept if name in values["encoder"]
        )
        for name in names
    }
