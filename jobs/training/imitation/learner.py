"""The learner of imitation (DAgger: Ross et al. 2011).

The student acts in the env runners; in the first batches the teacher acts in some steps. The teacher labels
every step with the cost of each action, also where the student strayed. The learner stores all steps, and
after each batch fits the policy's networks to the labels. After the last batch it restarts from the initial
weights: networks that first learnt from few corridors generalise worse than networks that see all
corridors from the start (Ash and Adams 2020). The value network is not trained.

With mirroring, each step is stored a second time with left and right exchanged, observation and label.

A recurrent network learns from windows of steps (`ppo.losses.windows`). Each starts from a zero state,
not from the state in which the env runner acted: that state came from weights that are later replaced.
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

from jobs.training.imitation.labelled_steps import COSTS, MIRRORED, SETTINGS, LabelledSteps, mirror_images
from jobs.training.ppo.learner import PlainPPOLearner, shared_threads
from jobs.training.ppo.losses import STARTS, TAKEN, windows
from jobs.training.sampling.env_runner import STATES
from models.policy.rllib_module import SEQUENCE, STATE

# Fraction of the newest steps in which the student's likeliest action is the cheapest.
AGREEMENT_KEY = "agreement"


def sequence_steps(config: Any) -> int:
    """Return a window's number of warm-up steps, which is also its number of steps to learn from.

    At most half of an episode's piece in a batch, because the first steps of a piece have no warm-up.
    """
    piece = config.train_batch_size_per_learner // (
        max(1, config.num_env_runners) * config.num_envs_per_env_runner
    )
    return max(1, min(SEQUENCE, piece // 2))


class ImitationLearner(PlainPPOLearner):
    """Fits the policy to the teacher's labels by cross-entropy, on the steps of all batches."""

    def build(self) -> None:
        """Build PPO's learner, an empty store of steps, and a copy of the initial weights."""
        super().build()
        self._settings: dict[str, Any] = self.config.learner_config_dict[SETTINGS]
        self._mirrored = mirror_images(self._settings)
        self._steps = LabelledSteps(1e6 * self._settings["keep_mb"])
        self._first = copy.deepcopy(self.module[DEFAULT_MODULE_ID].unwrapped().state_dict())

    def update(self, *, timesteps: Mapping[str, int] | None = None, **asked: Any) -> Any:
        """Fit to all steps so far, longer after the last batch; arguments and result as in PPO's learner."""
        sampled = dict(timesteps or {}).get(NUM_ENV_STEPS_SAMPLED_LIFETIME, 0)
        self._last = sampled >= self._settings["env_steps"]
        return super().update(timesteps=timesteps, **asked)

    def own_state(self) -> dict[str, np.ndarray]:
        """Return the stored steps."""
        return self._steps.arrays()

    def set_own_state(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Continue with the stored steps of `own_state`."""
        self._steps.load(arrays)

    def _threads(self) -> int:
        """Return `shared_threads` for dense networks too: minibatches of 512 rows are worth it."""
        return shared_threads(self.config)

    def _rows(self, episodes: Sequence[SingleAgentEpisode]) -> dict[str, Tensor]:
        """Return the steps of all episodes, one after the other, as columns."""
        columns = {
            Columns.OBS: [np.asarray(episode.get_observations())[:-1] for episode in episodes],
            Columns.ACTIONS: [episode.get_actions() for episode in episodes],
        }
        told = [Columns.ACTION_DIST_INPUTS, COSTS]
        told += [MIRRORED] * bool(self._mirrored) + [STATES] * bool(self._policy.state_size)
        for name in told:
            columns[name] = [episode.get_extra_model_outputs(name) for episode in episodes]
        columns[STARTS] = [np.arange(len(episode)) for episode in episodes]
        return {name: torch.from_numpy(np.concatenate(parts)) for name, parts in columns.items()}

    def _improve(self, rows: dict[str, Tensor], num_epochs: int, minibatch_size: int) -> dict[str, Any]:
        """Take gradient steps on random rows of all steps so far; return the means of their metrics."""
        likeliest, costs = rows[Columns.ACTION_DIST_INPUTS].argmax(1, keepdim=True), rows[COSTS]
        if self._policy.state_size:
            length = sequence_steps(self.config)
            rows, minibatch_size = windows(rows, length, length), max(1, minibatch_size // length)
        self._keep(rows)
        count = self._settings["final_steps" if self._last else "fit_steps"]
        optimizer = self.get_optimizer(DEFAULT_MODULE_ID)
        if self._last:
            self.module[DEFAULT_MODULE_ID].unwrapped().load_state_dict(self._first)
            optimizer.state.clear()
        figures: dict[str, Tensor] = {}
        for step in range(count):
            if self._last:
                optimizer.param_groups[0]["lr"] = self.config.lr * (1.0 - step / count)
            for name, figure in self._step(self._steps.draw(minibatch_size)).items():
                # One array: a tensor stored per step would lie between the minibatches in memory, and the
                # allocator would not reuse their space (gigabytes in 20,000 steps).
                if not step:
                    figures[name] = torch.empty(count)
                figures[name][step] = figure
        if self._last:
            self._steps = LabelledSteps(0)  # keeps the steps out of the last checkpoint
        means = {name: values.mean() for name, values in figures.items()}
        return means | {AGREEMENT_KEY: (costs.gather(1, likeliest) == 0.0).float().mean()}

    def _keep(self, rows: Mapping[str, Tensor]) -> None:
        """Store rows and, with mirroring, their mirror images."""
        own = {"taken": rows[TAKEN].numpy()} if TAKEN in rows else {}
        costs = rows[COSTS].numpy()
        self._steps.add(stacks=rows[Columns.OBS].numpy(), costs=costs, **own)
        if self._mirrored:
            self._steps.add(stacks=rows[MIRRORED].numpy(), costs=costs[..., self._mirrored], **own)

    def _on_gpu(self) -> None:
        """Return None: the stored steps do not fit on the GPU."""

    def _loss(self, module: Any, rows: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the cross-entropy of the labels softmax(-cost / temperature), and the policy's entropy."""
        taken = rows.get(TAKEN)
        if taken is not None:
            rows = {**rows, Columns.STATE_IN: {STATE: torch.zeros(len(taken), module.state_size)}}
        logits, costs = module._forward_train(rows)[Columns.ACTION_DIST_INPUTS], rows[COSTS]
        if taken is not None:
            logits, costs = logits[taken], costs[taken]
        labels = torch.softmax(-costs / self._settings["temperature"], dim=-1)
        loss = cross_entropy(logits, labels)
        logps = torch.log_softmax(logits.detach(), dim=-1)
        figures = {POLICY_LOSS_KEY: loss.detach(), ENTROPY_KEY: -(logps.exp() * logps).sum(-1).mean()}
        return loss, figures
