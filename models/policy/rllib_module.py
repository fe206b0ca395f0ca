"""A policy inside RLlib: a module that owns the networks and the encoder.

`features` computes the features of a step (`models.policy.features`); the networks read stacks of the last
ones, which the env runners keep. `models.policy.policy` is the same policy without Ray.
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
from models.policy.memory import remember, windows_us
from models.policy.mirror import mirror
from models.policy.networks import PARTS, build_networks, widened
from models.policy.policy import load_networks

PRIVILEGED = "privileged"  # of a batch: what the value network alone is told, float32 (B, numbers)
VALUE_ROWS = 256  # of a whole batch at once: its activations then stay in the processor's cache


class EncoderFile(NamedTuple):
    """The file of a pretrained encoder.

    Attributes:
        path: Of the tensors.
        digest: Their SHA-256.
        settings: Of the event VAE.
    """

    path: str
    digest: str
    settings: EvaeSettings


def stack_space(spec: PolicySpec) -> gym.spaces.Box:
    """What the networks read: (depth, *feature), as `models.policy.memory` keeps it."""
    feature = feature_of(spec)
    whole = np.issubdtype(feature.dtype, np.integer)
    low, high = (np.iinfo(feature.dtype).min, np.iinfo(feature.dtype).max) if whole else (-np.inf, np.inf)
    return gym.spaces.Box(low, high, (spec.depth, *feature.shape(spec)), feature.dtype)


class PolicyModule(TorchRLModule, InferenceOnlyAPI, ValueFunctionAPI):
    """Frozen encoder, where the policy has one, and the networks.

    The encoder's tensors are in every checkpoint and every weight sync, and in no optimiser: a
    checkpoint is complete in itself. A fine-tuned encoder is the networks' trunk instead.
    `model_config` holds what `module_spec` puts there. What is `PRIVILEGED` only widens the first layer of
    the value network, and a policy that is exported is without it.
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
        self._table: Encoder | None = None

    def get_non_inference_attributes(self) -> list[str]:
        """What an env runner does without."""
        return ["vf"]

    def train(self, mode: bool = True) -> "PolicyModule":
        """Keep every part as it is: an encoder stays in eval mode, the other networks have no modes.

        RLlib toggles the mode around every forward pass; a walk through all parts each
        time would take longer than the pass, and would let running statistics move.
        """
        self.training = mode
        return self

    def networks(self) -> nn.ModuleDict:
        """The networks, as `models.policy.networks.assemble` names them, without what is `PRIVILEGED`."""
        own = {**{name: getattr(self, name) for name in PARTS}, "vf": widened(self.vf, -self.privileged)}
        return nn.ModuleDict(own)

    def features(self, observations: Windows) -> np.ndarray:
        """Features (B, ...) of B observations, as those of `models.policy.policy.Policy`."""
        if self.encoder is not None:
            self._table = self._table or tabulate(self.encoder, self.model_config["encoder_file"].settings)
        return self._features(observations)

    def _features(self, observations: Windows) -> np.ndarray:
        return feature_of(self.spec).from_observations(observations, self.spec, self._table)

    def remember(self, kept: np.ndarray, observations: Windows, first: np.ndarray) -> np.ndarray:
        """What the networks read, with the features of the newest observations (`models.policy.memory`)."""
        features = self.features(observations)
        return remember(kept, features, first, self.spec, windows_us(observations, self.spec))

    def remember_mirrored(self, kept: np.ndarray, observations: Windows, first: np.ndarray) -> np.ndarray:
        """As `remember`, of what would be seen if left and right were exchanged; to be called after it."""
        features = self._features(mirror(observations, self.spec))
        return remember(kept, features, first, self.spec, windows_us(observations, self.spec))

    def set_state(self, state: Any) -> None:
        """Load weights; the table is built anew only if they change the encoder."""
        if self.encoder is None:
            super().set_state(state)
            return
        before = [value.clone() for value in self.encoder.state_dict().values()]
        super().set_state(state)
        if not all(map(torch.equal, before, self.encoder.state_dict().values())):
            self._table = None

    def __getstate__(self) -> dict[str, object]:
        """Everything but the windows and the table, which is built from the encoder where it is needed."""
        return {**self.__dict__, "_table": None}

    def _forward(self, batch: dict[str, Tensor], **kwargs: object) -> dict[str, Tensor]:
        return {Columns.ACTION_DIST_INPUTS: self.pi(self.trunk(batch[Columns.OBS]))}

    def _forward_train(self, batch: dict[str, Tensor], **kwargs: object) -> dict[str, Tensor]:
        """The same, and what the trunk gives, so that the value's loss need not run it again."""
        embeddings = self.trunk(batch[Columns.OBS])
        return {Columns.ACTION_DIST_INPUTS: self.pi(embeddings), Columns.EMBEDDINGS: embeddings}

    def compute_values(self, batch: dict[str, Tensor], embeddings: Tensor | None = None) -> Tensor:
        """Values float32 (B,) of the batch's observations, and of what is `PRIVILEGED`.

        Without the trunk's embeddings no gradient is kept: RLlib asks so for the targets, of
        the whole batch, whose graph would be a gigabyte of activations.
        """
        told = [batch[PRIVILEGED]] if self.privileged else []
        if embeddings is not None:
            return self._judge(embeddings, *told)
        with torch.no_grad():
            parts = zip(*(column.split(VALUE_ROWS) for column in (batch[Columns.OBS], *told)), strict=True)
            return torch.cat([self._judge(self.trunk(stacks), *more) for stacks, *more in parts])

    def _judge(self, embeddings: Tensor, *privileged: Tensor) -> Tensor:
        """Values float32 (B,)."""
        return self.vf(torch.cat([embeddings, *privileged], dim=1)).squeeze(-1)


def _begin(networks: nn.ModuleDict, file: Path, spec: PolicySpec) -> None:
    """Load the weights of a policy's file; NaN if it is not there, which a checkpoint's own then replace."""
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
    """Specification of the module.

    Args:
        spec: What the networks are built from.
        seed: Of the networks' initial weights.
        encoder: The pretrained encoder's file and its manifest; None for a policy without one.
        init: The file of networks to begin from instead.
        privileged: Numbers that the value network alone is told of each step.
    """
    # Only what is used: Tune continues a training only under the keys that it began with.
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
        },
    )
