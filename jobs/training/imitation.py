"""Imitation of a planner that knows the geometry, in PPO's machinery (DAgger: Ross et al. 2011).

The env runners roll out the student, in the first batches mixed with the teacher, and the teacher says
of each step what each action would have cost: of those, too, to which the student strayed. All steps are
kept; after each batch the networks learn to act as their labels say. After the last they begin anew from
their first weights: networks that learnt few corridors first keep to those, and do worse in new ones than
networks that see all of them from the start (Ash and Adams 2020). The value network learns nothing.

Mirrored, a step is kept a second time with left and right exchanged, in what was seen as in its labels.
"""

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from ray.rllib.core import DEFAULT_MODULE_ID
from ray.rllib.core.columns import Columns
from ray.rllib.core.learner.learner import ENTROPY_KEY, POLICY_LOSS_KEY
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.utils.metrics import NUM_ENV_STEPS_SAMPLED_LIFETIME
from torch import Tensor
from torch.nn.functional import cross_entropy

from envs.kinematics import MIRRORED_ACTIONS
from jobs.training.ppo_learner import PlainPPOLearner, shared_threads
from jobs.training.snapshots import Snapshot
from jobs.training.teacher import TeacherEnvRunner

IMITATION = "imitation"  # of the learner's own settings: those of `ImitationConfig`, and env_steps
COSTS = "costs"  # of a step: what each action costs more than the cheapest, float32 (actions,)
MIRRORED = "mirrored"  # of a step: the stack of an episode with left and right exchanged
AGREEMENT_KEY = (
    "agreement"  # share of the newest steps in which the student's likeliest action is the cheapest
)


class TaughtEnvRunner(TeacherEnvRunner):
    """As `PlainEnvRunner`; the teacher labels every step, and acts in some."""

    @property
    def _settings(self) -> Any:
        return self.config.learner_config_dict[IMITATION]

    @property
    def teacher_share(self) -> float:
        """Of the steps of this round."""
        done = self._callbacks[0].rounds
        return 0.5**done if done < self._settings["guided_batches"] else 0.0

    def snapshot(self) -> Snapshot:
        """As `PlainEnvRunner`'s."""
        snapshot = super().snapshot()
        if self._settings.get(MIRRORED) and "stacks" in snapshot.arrays:
            snapshot.arrays[MIRRORED] = self._mirrored
        return snapshot

    def _replay(self, snapshot: Snapshot) -> str:
        if self._settings.get(MIRRORED):
            self._mirrored = snapshot.arrays[MIRRORED]
        return super()._replay(snapshot)

    def _remember(self, observations: Any, first: np.ndarray) -> None:
        super()._remember(observations, first)
        if self._settings.get(MIRRORED):
            kept = np.zeros_like(self._stacks) if first.all() else self._mirrored
            self._mirrored = self.module.remember_mirrored(kept, observations, first)

    def _decide(self, stacks: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        actions, outputs = super()._decide(stacks)
        costs = self.costs()
        costs = (costs - costs.min(axis=1, keepdims=True)).astype(np.float32)
        if self.teacher_share > 0.0:
            by_teacher = torch.rand(len(stacks)).numpy() < self.teacher_share
            actions = np.where(by_teacher, costs.argmin(axis=1), actions)
        mirrored = {MIRRORED: self._mirrored} if self._settings.get(MIRRORED) else {}
        return actions, {**outputs, COSTS: costs, **mirrored}


class Lessons:
    """Steps with their labels, of all batches; beyond a bound, a random sample of all."""

    def __init__(self, most_bytes: float) -> None:
        self.most_bytes, self.seen = most_bytes, 0
        self.stacks, self.costs = np.empty(0), np.empty(0)

    def __len__(self) -> int:
        return min(self.seen, len(self.stacks))

    def add(self, stacks: np.ndarray, costs: np.ndarray) -> None:
        """Keep steps (N, ...) and costs (N, actions); each step seen is as likely kept as any other."""
        if not self.seen:
            self._make_room(stacks, costs)
        numbers = self.seen + np.arange(len(stacks))
        drawn = (torch.rand(len(stacks), dtype=torch.float64).numpy() * (numbers + 1)).astype(np.int64)
        places = np.where(numbers < len(self.stacks), numbers, drawn)
        kept = places < len(self.stacks)
        self.stacks[places[kept]], self.costs[places[kept]] = stacks[kept], costs[kept]
        self.seen += len(stacks)

    def draw(self, count: int) -> dict[str, Tensor]:
        """So many rows at random."""
        rows = torch.randint(len(self), (count,))
        columns = {Columns.OBS: self.stacks, COSTS: self.costs}
        return {name: torch.from_numpy(column)[rows] for name, column in columns.items()}

    def arrays(self) -> dict[str, np.ndarray]:
        """All of it, for `load`."""
        size = len(self)
        return {"stacks": self.stacks[:size], "costs": self.costs[:size], "seen": np.array(self.seen)}

    def load(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Go on from `arrays`."""
        self.seen, size = int(arrays["seen"]), len(arrays["stacks"])
        if size:
            self._make_room(arrays["stacks"], arrays["costs"])
            self.stacks[:size], self.costs[:size] = arrays["stacks"], arrays["costs"]

    def _make_room(self, stacks: np.ndarray, costs: np.ndarray) -> None:
        """As many rows like these as the bound allows; pages that nobody wrote cost nothing."""
        most = max(1, int(self.most_bytes / (stacks[0].nbytes + costs[0].nbytes)))
        self.stacks = np.empty((most, *stacks.shape[1:]), stacks.dtype)
        self.costs = np.empty((most, *costs.shape[1:]), costs.dtype)


class ImitationLearner(PlainPPOLearner):
    """Learns the teacher's labels by cross-entropy, from the steps of all batches."""

    def build(self) -> None:
        """As PPO's learner."""
        super().build()
        self._settings: dict[str, Any] = self.config.learner_config_dict[IMITATION]
        self._mirrored: bool = self._settings.get(MIRRORED, False)
        self._lessons = Lessons(1e6 * self._settings["keep_mb"])
        self._first = copy.deepcopy(self.module[DEFAULT_MODULE_ID].unwrapped().state_dict())

    def update(self, *, timesteps: Mapping[str, int] | None = None, **asked: Any) -> Any:
        """Learn from all steps so far, longer if there will be no more; arguments and result as PPO's."""
        sampled = dict(timesteps or {}).get(NUM_ENV_STEPS_SAMPLED_LIFETIME, 0)
        self._last = sampled >= self._settings["env_steps"]
        return super().update(timesteps=timesteps, **asked)

    def kept(self) -> dict[str, np.ndarray]:
        """The lessons."""
        return self._lessons.arrays()

    def keep(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Go on with lessons."""
        self._lessons.load(arrays)

    def _threads(self) -> int:
        """Those of `shared_threads` for dense networks too: minibatches of 512 rows are worth it."""
        return shared_threads(self.config)

    def _rows(self, episodes: Sequence[SingleAgentEpisode]) -> dict[str, Tensor]:
        """The steps of all episodes, one after the other."""
        columns = {
            Columns.OBS: [np.asarray(episode.get_observations())[:-1] for episode in episodes],
            Columns.ACTIONS: [episode.get_actions() for episode in episodes],
        }
        for name in (Columns.ACTION_DIST_INPUTS, COSTS, *([MIRRORED] if self._mirrored else [])):
            columns[name] = [episode.get_extra_model_outputs(name) for episode in episodes]
        return {name: torch.from_numpy(np.concatenate(parts)) for name, parts in columns.items()}

    def _improve(self, rows: dict[str, Tensor], num_epochs: int, minibatch_size: int) -> dict[str, Any]:
        """Gradient steps on random rows of all so far; the means of their figures."""
        likeliest, costs = rows[Columns.ACTION_DIST_INPUTS].argmax(1, keepdim=True), rows[COSTS]
        self._lessons.add(rows[Columns.OBS].numpy(), costs.numpy())
        if self._mirrored:
            self._lessons.add(rows[MIRRORED].numpy(), costs.numpy()[:, MIRRORED_ACTIONS])
        count = self._settings["final_steps" if self._last else "fit_steps"]
        optimizer = self.get_optimizer(DEFAULT_MODULE_ID)
        if self._last:
            self.module[DEFAULT_MODULE_ID].unwrapped().load_state_dict(self._first)
            optimizer.state.clear()
        figures: dict[str, Tensor] = {}
        for step in range(count):
            if self._last:
                optimizer.param_groups[0]["lr"] = self.config.lr * (1.0 - step / count)
            for name, figure in self._step(self._lessons.draw(minibatch_size)).items():
                # Into one array: a tensor kept for each step lies between the minibatches in memory, and the
                # allocator then does not use their places again (gigabytes in 20,000 steps).
                if not step:
                    figures[name] = torch.empty(count)
                figures[name][step] = figure
        if self._last:
            self._lessons = Lessons(0)  # which a checkpoint would hold otherwise
        means = {name: values.mean() for name, values in figures.items()}
        return means | {AGREEMENT_KEY: (costs.gather(1, likeliest) == 0.0).float().mean()}

    def _on_gpu(self) -> None:
        """Nothing: lessons are gigabytes, and stay with the processor."""

    def _loss(self, module: Any, rows: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """Cross-entropy of the labels, softmax(-cost / temperature); and the policy's entropy."""
        logits = module._forward_train(rows)[Columns.ACTION_DIST_INPUTS]
        labels = torch.softmax(-rows[COSTS] / self._settings["temperature"], dim=-1)
        loss = cross_entropy(logits, labels)
        logps = torch.log_softmax(logits.detach(), dim=-1)
        figures = {POLICY_LOSS_KEY: loss.detach(), ENTROPY_KEY: -(logps.exp() * logps).sum(-1).mean()}
        return loss, figures
