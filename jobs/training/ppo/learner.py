"""RLlib's PPO learner with all minibatches of an iteration in one loop.

The value targets, the loss, its gradient and the optimiser are RLlib's (`test_ppo_learner.py`
compares them, and the weights after an update). Around each minibatch of 32 steps RLlib slices,
dispatches, times and logs, which takes longer than the gradient of two small networks; here that
is done once per iteration, and no connector pipeline builds the batch. Policies of dense layers
alone take their steps in `models.policy.dense_update`. RLlib appends a row to each episode to
bootstrap its value. It masks this row in the loss, but counts it in minibatches and in the mean and
deviation of the advantages; here the row counts in neither. Recurrent networks learn from sequences of
steps (Hausknecht and Stone 2015): each starts with the state in which the env runner acted.
"""

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from ray.rllib.algorithms.ppo.ppo import LEARNER_RESULTS_VF_EXPLAINED_VAR_KEY
from ray.rllib.algorithms.ppo.torch.ppo_torch_learner import PPOTorchLearner
from ray.rllib.core import DEFAULT_MODULE_ID
from ray.rllib.core.columns import Columns
from ray.rllib.core.learner.learner import ENTROPY_KEY, POLICY_LOSS_KEY, VF_LOSS_KEY
from ray.rllib.core.learner.training_data import TrainingData
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.evaluation.postprocessing import Postprocessing
from ray.rllib.policy.sample_batch import MultiAgentBatch, SampleBatch
from ray.rllib.utils.metrics import NUM_ENV_STEPS_SAMPLED_LIFETIME
from torch import Tensor, nn

from jobs.run.device import learner_device
from jobs.run.torch_threads import torch_threads
from jobs.training.ppo.gpu_steps import NORM, TOTAL, GpuSteps
from jobs.training.ppo.losses import FIRST_ROW, STARTS, TAKEN, advantages, mean_over, sequences, shaping
from jobs.training.sampling.env_runner import STATES
from jobs.training.sampling.rllib_internals import LEARNER, require
from jobs.training.sampling.teacher import log_costs
from models.policy.dense_update import Rows, Settings, update_dense
from models.policy.rllib_module import PRIVILEGED, SEQUENCE, STATE

READ = (
    Columns.OBS,
    PRIVILEGED,
    Columns.ACTIONS,
    Columns.ACTION_LOGP,
    Postprocessing.ADVANTAGES,
    Postprocessing.VALUE_TARGETS,
)
GRADIENT_NORM_KEY = "gradients_default_optimizer_global_norm"
# Metrics of a minibatch, in the order in which `update_dense` returns them.
FIGURES = (POLICY_LOSS_KEY, VF_LOSS_KEY, ENTROPY_KEY, PPOTorchLearner.TOTAL_LOSS_KEY, GRADIENT_NORM_KEY)
MOST_THREADS = 8
MIN_DEVIATION = 1e-4  # smallest divisor of the advantages, as in RLlib
# Keys of the learner's own settings.
REWARD_SCALE = "reward_scale"  # factor of the rewards in the learner; episodes have unscaled rewards
SHAPING = "shaping"  # rewards are shaped by the potential -shaping * `log_costs`
VALUE_WARMUP = "value_warmup"  # environment steps in which only the value network learns


def _minibatch(parts: dict[str, Tensor], picked: Tensor) -> dict[str, Any]:
    """Return the picked sequences in the form that the loss reads."""
    rows = {name: part[picked] for name, part in parts.items()}
    return {**rows, Columns.STATE_IN: {STATE: rows.pop(STATES)}}


def shared_threads(config: Any) -> int:
    """Return the learner's number of threads: one per env runner, at most `MOST_THREADS`.

    The env runners wait meanwhile. The number of cores does not matter: more threads would add sums in
    another order, and a training that is resumed on another machine must give the same weights.
    """
    return max(1, min(config.num_env_runners, MOST_THREADS))


class PlainPPOLearner(PPOTorchLearner):
    """PPO for one module with discrete actions, without the KL penalty, on one device."""

    def build(self) -> None:
        """Build RLlib's learner and, if there is a GPU, its `GpuSteps`."""
        super().build()
        require(self, LEARNER)
        self._warming_up = False
        self._gpu = self._on_gpu()

    def configure_optimizers_for_module(self, module_id: str, config: Any = None) -> None:
        """Register an Adam that updates all parameters in one call."""
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
        timesteps: Mapping[str, int] | None = None,
        num_epochs: int = 1,
        minibatch_size: int | None = None,
        **kwargs: Any,
    ) -> Any:
        """Run all epochs over the steps of one iteration, in another random order in each epoch.

        Args:
            training_data: The episodes as RLlib passes them; None: `episodes` has them.
            episodes: The episodes, if `training_data` is None.
            timesteps: Counters that schedules follow.
            num_epochs: Passes over the steps.
            minibatch_size: Steps per gradient; None: all.
            kwargs: RLlib's other arguments, for other kinds of data.

        Returns:
            Metrics, as RLlib's learner returns them; losses are means over the last epoch.

        Raises:
            RuntimeError: A gradient is not finite; its step is not taken.
        """
        counters = dict(timesteps or {})
        self.before_gradient_based_update(timesteps=counters)
        training_data = training_data or TrainingData(episodes=episodes)
        self._weights_seq_no += 1
        before = counters.get(NUM_ENV_STEPS_SAMPLED_LIFETIME, 0) - sum(map(len, training_data.episodes))
        self._warming_up = before < self.config.learner_config_dict.get(VALUE_WARMUP, -math.inf)
        with torch_threads(self._threads()):
            rows = self._rows(training_data.episodes)
            count = len(rows[Columns.ACTIONS])
            figures = self._improve(rows, num_epochs, minibatch_size or count)
        self.metrics.log_dict(figures, key=DEFAULT_MODULE_ID, window=1)
        steps = SampleBatch({Columns.ACTIONS: rows[Columns.ACTIONS]})
        self._log_steps_trained_metrics(MultiAgentBatch({DEFAULT_MODULE_ID: steps}, env_steps=count))
        self.after_gradient_based_update(timesteps=counters)
        return self.metrics.reduce()

    def _improve(self, rows: dict[str, Tensor], num_epochs: int, minibatch_size: int) -> dict[str, Any]:
        """Run all epochs over the rows; return the metrics of the last epoch."""
        orders = torch.stack([torch.randperm(len(rows[Columns.ACTIONS])) for _ in range(num_epochs)])
        learn = self._epochs_compiled if self._compiled and not self._warming_up else self._epochs
        if self._gpu is not None:
            learn = partial(self._epochs_on_gpu, self._gpu)
        elif self._policy.state_size:
            learn = self._epochs_of_sequences
        figures = learn(rows, orders, minibatch_size)
        if self._warming_up:
            self.get_optimizer(DEFAULT_MODULE_ID).state.clear()  # Adam has one count of steps for all weights
        return figures | {LEARNER_RESULTS_VF_EXPLAINED_VAR_KEY: self._explained_variance(rows)}

    def own_state(self) -> dict[str, np.ndarray]:
        """Return the state on which the next updates depend, besides RLlib's own: none here."""
        return {}

    def set_own_state(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Restore the `own_state` of an earlier process, which is among these arrays."""

    def _threads(self) -> int:
        """Return `shared_threads`, or 1 for networks whose compiled steps are too small to share."""
        return 1 if self._compiled else shared_threads(self.config)

    @property
    def _policy(self) -> Any:
        """Return the `PolicyModule` that learns."""
        return self.module[DEFAULT_MODULE_ID].unwrapped()

    @property
    def _compiled(self) -> bool:
        """Whether `models.policy.dense_update` takes the gradient steps."""
        return bool(self._policy.network.gradients == "compiled")

    def _rows(self, episodes: Sequence[SingleAgentEpisode]) -> dict[str, Tensor]:
        """Return the steps of all episodes, one after the other, with the targets of the loss."""
        config, module = self.config, self._policy
        shown = [np.asarray(episode.get_observations()) for episode in episodes]
        ends = np.cumsum([len(observations) for observations in shown])
        stacks, privileged = np.concatenate(shown), np.empty((ends[-1], module.privileged), np.float32)
        if module.privileged:
            privileged[:, 0] = np.concatenate([log_costs(episode) for episode in episodes])
        told = {Columns.OBS: torch.from_numpy(stacks), PRIVILEGED: torch.from_numpy(privileged)}
        values = self._values(told, episodes).numpy()
        estimates = [
            advantages(
                of_episode, self._rewards(episode), episode.is_terminated, config.gamma, config.lambda_
            )
            for of_episode, episode in zip(np.split(values, ends[:-1]), episodes, strict=True)
        ]
        taken = np.ones(len(stacks), bool)
        taken[ends - 1] = False
        estimate = np.concatenate(estimates)
        with np.errstate(invalid="ignore"):  # an infinite reward makes gradients NaN, which are an error
            standard = (estimate - estimate.mean()) / max(MIN_DEVIATION, estimate.std())
        columns = {
            Columns.OBS: stacks[taken],
            PRIVILEGED: privileged[taken],
            Columns.ACTIONS: np.concatenate([episode.get_actions() for episode in episodes]),
            Columns.ACTION_LOGP: np.concatenate(
                [episode.get_extra_model_outputs(Columns.ACTION_LOGP) for episode in episodes]
            ),
            Postprocessing.ADVANTAGES: standard.astype(np.float32),
            Postprocessing.VALUE_TARGETS: (estimate + values[taken]).astype(np.float32),
        }
        if module.state_size:
            columns[STATES] = np.concatenate(
                [episode.get_extra_model_outputs(STATES) for episode in episodes]
            )
            columns[STARTS] = np.concatenate([np.arange(len(episode)) for episode in episodes])
        return {name: torch.from_numpy(column) for name, column in columns.items()}

    def _rewards(self, episode: SingleAgentEpisode) -> np.ndarray:
        """Return an episode's rewards for learning: shaped if `SHAPING` is set, and scaled."""
        settings, rewards = self.config.learner_config_dict, episode.get_rewards()
        if settings.get(SHAPING, 0.0):
            potentials = -settings[SHAPING] * log_costs(episode)
            rewards = rewards + shaping(potentials, episode.is_terminated, self.config.gamma)
        return settings.get(REWARD_SCALE, 1.0) * rewards

    def _epochs_compiled(
        self, rows: dict[str, Tensor], orders: Tensor, minibatch_size: int
    ) -> dict[str, Any]:
        """Take the steps of `_epochs` in one compiled call."""
        config, module = self.config, self._policy
        optimizer = self.get_optimizer(DEFAULT_MODULE_ID)
        adam = optimizer.param_groups[0]
        beta1, beta2 = adam["betas"]
        settings = Settings(
            minibatch_size,
            clip_param=float(config.clip_param),
            vf_loss_coeff=float(config.vf_loss_coeff),
            vf_clip_param=float(config.vf_clip_param),
            entropy_coeff=float(self._entropy_coeff),
            grad_clip=float(self._grad_clip),
            lr=float(adam["lr"]),
            beta1=float(beta1),
            beta2=float(beta2),
            eps=float(adam["eps"]),
        )
        read = Rows(*(rows[name].numpy() for name in READ))
        read = read._replace(stacks=rows[Columns.OBS].flatten(1).numpy())
        means = update_dense((module.pi, module.vf), optimizer, read, orders.numpy(), settings)
        return dict(zip(FIGURES, means.tolist(), strict=True))

    def _on_gpu(self) -> GpuSteps | None:
        """Return `GpuSteps` if the learner has a GPU and the network takes its steps there, else None."""
        module, device = self._policy, learner_device()
        if device == "cpu" or module.network.gradients != "gpu":
            return None
        return GpuSteps(module, self.get_optimizer(DEFAULT_MODULE_ID), self._loss, device)

    def _epochs_on_gpu(
        self, gpu: GpuSteps, rows: dict[str, Tensor], orders: Tensor, minibatch_size: int
    ) -> dict[str, Tensor]:
        """Take the steps of `_epochs` on the GPU."""
        told = gpu.take(
            self._policy,
            self.get_optimizer(DEFAULT_MODULE_ID),
            {name: rows[name] for name in READ},
            orders,
            minibatch_size,
            self._grad_clip,
            variant=(self._warming_up, self._entropy_coeff),
        )
        total, norm = told.pop(TOTAL), told.pop(NORM)
        return {**told, PPOTorchLearner.TOTAL_LOSS_KEY: total, GRADIENT_NORM_KEY: norm}

    def _values(self, told: dict[str, Tensor], episodes: Sequence[SingleAgentEpisode]) -> Tensor:
        """Return the values of all observations of some episodes, float32 (B,)."""
        if self._policy.state_size:
            return self._values_of_sequences(told, episodes)
        return self._values_of_rows(told)

    def _values_of_rows(self, told: dict[str, Tensor]) -> Tensor:
        """Return the values of rows, float32 (B,)."""
        module = self._policy
        return module.compute_values(told) if self._gpu is None else self._gpu.values(module, told)

    def _values_of_sequences(self, told: dict[str, Tensor], episodes: Sequence[SingleAgentEpisode]) -> Tensor:
        """Return the values of a recurrent network, episode by episode, each from its first state."""
        lengths = [len(episode) + 1 for episode in episodes]
        parts = {name: column.split(lengths) for name, column in told.items()}
        values = []
        for number, episode in enumerate(episodes):
            first = torch.from_numpy(episode.get_extra_model_outputs(STATES)[:1])
            own = {name: part[number][None] for name, part in parts.items()}
            values.append(self._policy.compute_values({**own, Columns.STATE_IN: {STATE: first}})[0])
        return torch.cat(values)

    def _epochs_of_sequences(
        self, rows: dict[str, Tensor], orders: Tensor, minibatch_size: int
    ) -> dict[str, Any]:
        """Run `_epochs` over sequences of at most `SEQUENCE` successive steps, each shuffled as a whole."""
        parts = sequences(rows, SEQUENCE)
        # If sequences are short, there are more than steps / SEQUENCE.
        everything = minibatch_size >= len(rows[Columns.ACTIONS])
        size = len(parts[FIRST_ROW]) if everything else max(1, minibatch_size // SEQUENCE)
        for order in orders:
            # Sort the sequences by the place of their first row in the order of rows.
            shuffled = order.argsort()[parts[FIRST_ROW]].argsort().split(size)
            figures = [self._step(_minibatch(parts, picked)) for picked in shuffled]
        return {name: torch.stack([one[name] for one in figures]).mean() for name in FIGURES}

    def _epochs(self, rows: dict[str, Tensor], orders: Tensor, minibatch_size: int) -> dict[str, Any]:
        """Pass over the rows once per order; return means over the minibatches of the last pass."""
        for order in orders:
            parts = [rows[key][order].split(minibatch_size) for key in READ]
            figures = [self._step(dict(zip(READ, part, strict=True))) for part in zip(*parts, strict=True)]
        return {name: torch.stack([one[name] for one in figures]).mean() for name in FIGURES}

    def _step(self, rows: dict[str, Tensor]) -> dict[str, Tensor]:
        """Take one gradient step; return its losses, entropy and the gradient's norm before clipping."""
        optimizer = self.get_optimizer(DEFAULT_MODULE_ID)
        parameters = optimizer.param_groups[0]["params"]
        total, figures = self._loss(self._policy, rows)
        optimizer.zero_grad(set_to_none=True)
        total.backward()
        norm = nn.utils.clip_grad_norm_(parameters, self._grad_clip, error_if_nonfinite=True)
        optimizer.step()
        return {**figures, PPOTorchLearner.TOTAL_LOSS_KEY: total.detach(), GRADIENT_NORM_KEY: norm}

    @property
    def _grad_clip(self) -> float:
        """Return the largest norm of a gradient."""
        return math.inf if self.config.grad_clip is None else self.config.grad_clip

    @property
    def _entropy_coeff(self) -> float:
        """Return the weight of the entropy now."""
        return float(self.entropy_coeff_schedulers_per_module[DEFAULT_MODULE_ID].get_current_value())

    def _loss(self, module: Any, rows: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """Return RLlib's PPO loss (clipped surrogate, squared value error and entropy) and its parts."""
        config = self.config
        out = module._forward_train(rows)
        logps = torch.log_softmax(out[Columns.ACTION_DIST_INPUTS], dim=-1)
        logp = logps.gather(-1, rows[Columns.ACTIONS].long()[..., None]).squeeze(-1)
        ratio, advantages = torch.exp(logp - rows[Columns.ACTION_LOGP]), rows[Postprocessing.ADVANTAGES]
        clipped = ratio.clamp(1.0 - config.clip_param, 1.0 + config.clip_param)
        mean = partial(mean_over, rows.get(TAKEN))
        policy_loss = -mean(torch.minimum(advantages * ratio, advantages * clipped))
        embeddings = out[Columns.EMBEDDINGS].detach() if self._warming_up else out[Columns.EMBEDDINGS]
        values = module.compute_values(rows, embeddings=embeddings)
        errors = (values - rows[Postprocessing.VALUE_TARGETS]).square().clamp(max=config.vf_clip_param)
        value_loss, entropy = mean(errors), -mean((logps.exp() * logps).sum(-1))
        total = policy_loss + config.vf_loss_coeff * value_loss - self._entropy_coeff * entropy
        if self._warming_up:
            total = config.vf_loss_coeff * value_loss
        figures = {POLICY_LOSS_KEY: policy_loss, VF_LOSS_KEY: value_loss, ENTROPY_KEY: entropy}
        return total, {name: value.detach() for name, value in figures.items()}

    @torch.no_grad()
    def _explained_variance(self, rows: dict[str, Tensor]) -> Tensor:
        """Return the fraction of the targets' variance that the values explain; at least -1, as in RLlib."""
        targets = rows[Postprocessing.VALUE_TARGETS]
        if self._policy.state_size:
            parts = sequences(rows, SEQUENCE)
            every = _minibatch(parts, torch.arange(len(parts[FIRST_ROW])))
            values = self._policy.compute_values(every)[every[TAKEN]]
            targets = every[Postprocessing.VALUE_TARGETS][every[TAKEN]]
        else:
            values = self._values_of_rows({name: rows[name] for name in (Columns.OBS, PRIVILEGED)})
        unexplained = (targets - values).var() / targets.var().clamp_min(1e-12)
        return (1.0 - unexplained).clamp_min(-1.0)
