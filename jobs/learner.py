"""RLlib's PPO learner with all minibatches of an iteration in one loop.

The loss, its gradient and the optimiser are RLlib's (`tests/test_learner.py` compares the
weights after an update). Around each minibatch of 32 steps RLlib slices, dispatches, times and
logs, which takes longer than the gradient of two small networks; here that is done once per
iteration. The rows that RLlib appends to each flight to bootstrap its value, and masks in the
loss, are taken out, so that every minibatch holds as many steps as was asked.
"""

from collections.abc import Mapping
from typing import Any

import torch
from ray.rllib.algorithms.ppo.ppo import LEARNER_RESULTS_VF_EXPLAINED_VAR_KEY
from ray.rllib.algorithms.ppo.torch.ppo_torch_learner import PPOTorchLearner
from ray.rllib.core import DEFAULT_MODULE_ID
from ray.rllib.core.columns import Columns
from ray.rllib.core.learner.learner import ENTROPY_KEY, POLICY_LOSS_KEY, VF_LOSS_KEY
from ray.rllib.core.learner.training_data import TrainingData
from ray.rllib.evaluation.postprocessing import Postprocessing
from torch import Tensor, nn

READ = (
    Columns.OBS,
    Columns.ACTIONS,
    Columns.ACTION_LOGP,
    Postprocessing.ADVANTAGES,
    Postprocessing.VALUE_TARGETS,
)
GRADIENT_NORM_KEY = "gradients_default_optimizer_global_norm"
EXPLAINED_ROWS = 1024  # values are compared with their targets so many at a time


class PlainPPOLearner(PPOTorchLearner):
    """PPO for one module with discrete actions, without the divergence penalty, on one device."""

    def configure_optimizers_for_module(self, module_id: str, config: Any = None) -> None:
        """Adam with all its steps in one call."""
        parameters = [value for value in self._module[module_id].parameters() if value.requires_grad]
        self.register_optimizer(
            module_id=module_id,
            optimizer=torch.optim.Adam(parameters, fused=True),
            params=parameters,
            lr_or_lr_schedule=config.lr,
        )

    def update(
        self,
        *,
        training_data: TrainingData | None = None,
        episodes: list[Any] | None = None,
        timesteps: Mapping[str, Any] | None = None,
        num_epochs: int = 1,
        minibatch_size: int | None = None,
        **kwargs: Any,
    ) -> Any:
        """All epochs over the steps of one iteration, shuffled in each.

        Args:
            training_data: Flights, as RLlib hands them over; or else
            episodes: the flights themselves.
            timesteps: Counters that schedules follow.
            num_epochs: Passes over the steps.
            minibatch_size: Steps per gradient; None: all.
            kwargs: RLlib's other wishes, which concern other kinds of data.

        Returns:
            Metrics, as RLlib's learner returns them; losses are means over the last epoch.

        Raises:
            RuntimeError: A gradient is not finite; the weights are those before it.
        """
        counters = dict(timesteps or {})
        self.before_gradient_based_update(timesteps=counters)
        training_data = training_data or TrainingData(episodes=episodes)
        training_data.validate()
        training_data.solve_refs()
        self._weights_seq_no += 1
        batch = self._make_batch_if_necessary(training_data=training_data)
        steps = batch.policy_batches[DEFAULT_MODULE_ID]
        flown = steps[Columns.LOSS_MASK]
        rows = {key: steps[key][flown] for key in READ}
        for _ in range(num_epochs):
            figures = self._epoch(rows, minibatch_size or int(flown.sum()))
        figures[LEARNER_RESULTS_VF_EXPLAINED_VAR_KEY] = self._explained_variance(rows)
        self.metrics.log_dict(figures, key=DEFAULT_MODULE_ID, window=1)
        self._log_steps_trained_metrics(batch)
        self.after_gradient_based_update(timesteps=counters)
        return self.metrics.reduce()

    def _epoch(self, rows: dict[str, Tensor], minibatch_size: int) -> dict[str, Tensor]:
        """One pass over the rows in random order; the mean of each figure."""
        order = torch.randperm(len(rows[Columns.ACTIONS]))
        parts = [rows[key][order].split(minibatch_size) for key in READ]
        figures = [self._step(dict(zip(READ, part, strict=True))) for part in zip(*parts, strict=True)]
        return {name: torch.stack([one[name] for one in figures]).mean() for name in figures[0]}

    def _step(self, rows: dict[str, Tensor]) -> dict[str, Tensor]:
        """One gradient step; its losses, entropy and the gradient's norm before the clip."""
        optimizer = self.get_optimizer(DEFAULT_MODULE_ID)
        parameters = optimizer.param_groups[0]["params"]
        total, figures = self._loss(rows)
        optimizer.zero_grad(set_to_none=True)
        total.backward()
        limit = float("inf") if self.config.grad_clip is None else self.config.grad_clip
        norm = nn.utils.clip_grad_norm_(parameters, limit, error_if_nonfinite=True)
        optimizer.step()
        return {**figures, self.TOTAL_LOSS_KEY: total.detach(), GRADIENT_NORM_KEY: norm}

    def _loss(self, rows: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """The clipped surrogate, the value's squared error and the entropy, joined as RLlib joins them."""
        config, module = self.config, self.module[DEFAULT_MODULE_ID].unwrapped()
        out = module._forward_train(rows)
        logps = torch.log_softmax(out[Columns.ACTION_DIST_INPUTS], dim=-1)
        logp = logps.gather(1, rows[Columns.ACTIONS].long()[:, None]).squeeze(1)
        ratio, advantages = torch.exp(logp - rows[Columns.ACTION_LOGP]), rows[Postprocessing.ADVANTAGES]
        clipped = ratio.clamp(1.0 - config.clip_param, 1.0 + config.clip_param)
        policy_loss = -torch.minimum(advantages * ratio, advantages * clipped).mean()
        values = module.compute_values(rows, embeddings=out.get(Columns.EMBEDDINGS))
        errors = (values - rows[Postprocessing.VALUE_TARGETS]).square().clamp(max=config.vf_clip_param)
        value_loss, entropy = errors.mean(), -(logps.exp() * logps).sum(-1).mean()
        bonus = self.entropy_coeff_schedulers_per_module[DEFAULT_MODULE_ID].get_current_value()
        total = policy_loss + config.vf_loss_coeff * value_loss - bonus * entropy
        figures = {POLICY_LOSS_KEY: policy_loss, VF_LOSS_KEY: value_loss, ENTROPY_KEY: entropy}
        return total, {name: value.detach() for name, value in figures.items()}

    @torch.no_grad()
    def _explained_variance(self, rows: dict[str, Tensor]) -> Tensor:
        """Share of the targets' variance that the values explain after the update; at least -1, as RLlib."""
        module, targets = self.module[DEFAULT_MODULE_ID].unwrapped(), rows[Postprocessing.VALUE_TARGETS]
        parts = rows[Columns.OBS].split(EXPLAINED_ROWS)
        values = torch.cat([module.compute_values({Columns.OBS: part}) for part in parts])
        unexplained = (targets - values).var() / targets.var().clamp_min(1e-12)
        return (1.0 - unexplained).clamp_min(-1.0)
