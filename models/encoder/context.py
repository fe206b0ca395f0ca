"""The event context network (appendix A.1): a set of events in, one context vector out.

    context = max over events of ReLU( ECN(x, y, p) + embedding(t) ),   0 for no event

ECN is three per-event layers (64, 128, context), each with batch normalisation and ReLU.
ReLU floors the context at 0, which is therefore the identity of the maximum.

With `octaves` the first layer also reads sin and cos of pi/2 2^k x and y, k = 0, 1, ..., for x and y in
[-1, 1], because a network of raw coordinates learns only smooth functions of them (Tancik et al. 2020). Size
and cost of the frozen encoder's table do not change.

With `pool_rank` r > 1 a context holds the r-th largest value of each feature instead, or 0 if there are fewer
than r events: r - 1 false events alone cannot raise it. An event that occurs twice then counts twice.

With EventNet's coding (appendix A.2, equation 4) an event has a complex number per feature,

    a = [ tanh(ECN(x, y, p)) - age ]_+ exp(-i 2 pi age),   age = 1 - t

and the context holds, per feature, the number of largest magnitude: all real parts, then all imaginary
parts. The magnitude is the additive form with tanh features and the code -age. The phase comes from
the winning event (the newest one in a tie) and has no gradient.

`EventContextNetwork.plain` is this formula, event by event. `EventContextNetwork.forward` is
the same function with the same parameters, gradients and running statistics, tens of times
faster on a CPU (`benchmarks/context.py`): x, y, p have only 2 H W values, so the layers run once
per distinct value, with batch statistics weighted by how often each occurs. Only the order of the
sums differs; `tests/models/encoder/test_context.py` states the bounds for float64 and float32. On a GPU
torch computes the last layer and the maximum (`max_on_device`).
"""

import itertools
import math
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from models.encoder.embedding import embedding_table, eventnet_phase
from models.encoder.event_batch import EventBatch, Grid, distinct
from models.encoder.gpu_context import Events, max_on_device
from models.encoder.products import Linear, affine, product

DTYPES = (torch.float32, torch.float64)


class EventContextNetwork(nn.Module):
    """Per-event network and maximum over events.

    Args:
        grid: Sensor size and time bins.
        variant: "bytestream": x, y, p and the time embedding; "bytestream_xy": x, y alone.
        context: Features D, even.
        norm: "batch" or "none". With "batch" the layers have no bias: the normalisation
            subtracts it again, and its gradient would be rounding noise that Adam amplifies.
        coding: Time coding, one of `models.encoder.embedding.CODINGS`; "bytestream_xy" has none.
        pool_rank: Rank of the value over the events that is the context: 1 for the largest, 2, 3, ...
        octaves: Number of octaves of sines and cosines of x and y that the first layer also reads.

    A frozen network (parameters that need no gradient) never updates its running statistics,
    not even in train mode.
    """

    def __init__(
        self,
        grid: Grid,
        variant: str,
        context: int,
        norm: str,
        coding: str = "additive",
        pool_rank: int = 1,
        octaves: int = 0,
    ) -> None:
        super().__init__()
        self.grid = grid
        self.uses_polarity = variant == "bytestream"
        self.coding = coding if variant == "bytestream" else "none"
        self.pool_rank, self.octaves = pool_rank, octaves
        sizes = [4 * octaves + (3 if self.uses_polarity else 2), 64, 128, context]
        bias = norm == "none"
        self.layers = nn.ModuleList(Linear(a, b, bias=bias) for a, b in itertools.pairwise(sizes))
        self.norms = nn.ModuleList(nn.BatchNorm1d(size) for size in sizes[1:] if norm == "batch")

    def forward(self, batch: EventBatch) -> Tensor:
        """Return the contexts (B, D) of a batch of windows; (B, 2 D) with EventNet's coding.

        Raises:
            ValueError: The batch is on another grid, has fewer than two events for batch statistics,
                or the weights are neither float32 nor float64.
        """
        cell, bins, embedding = self._address(batch)
        present, multiplicity, rank = distinct(cell)
        share = self._share(multiplicity, len(cell))
        h, weight, bias = self._last_layer(self._inputs(present), share, len(cell))
        events, squash = Events(rank, bins, batch.offsets, embedding), self.coding == "eventnet"
        ordered = newest_first(events) if squash else events
        form = MaxContext.apply if h.device.type == "cpu" else max_on_device
        context, winning_bin = form(h, weight, bias, ordered, squash, self.pool_rank)
        return self._rotated(context, winning_bin) if squash else context

    def plain(self, batch: EventBatch) -> Tensor:
        """Compute the same contexts event by event; the reference in the tests of `forward`.

        Raises:
            ValueError: As in `forward`.
        """
        cell, bins, embedding = self._address(batch)
        h = self._inputs(cell)
        self._share(np.ones(1), len(cell))
        for layer, norm in self._pairs():
            h = layer(h)
            if norm is not None:
                running, affine = (norm.running_mean, norm.running_var), (norm.weight, norm.bias)
                h = functional.batch_norm(h, *running, *affine, self.learns, norm.momentum, norm.eps)
                norm.num_batches_tracked += int(self.learns)
            h = torch.relu(h)
        h = torch.tanh(h) if self.coding == "eventnet" else h
        value = torch.relu(h + torch.from_numpy(embedding[bins]).to(h.device))  # (N, D)
        sizes = np.diff(batch.offsets).tolist()
        best = torch.stack([_largest(part, self.pool_rank) for part in value.split(sizes)])
        if self.coding != "eventnet":
            return best
        times = torch.from_numpy(bins).to(h.device)[:, None].expand_as(value)
        winning_bin = torch.stack([
            torch.where(v == b, t, 0).max(0).values if len(v) else t.sum(0)
            for v, t, b in zip(value.split(sizes), times.split(sizes), best, strict=True)
        ])  # fmt: skip
        return self._rotated(best, winning_bin)

    def cell_features(self) -> Tensor:
        """Return the features (cells, D) >= 0 of every distinct event, using the running statistics."""
        cells = np.arange((2 if self.uses_polarity else 1) * self.grid.width * self.grid.height)
        h, weight, bias = self._last_layer(self._inputs(cells), None, 0)
        features = torch.relu(affine(h, weight, bias))
        return torch.tanh(features) if self.coding == "eventnet" else features

    @property
    def learns(self) -> bool:
        """Whether to use batch statistics and update the running ones."""
        return self.training and self.layers[0].weight.requires_grad

    def _pairs(self) -> list[tuple[Any, Any]]:
        return list(zip(self.layers, self.norms if len(self.norms) else [None] * 3, strict=True))

    def _address(self, batch: EventBatch) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return each event's cell and row in the codes, and the codes (one row of zeros without time)."""
        if batch.grid != self.grid:
            raise ValueError(
                f"the batch has {batch.grid}, the model {self.grid}: make it with the model's grid"
            )
        if self.layers[0].weight.dtype not in DTYPES:
            raise ValueError(f"weights must be float32 or float64, got {self.layers[0].weight.dtype}")
        dtype = str(self.layers[0].weight.dtype).removeprefix("torch.")
        codes = embedding_table(self.grid.time_bins, self.layers[-1].out_features, dtype, self.coding)
        pixels = self.grid.width * self.grid.height
        cell = batch.code if self.uses_polarity else batch.code % pixels
        return cell, np.zeros_like(batch.bin) if self.coding == "none" else batch.bin, codes

    def _rotated(self, magnitude: Tensor, winning_bin: Tensor) -> Tensor:
        """Return real and imaginary parts (B, 2 D) from magnitudes (B, D) and their time bins (B, D)."""
        dtype = str(magnitude.dtype).removeprefix("torch.")
        phase = torch.from_numpy(np.array(eventnet_phase(self.grid.time_bins, dtype))).to(magnitude.device)
        return torch.cat([magnitude * part[winning_bin.long()] for part in phase], dim=1)

    def _inputs(self, cell: np.ndarray) -> Tensor:
        """Return the first layer's inputs (N, inputs): x, y scaled to [-1, 1], p if used, and the octaves."""
        width, height = self.grid.width, self.grid.height
        columns = [
            2.0 * (cell % width) / max(width - 1, 1) - (width > 1),
            2.0 * (cell // width % height) / max(height - 1, 1) - (height > 1),
            2.0 * (cell // (width * height)) - 1.0,
        ][: 3 if self.uses_polarity else 2]
        turns = [0.5 * math.pi * 2.0**k * place for k in range(self.octaves) for place in columns[:2]]
        columns += [wave(turn) for turn in turns for wave in (np.sin, np.cos)]
        return torch.from_numpy(np.stack(columns, axis=1)).to(self.layers[0].weight)

    def _share(self, multiplicity: np.ndarray, events: int) -> Tensor | None:
        """Return the fraction of the batch's events in each present cell; None without batch statistics."""
        if not (self.learns and len(self.norms)):
            return None
        if events < 2:
            raise ValueError(f"batch statistics need at least two events in a training batch, got {events}")
        return torch.from_numpy(multiplicity / events).to(self.layers[0].weight)

    def _last_layer(self, h: Tensor, share: Tensor | None, events: int) -> tuple[Tensor, Tensor, Tensor]:
        """Run the first two layers; return the last as (h, weight, bias), for the caller to apply."""
        *inner, last = self._pairs()
        for layer, norm in inner:
            h, weight, bias = folded(layer, norm, h, share, events)
            h = torch.relu(affine(h, weight, bias))
        return folded(*last, h, share, events)


def folded(
    layer: nn.Linear, norm: nn.BatchNorm1d | None, h: Tensor, share: Tensor | None, events: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Return one affine map (h, weight, bias) equal to `norm(layer(h))` over the batch of events.

    The batch mean and variance of W h follow from mean and covariance of h: W mean(h), diag(W cov(h) W^T).
    So the normalisation costs a small covariance instead of passes over all features, and the gradient of
    the output stays sparse. `rsqrt` is used because torch's `sqrt` calls MKL, whose result depends on the
    processor.

    Args:
        layer: The layer, without bias if `norm` is given.
        norm: Batch normalisation, or None.
        h: Inputs (U, K) of the distinct events.
        share: Fraction of the batch's events that equal each (U,); None: use running statistics.
        events: Events of the batch, for the unbiased running variance.

    Returns:
        h (U, K), centred if batch statistics are used; weight (F, K); bias (F,).
    """
    if norm is None:
        return h, layer.weight, layer.bias
    if share is None:
        scale = norm.weight * torch.rsqrt(norm.running_var + norm.eps)
        return h, layer.weight * scale[:, None], norm.bias - norm.running_mean * scale
    centre = product(share[None], h)[0]
    h = h - centre
    covariance = product((h * share[:, None]).T, h)
    variance = (product(layer.weight, covariance) * layer.weight).sum(1).clamp_min(0)
    with torch.no_grad():
        norm.num_batches_tracked += 1
        norm.running_mean.lerp_(product(layer.weight, centre[:, None])[:, 0], norm.momentum)
        norm.running_var.lerp_(variance * (events / (events - 1)), norm.momentum)
    return h, layer.weight * (norm.weight * torch.rsqrt(variance + norm.eps))[:, None], norm.bias


def newest_first(events: Events) -> Events:
    """Sort each window's events by descending time bin, so that the newest wins a tie."""
    window = np.repeat(np.arange(len(events.offsets) - 1), np.diff(events.offsets))
    order = np.lexsort((-events.bin, window))
    return events._replace(cell=events.cell[order], bin=events.bin[order])


def _largest(values: Tensor, rank: int) -> Tensor:
    """Return the rank-th largest value (D,) of each column of values (N, D) >= 0; 0 if N < rank."""
    return values.topk(rank, 0).values[-1] if len(values) >= rank else values[:0].sum(0)


class MaxContext(torch.autograd.Function):
    """context = rank-th largest over events of ReLU(f(h W^T + b)[cell] + code[bin]), sparse backward.

    f is ReLU, or tanh(ReLU) if `squash`.
    """

    @staticmethod
    def forward(
        ctx: Any, h: Tensor, weight: Tensor, bias: Tensor, events: Events, squash: bool, rank: int
    ) -> tuple[Tensor, Tensor]:
        """Return the contexts (B, D) and the time bin (B, D) of the event behind each value, 0 if none."""
        activation = affine(h, weight, bias).relu_()
        features = (activation.tanh_() if squash else activation).numpy()
        context = np.zeros((len(events.offsets) - 1, len(bias)), features.dtype)
        winner = np.full(context.shape, -1, np.int32)
        winning_bin = np.zeros(context.shape, np.int32)
        if rank == 1:
            _maximum(features, events, context, winner)
        else:
            _ranked(features, events, rank, context, winner)
        _attribute(features, events, winner, winning_bin)
        ctx.slope = _tanh_slope(features, winner) if squash else None
        ctx.save_for_backward(h, weight, torch.from_numpy(winner))
        found = torch.from_numpy(context), torch.from_numpy(winning_bin)
        ctx.mark_non_differentiable(found[1])
        return found

    @staticmethod
    def backward(ctx: Any, gradient: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        """Return gradients of h, weight and bias; only winning events with an active feature contribute."""
        h, weight, winner = ctx.saved_tensors
        if ctx.slope is not None:
            gradient = gradient * torch.from_numpy(ctx.slope)
        outputs = torch.zeros_like(h), torch.zeros_like(weight), weight.new_zeros(len(weight))
        arrays = [tensor.detach().contiguous().numpy() for tensor in (gradient, winner, h, weight)]
        _scatter(*arrays, *(tensor.numpy() for tensor in outputs))
        return *outputs, None, None, None


def _tanh_slope(features: np.ndarray, winner: np.ndarray) -> np.ndarray:
    """Return the slope of tanh (B, D) at the winners' features (cells, D); arbitrary without a winner."""
    if len(features) == 0:
        return np.ones(winner.shape, features.dtype)
    return 1.0 - features[np.maximum(winner, 0), np.arange(winner.shape[1])] ** 2


@numba.njit(cache=True, error_model="numpy")
def _maximum(features, events, context, winner) -> None:  # type: ignore[no-untyped-def]
    """Raise `context` (B, D) to the events' maximum; store the winning event in `winner`, the first in a tie.

    Processes four events at a time, so that context and winner are read and written a quarter as often. The
    last four may repeat the last event, which changes nothing.
    """
    cell, bins, offsets, codes = events.cell, events.bin, events.offsets, events.codes
    for b in range(context.shape[0]):
        best, who, last = context[b], winner[b], offsets[b + 1] - 1
        for n in range(offsets[b], last + 1, 4):
            second, third, fourth = min(n + 1, last), min(n + 2, last), min(n + 3, last)
            feature_1, code_1 = features[cell[n]], codes[bins[n]]
            feature_2, code_2 = features[cell[second]], codes[bins[second]]
            feature_3, code_3 = features[cell[third]], codes[bins[third]]
            feature_4, code_4 = features[cell[fourth]], codes[bins[fourth]]
            event_1, event_2, event_3, event_4 = (
                np.int32(n), np.int32(second), np.int32(third), np.int32(fourth)
            )  # fmt: skip
            for j in range(len(best)):
                early, other = feature_1[j] + code_1[j], feature_2[j] + code_2[j]
                newer = other > early
                early, of_early = other if newer else early, event_2 if newer else event_1
                late, other = feature_3[j] + code_3[j], feature_4[j] + code_4[j]
                newer = other > late
                late, of_late = other if newer else late, event_4 if newer else event_3
                newer = late > early
                value, event = late if newer else early, of_late if newer else of_early
                better = value > best[j]
                best[j] = value if better else best[j]
                who[j] = event if better else who[j]


@numba.njit(cache=True, error_model="numpy")
def _ranked(features, events, rank, context, winner) -> None:  # type: ignore[no-untyped-def]
    """Like `_maximum`, but find the rank-th largest value, at least 0; equal values rank in event order.

    Each event is inserted into the `rank` largest values so far; a displaced value moves to the next level.
    """
    size = context.shape[1]
    given, of_event, moved = np.empty(size, context.dtype), np.empty(size, np.int32), np.empty(size, np.bool_)
    for b in range(context.shape[0]):
        best, who = np.zeros((rank, size), context.dtype), np.full((rank, size), -1, np.int32)
        for n in range(events.offsets[b], events.offsets[b + 1]):
            feature, code = features[events.cell[n]], events.codes[events.bin[n]]
            for j in range(size):
                given[j], of_event[j], moved[j] = feature[j] + code[j], n, False
            for level in range(rank):
                value, event = best[level], who[level]
                for j in range(size):
                    moves = moved[j] | (given[j] > value[j])
                    own, its_event, other, its_other = value[j], event[j], given[j], of_event[j]
                    value[j] = other if moves else own
                    event[j] = its_other if moves else its_event
                    given[j] = own if moves else other
                    of_event[j] = its_event if moves else its_other
                    moved[j] = moves
        context[b], winner[b] = best[rank - 1], who[rank - 1]


@numba.njit(cache=True, error_model="numpy")
def _attribute(features, events, winner, winning_bin) -> None:  # type: ignore[no-untyped-def]
    """Replace each winning event by its cell (-1 if it has no gradient) and store its time bin."""
    for b in range(winner.shape[0]):
        for j in range(winner.shape[1]):
            event = winner[b, j]
            if event >= 0:
                winning_bin[b, j] = events.bin[event]
                u = events.cell[event]
                winner[b, j] = u if features[u, j] > 0 else -1


@numba.njit(cache=True, error_model="numpy")
def _scatter(gradient, winner, h, weight, grad_h, grad_weight, grad_bias) -> None:  # type: ignore[no-untyped-def]
    """Add each winner's gradient to its row of h, its row of the weight, and the bias."""
    for b in range(gradient.shape[0]):
        for j in range(gradient.shape[1]):
            u = winner[b, j]
            if u >= 0:
                g = gradient[b, j]
                grad_bias[j] += g
                for k in range(h.shape[1]):
                    grad_weight[j, k] += g * h[u, k]
                    grad_h[u, k] += g * weight[j, k]
