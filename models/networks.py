"""The parts of a policy: the encoder's half that flies, the stack of latents, two small networks."""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import nn

from models.evae import EventVAE
from models.table import EncoderTable
from models.weights import EncoderFileError, load_encoder


def mlp(inputs: int, hidden: Sequence[int], outputs: int, gain: float, seed: int = 0) -> nn.Sequential:
    """Dense tanh layers and a linear head with orthogonal weights and zero biases.

    Args:
        inputs: Numbers in.
        hidden: Neurons of each tanh layer.
        outputs: Numbers out.
        gain: Of the head's weights; hidden layers have sqrt(2).
        seed: Of the initial weights.

    Source: appendix D.1.2 ("two dense layers of 64 neurons each"); activation and
    initial weights are those of stable-baselines' MlpPolicy, which it names.
    """
    generator = torch.Generator().manual_seed(seed)
    sizes = [inputs, *hidden, outputs]
    layers: list[nn.Module] = []
    for fan_in, fan_out in itertools.pairwise(sizes):
        layer = nn.Linear(fan_in, fan_out)
        last = len(layers) == 2 * len(hidden)
        nn.init.orthogonal_(layer.weight, gain if last else math.sqrt(2.0), generator=generator)
        nn.init.zeros_(layer.bias)
        layers += [layer] if last else [layer, nn.Tanh()]
    return nn.Sequential(*layers)


def build_heads(manifest: Mapping[str, Any], seed: int = 0) -> dict[str, nn.Sequential]:
    """The policy network "pi" (logits, gain 0.01) and the value network "vf" (gain 1): separate."""
    inputs, hidden = manifest["stack"] * manifest["latent"], manifest["hidden"]
    return {
        "pi": mlp(inputs, hidden, manifest["num_actions"], 0.01, seed),
        "vf": mlp(inputs, hidden, 1, 1.0, seed + 1),
    }


def encoder_part(evae: EventVAE) -> nn.ModuleDict:
    """The half of an event VAE that flies, events to latent, with every tensor as a buffer.

    A buffer is in every state and in no optimiser: the encoder is frozen by construction.
    """
    part = nn.ModuleDict({"ecn": evae.ecn, "encoder": evae.encoder}).eval()
    for module in part.modules():
        for name, value in list(module.named_parameters(recurse=False)):
            delattr(module, name)
            module.register_buffer(name, value.detach())
    return part


def read_encoder_part(path: str, digest: str, settings: Mapping[str, Any]) -> nn.ModuleDict:
    """The `encoder_part` of an encoder file, or one full of NaN if that file is not there.

    A checkpoint is opened where its encoder file no longer is; the state it holds then
    replaces the NaN, and `tabulate` refuses to fly on what is left of them.

    Args:
        path: The encoder file.
        digest: Its SHA-256; a file of another digest counts as not there.
        settings: Of its event VAE.
    """
    try:
        evae, manifest = load_encoder(path)
        if manifest["sha256"] == digest:
            return encoder_part(evae)
    except EncoderFileError:
        pass
    part = encoder_part(EventVAE(**settings))
    for value in part.buffers():
        value.fill_(math.nan if value.is_floating_point() else 0)
    return part


def tabulate(part: nn.ModuleDict, settings: Mapping[str, Any]) -> EncoderTable:
    """The lookup table of an `encoder_part` of an event VAE with these settings.

    Raises:
        ValueError: If the part was never given its weights.
    """
    if not all(torch.isfinite(value).all() for value in part.buffers()):
        raise ValueError("encoder must have finite weights, got NaN: its file is missing or changed")
    evae = EventVAE(**settings)
    evae.load_state_dict({**evae.state_dict(), **part.state_dict()})
    return EncoderTable.from_evae(evae)


def push_latents(stacks: np.ndarray, latents: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Append the newest latent to each stack; the first of a flight fills its whole stack.

    Args:
        stacks: float32 (B, stack * latent), oldest latent first.
        latents: float32 (B, latent).
        first: bool (B,), True where the latent is the first of a flight.

    Returns:
        float32 (B, stack * latent), a new array.
    """
    latent = latents.shape[1]
    tiled = np.tile(latents, (1, stacks.shape[1] // latent))
    return np.where(first[:, None], tiled, np.concatenate([stacks[:, latent:], latents], axis=1))
