"""A policy's networks, from a stack of features to logits and a value, each as three parts.

    logits = pi(trunk(stack)),   value = vf(trunk(stack))

`models.kinds.KINDS` names the function that builds those of each kind of policy: it takes the shape of
the stack and the policy, and returns the parts. Weights come from `initialise`, or from a file.
"""

import copy
import itertools
import math
from collections.abc import Callable, Sequence
from operator import contains

import numpy as np
import torch
from torch import Tensor, nn

from core.places import resolve
from models.encoder.event_images import nature_layers
from models.encoder.finetuned import FinetunedEncoder
from models.encoder.products import Linear, orthogonal_
from models.encoder.table import dense
from models.kinds import PolicySpec
from models.policy.dense_update import tanh
from models.policy.event_set import OUTPUTS, EventSet, EventTables
from models.policy.features import feature_of

PARTS = ("trunk", "pi", "vf")
# Of the last layer's weights; all other layers have sqrt(2) (stable-baselines' policies).
LAST_GAIN = {"pi": 0.01, "vf": 1.0}
CNN_OUTPUTS = 512


def build_networks(spec: PolicySpec, seed: int = 0) -> nn.ModuleDict:
    """The networks of a policy with the initial weights of a seed."""
    return initialise(assemble(spec), seed)


def assemble(spec: PolicySpec) -> nn.ModuleDict:
    """The parts of a policy's networks (`PARTS`), to be initialised or loaded."""
    shape = (spec.depth, *feature_of(spec).shape(spec))
    return nn.ModuleDict(dict(zip(PARTS, resolve(spec.kind.network)(shape, spec), strict=True)))


def initialise(networks: nn.ModuleDict, seed: int) -> nn.ModuleDict:
    """Orthogonal weights and zero biases, as in stable-baselines' policies; returns the networks."""
    for offset, name in enumerate(("pi", "vf", "trunk")):
        generator = torch.Generator().manual_seed(seed + offset)
        layers = [part for part in networks[name].modules() if isinstance(part, nn.Linear | nn.Conv2d)]
        for layer in layers:
            gain = LAST_GAIN.get(name, math.sqrt(2.0)) if layer is layers[-1] else math.sqrt(2.0)
            orthogonal_(layer.weight, gain, generator)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
    return networks


def logits_by(trunk: nn.Module, pi: nn.Module) -> Callable[[np.ndarray], np.ndarray]:
    """What computes the logits float32 (B, actions) of stacks (B, depth, ...), by the weights of this moment.

    Dense networks and event sets give the same bytes in any batch, and run without torch, whose calls take
    ten times as long as the arithmetic of a few rows. All others run by torch.
    """
    if isinstance(trunk, nn.Flatten) and is_mlp(pi):
        return _dense_layers(pi)
    if isinstance(trunk, EventSet) and isinstance(pi, nn.Linear):
        features, decide = EventTables(trunk), _dense_layers(nn.Sequential(pi))
        return lambda stacks: decide(features(stacks))

    def by_torch(stacks: np.ndarray) -> np.ndarray:
        with torch.inference_mode():
            return pi(trunk(torch.from_numpy(stacks))).numpy()

    return by_torch


def _dense_layers(network: nn.Sequential) -> Callable[[np.ndarray], np.ndarray]:
    """What computes the outputs of dense layers with tanh between them, float32 (B, outputs)."""
    linear = [layer for layer in network if isinstance(layer, nn.Linear)]
    first, *layers = [
        [value.detach().numpy().copy() for value in (layer.weight, layer.bias)] for layer in linear
    ]

    def outputs_of(stacks: np.ndarray) -> np.ndarray:
        values = dense(stacks.reshape(len(stacks), math.prod(stacks.shape[1:])), *first)
        for weight, bias in layers:
            tanh(values.reshape(-1))
            values = dense(values, weight, bias)
        return values

    return outputs_of


def two_mlps(shape: Sequence[int], spec: PolicySpec) -> tuple[nn.Module, ...]:
    """Two separate networks of dense tanh layers (appendix D.1.2; stable-baselines' MlpPolicy)."""
    inputs, hidden = math.prod(shape), spec.hidden
    return nn.Flatten(), mlp(inputs, hidden, spec.num_actions), mlp(inputs, hidden, 1)


def mlp(inputs: int, hidden: Sequence[int], outputs: int) -> nn.Sequential:
    """Dense tanh layers and a linear head."""
    layers: list[nn.Module] = []
    for fan_in, fan_out in itertools.pairwise([inputs, *hidden]):
        layers += [Linear(fan_in, fan_out), nn.Tanh()]
    return nn.Sequential(*layers, Linear([inputs, *hidden][-1], outputs))


def is_mlp(network: nn.Module) -> bool:
    """Whether `mlp` could have built it: what is compiled for such networks would compute others wrong."""
    layers = list(network) if isinstance(network, nn.Sequential) else []
    kinds = [(nn.Tanh,) if place % 2 else (nn.Linear, Linear) for place in range(len(layers))]
    biased = all(layer.bias is not None for layer in layers[::2] if isinstance(layer, nn.Linear))
    return len(layers) % 2 == 1 and all(map(contains, kinds, map(type, layers))) and biased


def widened(network: nn.Module, inputs: int) -> nn.Module:
    """A copy whose first layer has so many more inputs, of weight 0; if negative, without its last ones."""
    wider = copy.deepcopy(network)
    first = next(layer for layer in wider.modules() if isinstance(layer, nn.Linear))
    first.weight = nn.Parameter(nn.functional.pad(first.weight.detach(), (0, inputs)))
    first.in_features += inputs
    return wider


def nature_cnn(shape: Sequence[int], spec: PolicySpec) -> tuple[nn.Module, ...]:
    """Convolutions that policy and value share, over the stacked pictures as channels.

    They are those of `models.encoder.event_images.nature_layers`, as in stable-baselines' CnnPolicy, which
    appendix D.1.2 names. Pictures need `models.kinds.MIN_IMAGE` pixels each way.
    """
    trunk = nn.Sequential(Bytes(), *nature_layers(shape, CNN_OUTPUTS))
    return trunk, Linear(CNN_OUTPUTS, spec.num_actions), Linear(CNN_OUTPUTS, 1)


def event_set(shape: Sequence[int], spec: PolicySpec) -> tuple[nn.Module, ...]:
    """A network over sets of events that policy and value share (`models.policy.event_set`)."""
    trunk = EventSet(shape[0], (spec.width, spec.height))
    return trunk, Linear(OUTPUTS, spec.num_actions), Linear(OUTPUTS, 1)


def finetuned_mlps(shape: Sequence[int], spec: PolicySpec) -> tuple[nn.Module, ...]:
    """The networks of `two_mlps` behind an encoder that they share and that PPO trains on."""
    _, pi, vf = two_mlps((shape[0], spec.evae.latent), spec)
    return FinetunedEncoder(spec.evae), pi, vf


class Bytes(nn.Module):
    """Bytes to numbers in [0, 1]; here, so that pictures travel and are stored as bytes."""

    def forward(self, pictures: Tensor) -> Tensor:
        """Scale uint8 (...) to float32 (...)."""
        return pictures.float().div_(255.0)
