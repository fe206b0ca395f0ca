"""What decides: networks from a stack of features to logits and a value, each as three parts.

    logits = pi(trunk(stack)),   value = vf(trunk(stack))

`NETWORKS` says how each is put together; a part without weights costs nothing. Weights are
those of a later `initialise`, or of a file.
"""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from models.encoder.finetuned import FinetunedEncoder
from models.kinds import kind_of
from models.policy.event_set import OUTPUTS, EventSet
from models.policy.features import feature_of

PARTS = ("trunk", "pi", "vf")
# Of the last layer's weights; all other layers have sqrt(2) (stable-baselines' policies).
LAST_GAIN = {"pi": 0.01, "vf": 1.0}
CNN_OUTPUTS = 512


def build_networks(settings: Mapping[str, Any], seed: int = 0) -> nn.ModuleDict:
    """The networks of a policy with its initial weights.

    Args:
        settings: As in a manifest: `name`, `stack`, `hidden` and `num_actions`, and what the
            feature's shape follows from.
        seed: Of the weights.
    """
    return initialise(assemble(settings), seed)


def assemble(settings: Mapping[str, Any]) -> nn.ModuleDict:
    """The parts of a policy's networks (`PARTS`); their weights mean nothing yet."""
    build = NETWORKS[kind_of(settings).network]
    shape = (settings["stack"], *feature_of(settings).shape(settings))
    return nn.ModuleDict(dict(zip(PARTS, build(shape, settings), strict=True)))


def initialise(networks: nn.ModuleDict, seed: int) -> nn.ModuleDict:
    """Orthogonal weights and zero biases, as in stable-baselines' policies; returns the networks."""
    for offset, name in enumerate(("pi", "vf", "trunk")):
        generator = torch.Generator().manual_seed(seed + offset)
        layers = [part for part in networks[name].modules() if isinstance(part, nn.Linear | nn.Conv2d)]
        for layer in layers:
            gain = LAST_GAIN.get(name, math.sqrt(2.0)) if layer is layers[-1] else math.sqrt(2.0)
            nn.init.orthogonal_(layer.weight, gain, generator=generator)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
    return networks


def two_mlps(shape: Sequence[int], settings: Mapping[str, Any]) -> tuple[nn.Module, ...]:
    """Two separate networks of dense tanh layers (appendix D.1.2; stable-baselines' MlpPolicy)."""
    inputs, hidden = math.prod(shape), settings["hidden"]
    pi, vf = mlp(inputs, hidden, settings["num_actions"]), mlp(inputs, hidden, 1)
    return nn.Flatten(), pi, vf


def mlp(inputs: int, hidden: Sequence[int], outputs: int) -> nn.Sequential:
    """Dense tanh layers and a linear head."""
    layers: list[nn.Module] = []
    for fan_in, fan_out in itertools.pairwise([inputs, *hidden]):
        layers += [nn.Linear(fan_in, fan_out), nn.Tanh()]
    return nn.Sequential(*layers, nn.Linear([inputs, *hidden][-1], outputs))


def nature_cnn(shape: Sequence[int], settings: Mapping[str, Any]) -> tuple[nn.Module, ...]:
    """Convolutions that policy and value share, over the stacked pictures as channels.

    The sizes are those of Mnih et al. (Nature 2015), as in stable-baselines' CnnPolicy, which
    appendix D.1.2 names. Pictures need `models.kinds.MIN_IMAGE` pixels each way.
    """
    stack, *sides = shape
    height, width = (((side - 8) // 4 + 1 - 4) // 2 + 1 - 2 for side in sides)
    trunk = nn.Sequential(
        Bytes(),
        *(nn.Conv2d(stack, 32, 8, 4), nn.ReLU()),
        *(nn.Conv2d(32, 64, 4, 2), nn.ReLU()),
        *(nn.Conv2d(64, 64, 3, 1), nn.ReLU()),
        nn.Flatten(),
        *(nn.Linear(64 * height * width, CNN_OUTPUTS), nn.ReLU()),
    )
    return trunk, nn.Linear(CNN_OUTPUTS, settings["num_actions"]), nn.Linear(CNN_OUTPUTS, 1)


def event_set(shape: Sequence[int], settings: Mapping[str, Any]) -> tuple[nn.Module, ...]:
    """A network over sets of events that policy and value share (`models.policy.event_set`)."""
    trunk = EventSet(shape[0], (settings["width"], settings["height"]))
    return trunk, nn.Linear(OUTPUTS, settings["num_actions"]), nn.Linear(OUTPUTS, 1)


def finetuned_mlps(shape: Sequence[int], settings: Mapping[str, Any]) -> tuple[nn.Module, ...]:
    """The networks of `two_mlps` behind an encoder that they share, and that learns on."""
    _, pi, vf = two_mlps((shape[0], settings["latent"]), settings)
    return FinetunedEncoder(settings), pi, vf


class Bytes(nn.Module):
    """Bytes to numbers in [0, 1]; here, so that pictures travel and are stored as bytes."""

    def forward(self, pictures: Tensor) -> Tensor:
        """Scale uint8 (...) to float32 (...)."""
        return pictures.float().div_(255.0)


NETWORKS: dict[str, Callable[..., tuple[nn.Module, ...]]] = {
    "mlp": two_mlps,
    "cnn": nature_cnn,
    "set": event_set,
    "finetuned": finetuned_mlps,
}
