"""The encoder half of an event VAE (events to latent): the frozen part of a policy, and its lookup table."""

import math

import torch
from torch import nn

from models.encoder.evae import EventVAE
from models.encoder.event_images import PictureEncoder
from models.encoder.table import EncoderTable
from models.encoder.weights import EncoderFileError, load_encoder
from models.kinds import EvaeSettings

Encoder = EncoderTable | PictureEncoder


def encoder_part(evae: EventVAE) -> nn.ModuleDict:
    """Return the encoder half of an event VAE, with every tensor as a buffer.

    Buffers are part of every checkpoint and of no optimiser: the encoder is frozen by construction.
    """
    part = nn.ModuleDict({"ecn": evae.ecn, "encoder": evae.encoder}).eval()
    for module in part.modules():
        for name, value in list(module.named_parameters(recurse=False)):
            delattr(module, name)
            module.register_buffer(name, value.detach())
    return part


def read_encoder_part(path: str, digest: str, settings: EvaeSettings) -> nn.ModuleDict:
    """Return the `encoder_part` of an encoder file, filled with NaN if the file is missing.

    A checkpoint may be opened where its encoder file no longer exists. The checkpoint's own state
    then replaces the NaN; `tabulate` raises an error if any is left.

    Args:
        path: The encoder file.
        digest: Its SHA-256; a file with another digest counts as missing.
        settings: Settings of the event VAE.
    """
    try:
        evae, manifest = load_encoder(path)
        if manifest["sha256"] == digest:
            return encoder_part(evae)
    except EncoderFileError:
        pass
    part = encoder_part(EventVAE.of(settings))
    for value in part.buffers():
        value.fill_(math.nan if value.is_floating_point() else 0)
    return part


def encoder_of(evae: EventVAE) -> Encoder:
    """Return the frozen encoder of a model: a lookup table, or convolutions for event images."""
    return (
        PictureEncoder(evae) if evae.settings.variant == "event_image_vae" else EncoderTable.from_evae(evae)
    )


def tabulate(part: nn.Module, settings: EvaeSettings) -> Encoder:
    """Return the frozen encoder of an `encoder_part` or a `FinetunedEncoder` with these model settings.

    Raises:
        ValueError: A weight is not finite: the weights were never loaded.
    """
    if not all(torch.isfinite(value).all() for value in part.state_dict().values()):
        raise ValueError("encoder must have finite weights, got NaN: its file is missing or changed")
    evae = EventVAE.of(settings)
    evae.load_state_dict({**evae.state_dict(), **part.state_dict()})
    return encoder_of(evae)
