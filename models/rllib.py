"""The policy inside RLlib: a module that owns the frozen encoder, and its connectors.

Each event window is encoded exactly once, on its way from the environment to the module
(`EncodeWindows`), and replaced there by the stack of latents: PPO's epochs and its bootstrap
values see `stack * latent` floats, and a raw window never reaches a learner. `models.policy`
is the same policy without Ray.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from ray.rllib.connectors.connector_v2 import ConnectorV2
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis import InferenceOnlyAPI, ValueFunctionAPI
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.core.rl_module.torch import TorchRLModule
from torch import Tensor

from models.networks import build_heads, push_latents, read_encoder_part, tabulate
from models.table import EncoderTable


def latent_space(stack: int, latent: int) -> gym.spaces.Box:
    """What the networks see: float32 (stack * latent,), oldest latent first."""
    return gym.spaces.Box(-np.inf, np.inf, (stack * latent,), np.float32)


class EncodedPolicyModule(TorchRLModule, InferenceOnlyAPI, ValueFunctionAPI):
    """Frozen encoder, policy network and value network.

    The encoder's tensors are in every checkpoint and every weight sync, and in no optimiser: a
    checkpoint is sufficient alone. `model_config` holds what `module_spec` puts there.
    """

    def setup(self) -> None:
        """Build the parts; called once by RLlib."""
        settings: Any = self.model_config
        self.encoder = read_encoder_part(**settings["encoder"])
        self.encoder_settings = settings["encoder"]["settings"]
        heads = build_heads(settings, settings["seed"])
        self.pi, self.vf = heads["pi"], heads["vf"]
        self._table: EncoderTable | None = None

    def get_non_inference_attributes(self) -> list[str]:
        """What an env runner does without."""
        return ["vf"]

    def train(self, mode: bool = True) -> "EncodedPolicyModule":
        """Keep every part as it is: the encoder stays frozen, tanh networks have no modes.

        RLlib toggles the mode around every forward pass; a walk through all parts each
        time would take longer than the pass, and would let running statistics move.
        """
        self.training = mode
        return self

    def encode(self, windows: np.ndarray) -> np.ndarray:
        """Latents float32 (B, latent) of event windows int32 (B, capacity + 1, 4)."""
        if self._table is None:
            self._table = tabulate(self.encoder, self.encoder_settings)
        return self._table.encode_windows(windows)

    def set_state(self, state: dict[str, Any]) -> None:
        """Load weights; the table is built anew only if they change the encoder."""
        before = [value.clone() for value in self.encoder.state_dict().values()]
        super().set_state(state)
        if not all(map(torch.equal, before, self.encoder.state_dict().values())):
            self._table = None

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the table, which is built from the encoder where it is needed."""
        return {**self.__dict__, "_table": None}

    def _forward(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        return {Columns.ACTION_DIST_INPUTS: self.pi(batch[Columns.OBS])}

    def compute_values(self, batch: dict[str, Any], embeddings: Any = None) -> Tensor:
        """Values float32 (B,) of the batch's observations."""
        return self.vf(batch[Columns.OBS]).squeeze(-1)


def module_spec(
    encoder_path: str | Path, manifest: Mapping[str, Any], settings: Mapping[str, Any], seed: int
) -> RLModuleSpec:
    """Specification of the module.

    Args:
        encoder_path: The frozen encoder's file.
        manifest: Of that file.
        settings: What `build_heads` reads.
        seed: Of the networks' initial weights.
    """
    encoder = {"path": str(encoder_path), "digest": manifest["sha256"], "settings": manifest["model"]}
    return RLModuleSpec(
        module_class=EncodedPolicyModule,
        observation_space=latent_space(settings["stack"], settings["latent"]),
        action_space=gym.spaces.Discrete(settings["num_actions"]),
        model_config={**settings, "encoder": encoder, "seed": seed},
    )


class EncodeWindows(ConnectorV2):
    """Env-to-module: replace each episode's newest window by its stack of latents."""

    def __init__(
        self,
        input_observation_space: gym.Space | None = None,
        input_action_space: gym.Space | None = None,
        *,
        stack: int,
        latent: int,
    ) -> None:
        """Keep the sizes; spaces are RLlib's."""
        self.stack, self.latent = stack, latent
        super().__init__(input_observation_space, input_action_space)

    def recompute_output_observation_space(
        self, input_observation_space: gym.Space, input_action_space: gym.Space
    ) -> gym.Space:
        """The space of a stack of latents."""
        return latent_space(self.stack, self.latent)

    def __call__(self, *, rl_module: Any, batch: dict[str, Any], episodes: list[Any], **kwargs: Any) -> Any:
        """Encode the newest window of all episodes in one call.

        RLlib calls this after each step with every episode, also with those that this
        step ended: a truncated flight's last window is encoded for its bootstrap value.
        """
        windows = np.stack([episode.get_observations(-1) for episode in episodes])
        latents = rl_module.encode(windows)
        first = np.array([episode.t == 0 for episode in episodes])
        stacks = np.zeros((len(episodes), self.stack * self.latent), np.float32)
        for row, episode in enumerate(episodes):
            if not first[row]:
                stacks[row] = episode.get_observations(-2)
        for episode, stacked in zip(episodes, push_latents(stacks, latents, first), strict=True):
            episode.observation_space = self.observation_space
            episode.set_observations(at_indices=-1, new_data=stacked)
        return batch


class ScaleRewards(ConnectorV2):
    """Learner: put scaled rewards into the train batch; episodes keep the true ones."""

    def __init__(
        self,
        input_observation_space: gym.Space | None = None,
        input_action_space: gym.Space | None = None,
        *,
        scale: float,
    ) -> None:
        """Keep the factor; spaces are RLlib's."""
        self.scale = scale
        super().__init__(input_observation_space, input_action_space)

    def __call__(self, *, rl_module: Any, batch: dict[str, Any], episodes: list[Any], **kwargs: Any) -> Any:
        """Fill the rewards column, which RLlib then leaves alone."""
        for episode in self.single_agent_episode_iterator(episodes, agents_that_stepped_only=False):
            count = len(episode)
            rewards = np.asarray(episode.get_rewards(slice(0, count)), np.float32) * self.scale
            self.add_n_batch_items(batch, Columns.REWARDS, rewards, count, episode)
        return batch
