"""A policy's networks, from a stack of features to logits and a value, each as three parts.

    logits = pi(trunk(stack)),   value = vf(trunk(stack))

`models.kinds.KINDS` names the `Network` of each kind of policy. Weights come from `initialise` or a file.
"""

import copy
import itertools
import math
from collections.abc import Callable, Sequence
from operator import contains
from typing import Literal, NamedTuple, cast

import numpy as np
import torch
from torch import Tensor, nn

from core.places import resolve
from models.encoder.event_images import nature_layers
from models.encoder.finetuned import FinetunedEncoder
from models.encoder.products import Linear, orthogonal_, packed
from models.encoder.table import dense
from models.kinds import PolicySpec
from models.policy.dense_update import tanh
from models.policy.event_set import OUTPUTS, EventSet, EventTables
from models.policy.memory import kept_shape

PARTS = ("trunk", "pi", "vf")
# Gain of the last layer's initial weights; all other layers have sqrt(2) (stable-baselines' policies).
LAST_GAIN = {"pi": 0.01, "vf": 1.0}
CNN_OUTPUTS = 512
Run = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
Gradients = Literal["compiled", "torch", "gpu"]


def build_networks(spec: PolicySpec, seed: int = 0) -> nn.ModuleDict:
    """Return the networks of a policy with the initial weights of a seed."""
    return initialise(assemble(spec), seed)


def initialise(networks: nn.ModuleDict, seed: int) -> nn.ModuleDict:
    """Set orthogonal weights and zero biases, as in stable-baselines' policies; return the networks."""
    for offset, name in enumerate(("pi", "vf", "trunk")):
        generator = torch.Generator().manual_seed(seed + offset)
        layers = [part for part in networks[name].modules() if isinstance(part, nn.Linear | nn.Conv2d)]
        for layer in layers:
            gain = LAST_GAIN.get(name, math.sqrt(2.0)) if layer is layers[-1] else math.sqrt(2.0)
            orthogonal_(layer.weight, gain, generator)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
    return networks


def by_dense_layers(trunk: nn.Module, pi: nn.Module) -> Run:
    """Return a function that runs dense networks without torch, with the same bits in any batch.

    For a few rows torch's calls take ten times as long as the arithmetic.
    """
    logits_of = _dense_layers(cast(nn.Sequential, pi))
    return lambda stacks, state: (logits_of(stacks), state)


def by_event_tables(trunk: nn.Module, pi: nn.Module) -> Run:
    """Return a function that runs an event set without torch, with the same bits in any batch."""
    features, decide = EventTables(cast(EventSet, trunk)), _dense_layers(nn.Sequential(pi))
    return lambda stacks, state: (decide(features(stacks)), state)


def by_torch(trunk: nn.Module, pi: nn.Module) -> Run:
    """Return a function that runs a network by torch, with the current weights of dense layers packed."""
    trunk, pi = packed(trunk), packed(pi)

    def run(stacks: np.ndarray, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        with torch.inference_mode():
            return pi(trunk(torch.from_numpy(stacks))).numpy(), state

    return run


def _dense_layers(network: nn.Sequential) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that computes dense layers with tanh between them, float32 (B, outputs)."""
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


def _no_state(spec: PolicySpec) -> int:
    return 0


class Network(NamedTuple):
    """Functions that build and run the networks of a kind of policy, and the way to train them.

    Attributes:
        build: (shape of the stack of features, policy) -> the parts `PARTS`.
        run: (trunk, pi) -> the policy with its current weights, a function from stacks (B, depth, ...)
            and states (B, S) to logits float32 (B, actions) and the next states.
        gradients: Code that computes PPO's gradients. "compiled": `models.policy.dense_update`, only for
            dense networks without a trunk; "torch"; "gpu": torch, on a GPU if the learner has one.
        state: policy -> size S of a recurrent network's state; 0: not recurrent.
    """

    build: Callable[[Sequence[int], PolicySpec], tuple[nn.Module, ...]]
    run: Callable[[nn.Module, nn.Module], Run] = by_torch
    gradients: Gradients = "torch"
    state: Callable[[PolicySpec], int] = _no_state


def network_of(spec: PolicySpec) -> Network:
    """Return the network of a policy. A plug-in may give a plain build function, which torch then runs."""
    named = resolve(spec.kind.network)
    return named if isinstance(named, Network) else Network(named)


def assemble(spec: PolicySpec) -> nn.ModuleDict:
    """Build the parts of a policy's networks (`PARTS`); the caller initialises or loads the weights.

    Raises:
        ValueError: The network has "compiled" gradients, but not the layers of `mlp`.
    """
    shape, network = kept_shape(spec), network_of(spec)
    parts = dict(zip(PARTS, network.build(shape, spec), strict=True))
    plain = isinstance(parts["trunk"], nn.Flatten) and is_mlp(parts["pi"]) and is_mlp(parts["vf"])
    if network.gradients == "compiled" and not plain:
        raise ValueError(
            f"{spec.model.name}: only networks of nn.Flatten() and `mlp`s have compiled gradients"
        )
    return nn.ModuleDict(parts)


def two_mlps(shape: Sequence[int], spec: PolicySpec) -> tuple[nn.Module, ...]:
    """Return two separate networks of dense tanh layers (appendix D.1.2; stable-baselines' MlpPolicy)."""
    inputs, hidden = math.prod(shape), spec.hidden
    return nn.Flatten(), mlp(inputs, hidden, spec.num_actions), mlp(inputs, hidden, 1)


def mlp(inputs: int, hidden: Sequence[int], outputs: int) -> nn.Sequential:
    """Return dense tanh layers and a linear head."""
    layers: list[nn.Module] = []
    for fan_in, fan_out in itertools.pairwise([inputs, *hidden]):
        layers += [Linear(fan_in, fan_out), nn.Tanh()]
    return nn.Sequential(*layers, Linear([inputs, *hidden][-1], outputs))


def is_mlp(network: nn.Module) -> bool:
    """Whether `mlp` could have built this network; compiled gradients would be wrong for any other one."""
    layers = list(network) if isinstance(network, nn.Sequential) else []
    kinds = [(nn.Tanh,) if place % 2 else (nn.Linear, Linear) for place in range(len(layers))]
    biased = all(layer.bias is not None for layer in layers[::2] if isinstance(layer, nn.Linear))
    return len(layers) % 2 == 1 and all(map(contains, kinds, map(type, layers))) and biased


def widened(network: nn.Module, inputs: int) -> nn.Module:
    """Return a copy whose first layer has `inputs` more inputs of weight 0, or fewer if negative."""
    wider = copy.deepcopy(network)
    first = next(layer for layer in wider.modules() if isinstance(layer, nn.Linear))
    first.weight = nn.Parameter(nn.functional.pad(first.weight.detach(), (0, inputs)))
    first.in_features += inputs
    return wider


def nature_cnn(shape: Sequence[int], spec: PolicySpec) -> tuple[nn.Module, ...]:
    """Return convolutions shared by policy and value, with the stacked pictures as channels.

    The layers are `models.encoder.event_images.nature_layers`, as in stable-baselines' CnnPolicy, which
    appendix D.1.2 names. Pictures need at least `models.kinds.MIN_IMAGE` pixels each way.
    """
    trunk = nn.Sequential(Bytes(), *nature_layers(shape, CNN_OUTPUTS))
    return trunk, Linear(CNN_OUTPUTS, spec.num_actions), Linear(CNN_OUTPUTS, 1)


def event_set(shape: Sequence[int], spec: PolicySpec) -> tuple[nn.Module, ...]:
    """Return a network over sets of events, shared by policy and value (`models.policy.event_set`)."""
    trunk = EventSet(shape[0], (spec.width, spec.height))
    return trunk, Linear(OUTPUTS, spec.num_actions), Linear(OUTPUTS, 1)


def finetuned_mlps(shape: Sequence[int], spec: PolicySpec) -> tuple[nn.Module, ...]:
    """Return the networks of `two_mlps` after a shared encoder that PPO fine-tunes."""
    _, pi, vf = two_mlps((shape[0], spec.evae.latent), spec)
    return FinetunedEncoder(spec.evae), pi, vf


class Bytes(nn.Module):
    """Scale bytes to [0, 1]; part of the network, so that pictures are sent and stored as bytes."""

    def forward(self, pictures: Tensor) -> Tensor:
        """Scale uint8 (...) to float32 (...)."""
        return pictures.float().div_(255.0)


TWO_MLPS = Network(two_mlps, by_dense_layers, "compiled")
NATURE_CNN = Network(nature_cnn, gradients="gpu")
EVENT_SET = Network(event_set, by_event_tables, "gpu")
FINETUNED_MLPS = Network(finetuned_mlps)
