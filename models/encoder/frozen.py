"""The half of an event VAE that flies, events to latent: the frozen part of a policy, and its table."""

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import nn

from models.encoder.evae import EventVAE
from models.encoder.event_images import PictureEncoder
from models.encoder.table import EncoderTable
from models.encoder.weights import EncoderFileError, load_encoder


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


def encoder_of(evae: EventVAE) -> EncoderTable | PictureEncoder:
    """What turns windows into latents: a lookup table, or convolutions for one that sees pictures."""
    return (
        PictureEncoder(evae)
        if evae.settings["variant"] == "event_image_vae"
        else EncoderTable.from_evae(evae)
    )


def tabulate(part: nn.Module, settings: Mapping[str, Any]) -> EncoderTable | PictureEncoder:
    """The `encoder_of` an `encoder_part`, or a `FinetunedEncoder`, of an event VAE with these settings.

    Raises:
        ValueError: If the part was never given its weights.
    """
    if not all(torch.isfinite(value).all() for value in part.state_dict().values()):
        raise ValueError("encoder must have finite weights, got NaN: its file is missing or changed")
    evae = EventVAE(**settings)
    evae.load_state_dict({**evae.state_dict(), **part.state_dict()})
    return encoder_of(evae)
