"""A policy inside RLlib: a module that owns the networks and the encoder.

`features` computes the features of a step (`models.policy.features`). The networks read stacks of the latest
features, which the env runners store. `models.policy.policy` is the same policy without Ray.
"""

import math
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis import InferenceOnlyAPI, ValueFunctionAPI
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.core.rl_module.torch import TorchRLModule
from torch import Tensor, nn

from models.encoder.frozen import Encoder, read_encoder_part, tabulate
from models.encoder.weights import EncoderManifest
from models.kinds import EvaeSettings, PolicySpec
from models.policy.features import Windows, feature_of
from models.policy.memory import kept_shape, remember, windows_us
from models.policy.mirror import mirror
from models.policy.networks import PARTS, build_networks, network_of, widened
from models.policy.policy import load_networks

STATE = "h"  # RLlib's key of the one part of a recurrent state
PRIVILEGED = "privileged"  # key of a batch: inputs of the value network alone, float32 (B, numbers)
SEQUENCE = 32  # steps through which the gradient of a recurrent network flows
VALUE_ROWS = 256  # rows of a batch computed together, so that activations stay in the CPU cache


class EncoderFile(NamedTuple):
    """The file of a pretrained encoder.

    Attributes:
        path: File of the tensors.
        digest: SHA-256 of this file.
        settings: Settings of the event VAE.
    """

    path: str
    digest: str
    settings: EvaeSettings


def stack_space(spec: PolicySpec) -> gym.spaces.Box:
    """Return the space of the networks' input: (depth, *feature), see `models.policy.memory`."""
    feature = feature_of(spec)
    whole = np.issubdtype(feature.dtype, np.integer)
    low, high = (np.iinfo(feature.dtype).min, np.iinfo(feature.dtype).max) if whole else (-np.inf, np.inf)
    return gym.spaces.Box(low, high, kept_shape(spec), feature.dtype)


class PolicyModule(TorchRLModule, InferenceOnlyAPI, ValueFunctionAPI):
    """The networks of a policy, and its frozen encoder, if any, as an RLlib module.

    The encoder's tensors are in every checkpoint and every weight sync, but in no optimiser, so that a
    checkpoint is complete in itself. A fine-tuned encoder is the networks' trunk instead.
    `module_spec` fills `model_config`. `PRIVILEGED` inputs only widen the first layer of the value network;
    an exported policy does not have them.
    """

    def setup(self) -> None:
        """Build the parts; called once by RLlib."""
        self.spec: PolicySpec = self.model_config["spec"]
        file: EncoderFile | None = self.model_config["encoder_file"]
        part = None if file is None else read_encoder_part(*file)
        networks = build_networks(self.spec, self.model_config["seed"])
        if part is not None and self.spec.finetuned:
            networks["trunk"].load_state_dict(part.state_dict())
            part = None
        if "init" in self.model_config:
            _begin(networks, Path(self.model_config["init"]), self.spec)
        self.privileged: int = self.model_config.get(PRIVILEGED, 0)
        networks["vf"] = widened(networks["vf"], self.privileged)
        self.encoder = part
        self.trunk, self.pi, self.vf = (networks[name] for name in PARTS)
        self.network = network_of(self.spec)
        self.state_size = self.network.state(self.spec)
        self._table: Encoder | None = None

    def get_non_inference_attributes(self) -> list[str]:
        """Return the parts that an env runner does not need."""
        return ["vf"]

    def train(self, mode: bool = True) -> "PolicyModule":
        """Set the mode of this module alone: an encoder stays in eval mode, the other networks have no modes.

        RLlib toggles the mode around every forward pass. Setting it in all parts each time would
        take longer than the pass, and would let running statistics change.
        """
        self.training = mode
        return self

    def networks(self) -> nn.ModuleDict:
        """Return the networks, named as in `networks.assemble`, without `PRIVILEGED` inputs."""
        own = {**{name: getattr(self, name) for name in PARTS}, "vf": widened(self.vf, -self.privileged)}
        return nn.ModuleDict(own)

    def features(self, observations: Windows) -> np.ndarray:
        """Return features (B, ...) of B observations, the same as in `models.policy.policy.Policy`."""
        if self.encoder is not None:
            self._table = self._table or tabulate(self.encoder, self.model_config["encoder_file"].settings)
        return self._features(observations)

    def _features(self, observations: Windows) -> np.ndarray:
        return feature_of(self.spec).from_observations(observations, self.spec, self._table)

    def remember(
        self,
        kept: np.ndarray,
        observations: Windows,
        first: np.ndarray,
        taken: np.ndarray,
        velocity_mps: np.ndarray | None = None,
        mirrored: bool = False,
    ) -> np.ndarray:
        """Return the networks' input after the newest observations (`models.policy.memory.remember`).

        With `mirrored` the observations are mirrored here, but the caller mirrors actions and velocities.
        Call it without `mirrored` first, which builds the encoder's table.
        """
        features = (
            self._features(mirror(observations, self.spec)) if mirrored else self.features(observations)
        )
        duration_us = windows_us(observations, self.spec)
        return remember(kept, features, first, self.spec, duration_us, taken, velocity_mps)

    def set_state(self, state: Any) -> None:
        """Load weights; discard the encoder's table only if the encoder changes."""
        if self.encoder is None:
            super().set_state(state)
            return
        before = [value.clone() for value in self.encoder.state_dict().values()]
        super().set_state(state)
        if not all(map(torch.equal, before, self.encoder.state_dict().values())):
            self._table = None

    def __getstate__(self) -> dict[str, object]:
        """Return everything but the table, which is rebuilt from the encoder when needed."""
        return {**self.__dict__, "_table": None}

    def get_initial_state(self) -> dict[str, Tensor]:
        """Return the state at the start of an episode in RLlib's form; empty unless recurrent."""
        return {STATE: torch.zeros(self.state_size)} if self.state_size else {}

    def _embed(self, batch: dict[str, Any]) -> tuple[Tensor, dict[str, Any]]:
        """Return the trunk's outputs, and the next state in RLlib's form.

        A recurrent network reads sequences (B, T, depth, ...), all others rows (B, depth, ...).
        """
        if not self.state_size:
            return self.trunk(batch[Columns.OBS]), {}
        embeddings, state = self.trunk(batch[Columns.OBS], batch[Columns.STATE_IN][STATE])
        return embeddings, {Columns.STATE_OUT: {STATE: state}}

    def _forward(self, batch: dict[str, Any], **kwargs: object) -> dict[str, Any]:
        embeddings, state = self._embed(batch)
        return {Columns.ACTION_DIST_INPUTS: self.pi(embeddings), **state}

    def _forward_train(self, batch: dict[str, Any], **kwargs: object) -> dict[str, Any]:
        """Return the trunk's outputs too, so that the value loss need not run the trunk again."""
        embeddings, state = self._embed(batch)
        return {Columns.ACTION_DIST_INPUTS: self.pi(embeddings), Columns.EMBEDDINGS: embeddings, **state}

    def compute_values(self, batch: dict[str, Any], embeddings: Tensor | None = None) -> Tensor:
        """Return the values float32 (B,), or (B, T) for sequences, of observations and `PRIVILEGED` inputs.

        Without the trunk's embeddings no gradient is recorded: RLlib calls it this way for the
        targets of the whole batch, whose graph would take a gigabyte of activations.
        """
        told = [batch[PRIVILEGED]] if self.privileged else []
        if embeddings is not None:
            return self._judge(embeddings, *told)
        with torch.no_grad():
            if self.state_size:
                return self._judge(self._embed(batch)[0], *told)
            parts = zip(*(column.split(VALUE_ROWS) for column in (batch[Columns.OBS], *told)), strict=True)
            return torch.cat([self._judge(self.trunk(stacks), *more) for stacks, *more in parts])

    def _judge(self, embeddings: Tensor, *privileged: Tensor) -> Tensor:
        """Return the values float32 (B,) or (B, T)."""
        return self.vf(torch.cat([embeddings, *privileged], dim=-1)).squeeze(-1)


def _begin(networks: nn.ModuleDict, file: Path, spec: PolicySpec) -> None:
    """Load initial weights from a policy's file; if it is missing, NaN, which a checkpoint then replaces."""
    if file.is_file():
        networks.load_state_dict(load_networks(file, spec).state_dict())
    else:
        for value in networks.parameters():
            value.data.fill_(math.nan)


def module_spec(
    spec: PolicySpec,
    seed: int,
    encoder: tuple[str | Path, EncoderManifest] | None = None,
    init: Path | None = None,
    privileged: int = 0,
) -> RLModuleSpec:
    """Return RLlib's specification of the module.

    Args:
        spec: Specification of the networks.
        seed: Seed of the networks' initial weights.
        encoder: The pretrained encoder's file and its manifest; None for a policy without an encoder.
        init: File of networks whose weights replace the initial ones.
        privileged: Number of inputs that only the value network gets in each step.
    """
    # Unused keys are left out: Tune resumes a run only with the same keys.
    added = {"init": str(init) if init else None, PRIVILEGED: privileged}
    file = None
    if encoder is not None:
        path, manifest = encoder
        file = EncoderFile(str(path), manifest["sha256"], manifest["model"])
    return RLModuleSpec(
        module_class=PolicyModule,
        observation_space=stack_space(spec),
        action_space=gym.spaces.Discrete(spec.num_actions),
        model_config={
            **{"spec": spec, "encoder_file": file, "seed": seed},
            **{name: value for name, value in added.items() if value},
            **({"max_seq_len": SEQUENCE} if network_of(spec).state(spec) else {}),
        },
    )
