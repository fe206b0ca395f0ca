"""Event images: drawing them from events, and a convolutional encoder for them.

The policy `event_image_vae` (EIVAE in appendix D.1.2) uses this encoder, a variational
autoencoder with the convolutions of `event_image`. Here each step's image is encoded on its own and
the policy sees a stack of latents, like `bytestream`; the paper encodes the stack of images. So
`event_image_vae` and `bytestream` differ only in what the encoder sees.
"""

import math
from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor, nn

from core.pictures import GREY_OFF, GREY_ON
from models.encoder.event_batch import EventBatch, Grid, batch_packed, batch_windows
from models.encoder.products import Linear, orthogonal_, packed
from models.kinds import MIN_IMAGE

OFF_SHARE = GREY_OFF / GREY_ON


class PictureContextNetwork(nn.Module):
    """Map an event image to a context by the convolutions of `nature_layers`.

    Args:
        grid: Sensor size; time bins are not used.
        context: Features D.

    Raises:
        ValueError: Width or height of the sensor is below 36 pixels.
    """

    def __init__(self, grid: Grid, context: int) -> None:
        super().__init__()
        if min(grid.width, grid.height) < MIN_IMAGE:
            raise ValueError(
                f"event images need {MIN_IMAGE} pixels each way, got {grid.width} x {grid.height}"
            )
        self.grid = grid
        self.layers = nn.Sequential(*nature_layers((1, grid.height, grid.width), context))
        for layer in self.layers:
            if isinstance(layer, nn.Conv2d | nn.Linear):  # sparse pictures fade with torch's initial weights
                orthogonal_(layer.weight, math.sqrt(2.0))
                nn.init.zeros_(layer.bias)

    def forward(self, batch: EventBatch) -> Tensor:
        """Return context (B, D) of a batch of windows."""
        return self.layers(event_pictures(batch).to(self.layers[0].weight))


def nature_layers(shape: Sequence[int], outputs: int) -> list[nn.Module]:
    """Return three convolutions and a dense layer with the sizes of Mnih et al. (Nature 2015).

    Args:
        shape: Channels, height and width of a picture, at least `models.kinds.MIN_IMAGE` pixels each way.
        outputs: Features of the last layer.
    """
    channels, *sides = shape
    height, width = (((side - 8) // 4 + 1 - 4) // 2 + 1 - 2 for side in sides)
    return [
        *(nn.Conv2d(channels, 32, 8, 4), nn.ReLU()),
        *(nn.Conv2d(32, 64, 4, 2), nn.ReLU()),
        *(nn.Conv2d(64, 64, 3, 1), nn.ReLU()),
        nn.Flatten(),
        *(Linear(64 * height * width, outputs), nn.ReLU()),
    ]


def last_polarity(batch: EventBatch) -> np.ndarray:
    """Return the polarity of each pixel's last event, -1, 0 or +1: float32 (B, H W), row-major."""
    pictures = np.zeros((len(batch), batch.grid.width * batch.grid.height), np.float32)
    _draw_windows(batch.code, batch.offsets, pictures)
    return pictures


def newest_time(batch: EventBatch) -> np.ndarray:
    """Return the time of each pixel's newest event within its window, 0 if there is none: float32 (B, H W).

    Times are the centres of their bins, in (0, 1), newest near 1.
    """
    pixels = batch.grid.width * batch.grid.height
    picture = np.zeros((len(batch), pixels), np.float32)
    time = ((batch.bin + 0.5) / batch.grid.time_bins).astype(np.float32)
    np.maximum.at(picture, (batch.window, batch.code % pixels), time)
    return picture


def cell_counts(batch: EventBatch, cells: int) -> np.ndarray:
    """Count OFF, then ON events in cells x cells equal parts of the sensor: float32 (B, 2 cells cells).

    A pixel (x, y) belongs to column x cells // width and row y cells // height; row-major.
    """
    row, x = np.divmod(batch.code, batch.grid.width)
    sign, y = np.divmod(row, batch.grid.height)
    cell = (sign * cells + y * cells // batch.grid.height) * cells + x * cells // batch.grid.width
    size = 2 * cells * cells
    counts = np.bincount(batch.window * size + cell, minlength=len(batch) * size)
    return counts.reshape(len(batch), size).astype(np.float32)


def event_pictures(batch: EventBatch) -> Tensor:
    """Return event images float32 (B, 1, H, W) on a scale where ON is 1."""
    last = torch.from_numpy(last_polarity(batch))
    pictures = torch.where(last < 0, OFF_SHARE, last)
    return pictures.reshape(-1, 1, batch.grid.height, batch.grid.width)


@numba.njit(cache=True, error_model="numpy")
def draw_last(code, picture, on, off) -> None:  # type: ignore[no-untyped-def]
    """Set each pixel of `picture` (H W,) to `on` or `off` by its last event; leave other pixels unchanged."""
    for n in range(len(code)):
        picture[code[n] % len(picture)] = on if code[n] >= len(picture) else off


@numba.njit(cache=True, error_model="numpy")
def _draw_windows(code, offsets, pictures) -> None:  # type: ignore[no-untyped-def]
    for b in range(len(pictures)):
        draw_last(code[offsets[b] : offsets[b + 1]], pictures[b], 1.0, -1.0)


class PictureEncoder:
    """Frozen encoder of event images, with the methods of `models.encoder.table.EncoderTable`."""

    def __init__(self, evae: Any) -> None:
        """Use the layers of an `EventVAE` of variant "event_image_vae"."""
        self.grid, self.latent_size = evae.grid, evae.settings.latent
        self.layers = nn.Sequential(evae.ecn.layers, evae.encoder).eval()
        self._run = packed(self.layers)

    def encode(self, events: Any, start_us: int, window_us: int) -> np.ndarray:
        """Return latent mu (latent,) of one window. Raises ValueError as in `index_events`."""
        return self.encode_batch(batch_windows([(events, start_us, window_us)], self.grid))[0]

    def encode_windows(self, windows: np.ndarray | Sequence[np.ndarray]) -> np.ndarray:
        """Return latents (B, latent) of packed windows. Raises ValueError as in `batch_packed`."""
        return self.encode_batch(batch_packed(windows, self.grid))

    def encode_batch(self, batch: EventBatch) -> np.ndarray:
        """Return the latents (B, latent) of a batch."""
        with torch.inference_mode():
            return self._run(event_pictures(batch))[:, : self.latent_size].numpy()
