"""Env runners of imitation: the student acts; the teacher labels every step and acts in some of them."""

from typing import Any

import numpy as np
import torch

from jobs.training.imitation.labelled_steps import COSTS, MIRRORED, SETTINGS, mirror_images
from jobs.training.sampling.snapshots import Snapshot
from jobs.training.sampling.teacher import TeacherEnvRunner

MIRROR = np.array([-1.0, 1.0])  # factors of a velocity (right, ahead) if left and right are exchanged


class TaughtEnvRunner(TeacherEnvRunner):
    """A `PlainEnvRunner` whose steps have the teacher's costs and, with mirroring, a mirrored observation."""

    @property
    def _settings(self) -> Any:
        return self.config.learner_config_dict[SETTINGS]

    @property
    def teacher_share(self) -> float:
        """Return the fraction of this round's steps in which the teacher acts."""
        done = self._callbacks[0].rounds
        return 0.5**done if done < self._settings["guided_batches"] else 0.0

    def snapshot(self) -> Snapshot:
        """Return the snapshot of `PlainEnvRunner`, with any mirrored observations."""
        snapshot = super().snapshot()
        if self._settings.get(MIRRORED) and "stacks" in snapshot.arrays:
            snapshot.arrays[MIRRORED] = self._mirrored
        return snapshot

    def _replay(self, snapshot: Snapshot) -> str:
        if self._settings.get(MIRRORED):
            self._mirrored = snapshot.arrays[MIRRORED]
        return super()._replay(snapshot)

    def _remember(self, observations: Any, first: np.ndarray, taken: np.ndarray) -> None:
        super()._remember(observations, first, taken)
        if images := mirror_images(self._settings):
            before = np.zeros_like(self._stacks) if first.all() else self._mirrored
            velocity = self.velocities_mps()
            velocity = None if velocity is None else velocity * MIRROR
            taken = np.array(images)[taken]
            self._mirrored = self.module.remember(before, observations, first, taken, velocity, mirrored=True)

    def _decide(self, stacks: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        actions, outputs = super()._decide(stacks)
        costs = self.costs()
        costs = (costs - costs.min(axis=1, keepdims=True)).astype(np.float32)
        if self.teacher_share > 0.0:
            by_teacher = torch.rand(len(stacks)).numpy() < self.teacher_share
            actions = np.where(by_teacher, costs.argmin(axis=1), actions)
        mirrored = {MIRRORED: self._mirrored} if self._settings.get(MIRRORED) else {}
        return actions, {**outputs, COSTS: costs, **mirrored}
