"""The event variational autoencoder (appendix A.1, B.2): events -> context -> latent -> event picture.

With the target "proximity" it decodes how near the obstacles ahead are, which a simulator knows
but events alone do not determine.

Loss of one batch, both terms on a stated scale:

    loss = mean over windows and outputs of the reconstruction error
         + beta * mean over windows of KL( q(z | events) || N(0, 1) ), summed over the latent

The mean over pixels is 1 / (H W) of the sum in an evidence lower bound, so `beta` here weighs
H W times more than the same number in front of a summed error: the appendix's schedule
(`appendix_beta`) on this scale drives the latent of the full variant to the prior within 1,500
iterations. A weight near 1e-5 avoids this collapse.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from models.encoder.context import EventContextNetwork
from models.encoder.event_batch import EventBatch, Grid
from models.encoder.event_images import PictureContextNetwork, cell_counts, last_polarity, newest_time
from models.encoder.products import Linear
from models.kinds import EvaeSettings, checked

CELLS = 8  # cells per side of the target "counts"
SECTORS = 24  # sectors of the field of view, from left to right, of the target "proximity"
NEAR = {"proximity": 0.22}  # an obstacle is there above this value, which is 15 m; other targets: above 0
COUNTED_BITS = 12.0  # divides log2(1 + count) of a cell: 1 at 4,095 events
LOGVAR_LIMIT = 10.0  # exp is continued linearly above it: exp(89) overflows float32
ACTIVE_VARIANCE = 0.01  # a latent unit is active if its mean varies more over windows (Burda et al. 2016)
# Measured: a collapsed latent held 0.03 nats and explained 0.000; working latents hold 10 nats or more.
EMPTY_KL = 0.1  # nats
EMPTY_EXPLAINED = 0.01
# Error of a target's values; the other targets have a cross entropy.
ERRORS: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "signed": functional.smooth_l1_loss,
    "counts": functional.mse_loss,
}


class EventVAE(nn.Module):
    """Event context network, encoder 1024-256-(mu, logvar) and decoder latent-256-1024-H W.

    Args:
        variant: "bytestream" sees t, x, y, p; "bytestream_xy" sees x, y alone; "event_image_vae" sees event
            images through convolutions, and does not use norm, time_bins and coding.
        width, height: Pixels of the sensor.
        context: Features of the context vector, even.
        latent: Size of z.
        norm: "batch" or "none": normalisation of the context network.
        target: Reconstructed quantity: "signed" (Tanh, smooth L1), "occupancy" or "aged" (Sigmoid,
            binary cross entropy), or "counts" (linear, mean squared error), see `event_targets`; or
            "proximity" of obstacles in sectors (Sigmoid, binary cross entropy), supplied by the caller.
        time_bins: Resolution of time within a window, part of the model.
        coding: How the time of an event enters the context: "additive" (sines and cosines),
            "eventnet" (decay and rotation, twice the numbers) or "none"; "bytestream_xy" has no time
            and takes "additive" as "none".
        pool_rank: Rank of each feature's value over the events that the context holds: 1, the largest
            (appendix A.1), or 2, 3, ..., so that single false events cannot raise it.
        octaves: Number of octaves of sines and cosines of x and y that the per-event network reads in
            addition to x and y; 0: none (appendix A.1).

    Raises:
        ValueError: A setting is outside its range; the message names it.
    """

    def __init__(  # noqa: PLR0913 - the settings of an encoder file
        self,
        variant: str = "bytestream",
        width: int = 64,
        height: int = 64,
        context: int = 1024,
        latent: int = 8,
        norm: str = "batch",
        target: str = "signed",
        time_bins: int = 1024,
        coding: str = "additive",
        pool_rank: int = 1,
        octaves: int = 0,
    ) -> None:
        super().__init__()
        values = {
            "variant": variant, "width": width, "height": height, "context": context,
            "latent": latent, "norm": norm, "target": target, "time_bins": time_bins, "coding": coding,
            "pool_rank": pool_rank, "octaves": octaves,
        }  # fmt: skip
        self.settings = checked(EvaeSettings, values)
        self.grid = Grid(width, height, time_bins)
        self.target = target
        self.ecn: nn.Module = (
            PictureContextNetwork(self.grid, context)
            if variant == "event_image_vae"
            else EventContextNetwork(self.grid, variant, context, norm, coding, pool_rank, octaves)
        )
        parts = 2 if coding == "eventnet" else 1  # real and imaginary
        self.encoder = nn.Sequential(Linear(parts * context, 256), nn.ReLU(), Linear(256, 2 * latent))
        self.decoder = nn.Sequential(
            Linear(latent, 256),
            nn.ReLU(),
            Linear(256, 1024),
            nn.ReLU(),
            Linear(1024, math.prod(target_shape(target, self.grid))),
        )

    @classmethod
    def of(cls, settings: EvaeSettings) -> "EventVAE":
        """Build an untrained model with these settings."""
        return cls(**dataclasses.asdict(settings))

    def forward(self, batch: EventBatch, noise: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Reconstruct a batch of windows.

        Args:
            batch: Windows on this model's `grid`.
            noise: Standard normal (B, latent) for z = mu + noise exp(logvar / 2); None: z = mu.

        Returns:
            Logits (B, outputs) for `reconstruct`, mu (B, latent), logvar (B, latent); `outputs` is
            the size of `target_shape`.
        """
        mu, logvar = self.encoder(self.ecn(batch)).chunk(2, dim=-1)
        z = mu if noise is None else mu + noise * torch.exp(0.5 * logvar.clamp(-30.0, LOGVAR_LIMIT))
        return self.decoder(z), mu, logvar

    def freeze(self) -> "EventVAE":
        """Set eval mode and fix all parameters and running statistics; return self."""
        return self.eval().requires_grad_(False)


def target_shape(target: str, grid: Grid) -> tuple[int, ...]:
    """Return a target's shape: a picture (H, W), "counts" (2, CELLS, CELLS) or "proximity" (SECTORS,)."""
    own = {"counts": (2, CELLS, CELLS), "proximity": (SECTORS,)}
    return own.get(target, (grid.height, grid.width))


def event_targets(batch: EventBatch, target: str) -> Tensor:
    """Return the decoder's targets, float32 (B, outputs), row-major (`target_shape`).

    "signed": polarity of each pixel's last event, -1, 0 or +1. "occupancy": 1 where the pixel
    had any event, else 0. "aged": the time of the pixel's newest event in (0, 1), newest near 1,
    or 0 without events. Like the context, these three depend only on the set of events: an event
    that occurs twice counts once. Events of a window are taken in their given (time) order.
    "counts": log2(1 + count) / COUNTED_BITS of the OFF events, then of the ON events of each cell.

    Raises:
        ValueError: The target is "proximity", which events do not determine.
    """
    if target == "proximity":
        rule = "must be one that events alone tell: signed, occupancy, aged or counts"
        raise ValueError(f"model.target: here it {rule}, got 'proximity'")
    if target == "counts":
        return torch.from_numpy(np.log2(1.0 + cell_counts(batch, CELLS)) / np.float32(COUNTED_BITS))
    if target == "aged":
        return torch.from_numpy(newest_time(batch))
    last = last_polarity(batch)
    return torch.from_numpy(last if target == "signed" else np.abs(last))


def reconstruction_loss(logits: Tensor, targets: Tensor, target: str) -> Tensor:
    """Return the target's error (see `EventVAE`), averaged over windows and outputs.

    The cross entropy takes logits because sigmoid followed by log is infinite for logits from 17 on.
    """
    if target in ERRORS:
        return ERRORS[target](reconstruct(logits, target), targets)
    return functional.binary_cross_entropy_with_logits(logits, targets)


def reconstruct(logits: Tensor, target: str) -> Tensor:
    """Convert logits to a target's values: Tanh, Sigmoid (appendix A.1), or the logits themselves."""
    if target == "counts":
        return logits
    return torch.tanh(logits) if target == "signed" else torch.sigmoid(logits)


def pictures(values: Tensor, target: str, grid: Grid) -> Tensor:
    """Return values of a target (B, outputs) as pictures for display, (B, H, W) in about [-1, 1].

    For "counts" each pixel shows the larger count of its cell: ON as a positive, OFF as a negative value. For
    "proximity" each column of pixels shows its sector.
    """
    shaped = values.reshape(-1, *target_shape(target, grid))
    if target == "proximity":
        columns = torch.arange(grid.width) * SECTORS // grid.width
        return shaped[:, None, columns].expand(-1, grid.height, -1)
    if target != "counts":
        return shaped
    off, on = shaped.unbind(1)
    rows, columns = (torch.arange(side) * CELLS // side for side in (grid.height, grid.width))
    return torch.where(on >= off, on, -off)[:, rows[:, None], columns]


def kl_divergence(mu: Tensor, logvar: Tensor) -> Tensor:
    """Return KL( N(mu, exp(logvar)) || N(0, 1) ) of each window, summed over the latent: (B,).

    Computed as 0.5 (mu^2 + expm1(logvar) - logvar), because 1 + logvar - exp(logvar) would cancel
    small values. Above logvar 10 exp continues along its tangent, so that value and gradient stay
    finite and the gradient points back.
    """
    bounded = logvar.clamp_max(LOGVAR_LIMIT)
    exp_minus_1 = torch.expm1(bounded) + torch.exp(bounded.detach()) * (logvar - bounded)
    return 0.5 * (mu.square() + exp_minus_1 - logvar).sum(dim=-1)


def appendix_beta(iteration: int) -> float:
    """Return the appendix's KL weight (B.2): 0 up to iteration 1000, then 1e-3 * iteration / 10000.

    The appendix does not define iteration 1000; here the weight is 0.
    """
    return 0.0 if iteration <= 1000 else 1e-3 * iteration / 10_000


def train_step(
    evae: EventVAE, optimizer: torch.optim.Optimizer, batch: EventBatch, targets: Tensor, beta: float,
    rng: np.random.Generator, max_norm: float = 1.0,
) -> dict[str, float]:  # fmt: skip
    """Update the model on one batch.

    Args:
        evae: Model in train mode.
        optimizer: Optimiser of the model's parameters.
        batch: Windows with at least two events in total.
        targets: From `event_targets`, on the model's device.
        beta: KL weight on the scale of this module's loss.
        rng: Draws the noise of the latent.
        max_norm: The gradient's norm is clipped to this.

    Returns:
        loss, reconstruction, kl (mean over windows), active_units, gradient_norm (before clipping).

    Raises:
        RuntimeError: The gradient is not finite; no parameter has been changed.
    """
    parameter = evae.decoder[0].weight
    noise = torch.from_numpy(rng.standard_normal((len(batch), evae.settings.latent))).to(parameter)
    logits, mu, logvar = evae(batch, noise)
    reconstruction, kl = reconstruction_loss(logits, targets, evae.target), kl_divergence(mu, logvar).mean()
    loss = reconstruction + beta * kl
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    norm = nn.utils.clip_grad_norm_(evae.parameters(), max_norm, error_if_nonfinite=True)
    optimizer.step()
    figures = {"loss": loss, "reconstruction": reconstruction, "kl": kl, "gradient_norm": norm}
    return {name: value.item() for name, value in figures.items()} | {"active_units": active_units(mu)}


@torch.no_grad()
def validate(evae: EventVAE, batch: EventBatch, targets: Tensor) -> dict[str, float]:
    """Return metrics of the model on held-out windows with z = mu; the model must be in eval mode.

    Returns:
        reconstruction (mean error of a pixel), mean_picture (the same error for the targets' own
        mean picture), explained_loss (1 - reconstruction / mean_picture: 0 for a model that has learnt
        nothing about the single window, 1 for a perfect one, and 0 if all targets are the same;
        "aged" never reaches 1, because the cross entropy of times between 0 and 1 is not 0),
        auc (`ranking_area` of the reconstruction's magnitude, where targets above `NEAR`, or other
        than 0, are the positives), kl (mean over windows [nats]), active_units.
    """
    logits, mu, logvar = evae(batch)
    error = ERRORS.get(evae.target, functional.binary_cross_entropy)
    reconstruction = reconstruction_loss(logits, targets, evae.target).item()
    mean_picture = error(targets.mean(0).expand_as(targets), targets).item()
    return {
        "reconstruction": reconstruction,
        "mean_picture": mean_picture,
        "explained_loss": 1.0 - reconstruction / mean_picture if mean_picture > 0 else 0.0,
        "auc": ranking_area(
            reconstruct(logits, evae.target).abs().numpy(), targets.abs().numpy() > NEAR.get(evae.target, 0.0)
        ),
        "kl": kl_divergence(mu, logvar).mean().item(),
        "active_units": active_units(mu),
    }


def ranking_area(scores: np.ndarray, positive: np.ndarray) -> float:
    """Return the area under the ROC curve: how often a positive scores higher than a negative.

    Exact: the fraction over all pairs, where a tie counts half (Mann and Whitney 1947).

    Args:
        scores: Any shape, without NaN.
        positive: bool, the same shape.

    Returns:
        0..1; 0.5 (uninformative) if all or none are positive.

    Raises:
        ValueError: A score is NaN, which has no rank.
    """
    if np.isnan(scores).any():
        raise ValueError("scores must be numbers, got NaN, which has no rank; check the model's weights")
    own, others = np.sort(scores[positive]), np.sort(scores[~positive])
    if not len(own) or not len(others):
        return 0.5
    twice = sum(int(np.searchsorted(others, own, side).sum()) for side in ("left", "right"))
    return twice / (2 * len(own) * len(others))


def collapsed(figures: Mapping[str, float]) -> bool:
    """Whether the posterior has collapsed onto the prior, so that the latent carries no information.

    True if nothing of the single window is decoded (`EMPTY_EXPLAINED`), and the latent is either the same
    for every window (no active unit) or close to the prior (`EMPTY_KL`). Both are required, because a
    latent without a KL term may have a small scale, and a model early in training decodes nothing yet.

    Args:
        figures: Metrics from `validate`.
    """
    silent = figures["active_units"] == 0 or figures["kl"] < EMPTY_KL
    return silent and figures["explained_loss"] < EMPTY_EXPLAINED


def active_units(mu: Tensor) -> float:
    """Return the number of latent units whose variance over the windows of `mu` (B, latent) exceeds 0.01."""
    return float((mu.detach().var(0, correction=0) > ACTIVE_VARIANCE).sum())
