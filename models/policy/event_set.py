"""A small network over a set of events, trained end to end, without a frozen encoder.

Similar to FLEET (Gottwald et al.): Fourier features of a pixel's position, a gate that depends on
time, and pooling over the set. A window is thinned to at most `EVENTS` events, spread evenly over
their order in time; unused rows are empty (`event_batch.event_rows`).

    window = [ max | mean | number ] over events of  place(x, y, p) * gate(t)

`EventSet.plain` is this formula, row by row. `EventSet.forward` is the same function with the
same parameters and gradients, several times faster on a CPU: both factors run once per distinct
value in the batch, and the products are pooled as they are computed. `EventTables` is the same
function for fixed weights: both factors are tabulated once. Only the order of sums differs.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numba
import numpy as np
import torch
from torch import Tensor, nn

from models.encoder.event_batch import ROW_EMPTY, ROW_OFF, ROW_ON, Grid, batch_rows, distinct
from models.encoder.products import Linear
from models.encoder.table import dense

EVENTS = 256  # most events of a window that the network sees
TIMES = 1024  # time steps of a window
OCTAVES = 5  # octaves of the Fourier features: wavelengths from 2 images down to 1/8 of one
WIDTH = 64  # features of an event
OUTPUTS = 128  # outputs of the trunk


class EventSet(nn.Module):
    """Map stacks of sets of events, int16 (B, stack, EVENTS, 4), to features float32 (B, OUTPUTS)."""

    def __init__(self, stack: int, size: Sequence[int]) -> None:
        """Build the network for stacks of `stack` windows and a sensor of `size` (width, height) pixels."""
        super().__init__()
        self.grid = Grid(size[0], size[1], TIMES)
        self.place = nn.Sequential(Linear(4 * OCTAVES + 3, WIDTH), nn.ReLU(), Linear(WIDTH, WIDTH), nn.ReLU())
        self.gate = nn.Sequential(Linear(1, WIDTH), nn.Sigmoid())
        self.join = nn.Sequential(Linear(stack * (2 * WIDTH + 1), OUTPUTS), nn.ReLU())

    def forward(self, stacks: Tensor) -> Tensor:
        """Pool each event's features times its gate: maximum, mean and number over each window.

        Uses the fused form on a CPU, `plain` elsewhere.

        Raises:
            ValueError: A row is not an event of the sensor (checked on a CPU only).
        """
        if stacks.device.type != "cpu":
            return self.plain(stacks)
        batch = batch_rows(stacks.flatten(0, 1).numpy(), self.grid)
        cells, _, cell = distinct(batch.code)
        times, _, time = distinct(batch.bin)
        events = Events(cell, time, batch.offsets)
        largest, total = GatedPool.apply(*self.factors(cells, times), events)
        number = torch.from_numpy(np.diff(batch.offsets)).to(total)[:, None]
        return self._joined((largest, total, number), stacks.shape[:2])

    def plain(self, stacks: Tensor) -> Tensor:
        """Compute the features row by row: for GPUs, exported files, and tests of the fused form."""
        kind, time, x, y = stacks.to(self.gate[0].weight)[..., None].unbind(-2)
        on = (kind == ROW_ON).to(kind) - (kind == ROW_OFF).to(kind)
        there = (kind != ROW_EMPTY).to(kind)
        inputs = torch.cat(_inputs(along(x, self.grid.width), along(y, self.grid.height), on), dim=-1)
        features = self.place(inputs) * self.gate(time / TIMES) * there
        pooled = features.amax(-2), features.sum(-2), there.sum(-2)
        return self._joined(pooled, stacks.shape[:2])

    def factors(self, cells: np.ndarray, times: np.ndarray) -> tuple[Tensor, Tensor]:
        """Return the two factors whose product is the features of an event.

        Args:
            cells: int (P,), values of `EventBatch.code`.
            times: int (T,), values of `EventBatch.bin`.

        Returns:
            The factor (P, WIDTH) of the cells, and the factor (T, WIDTH) of the times.
        """
        weight, (width, height, _) = self.gate[0].weight, self.grid
        sides = [along(torch.arange(side).to(weight)[:, None], side) for side in (width, height)]
        on = torch.from_numpy(2.0 * (cells >= width * height) - 1.0).to(weight)[:, None]
        places = _inputs(sides[0][cells % width], sides[1][cells // width % height], on)
        gates = self.gate(torch.from_numpy(times).to(weight)[:, None] / TIMES)
        return self.place(torch.cat(places, dim=-1)), gates

    def _joined(self, pooled: tuple[Tensor, Tensor, Tensor], shape: Sequence[int]) -> Tensor:
        """Return the trunk's outputs (B, OUTPUTS) from maxima, sums and numbers of all windows."""
        largest, total, number = (part.reshape(*shape, -1) for part in pooled)
        mean = total / number.clamp_min(1.0)
        return self.join(torch.cat([largest, mean, number / EVENTS], dim=-1).flatten(1))


def along(place: Tensor, side: int) -> Tensor:
    """Return Fourier features (..., 1 + 2 OCTAVES) of positions (..., 1) along a side of `side` pixels."""
    scaled = place * (2.0 / max(side - 1, 1)) - 1.0
    # The factors are Python numbers: a CUDA graph cannot record the copy of a tensor of factors to the GPU.
    turns = torch.cat([scaled * (math.pi * 2.0 ** (octave - 1)) for octave in range(OCTAVES)], dim=-1)
    return torch.cat([scaled, turns.sin(), turns.cos()], dim=-1)


def _inputs(x: Tensor, y: Tensor, on: Tensor) -> list[Tensor]:
    """Return the inputs of `EventSet.place`, from the Fourier features of an event's column and row."""
    parts = [1, OCTAVES, OCTAVES]
    (place_x, sin_x, cos_x), (place_y, sin_y, cos_y) = x.split(parts, -1), y.split(parts, -1)
    return [place_x, place_y, on, sin_x, sin_y, cos_x, cos_y]


class Events(NamedTuple):
    """Index of each event's cell and time in `Factors`; `offsets` as in `EventBatch`."""

    cell: np.ndarray
    time: np.ndarray
    offsets: np.ndarray


class Factors(NamedTuple):
    """The two factors of the events' features: a row for each cell, and a row for each time."""

    places: np.ndarray
    gates: np.ndarray


class EventTables:
    """`EventSet` with its current weights, tabulated: faster, and with the same bits in any batch."""

    def __init__(self, net: EventSet) -> None:
        """Compute the features of every cell and every time."""
        cells = 2 * net.grid.width * net.grid.height
        with torch.no_grad():
            places, gates = net.factors(np.arange(cells), np.arange(TIMES))
        self._grid, self._factors = net.grid, Factors(places.numpy(), gates.numpy())
        self._weight, self._bias = (value.detach().numpy().copy() for value in net.join[0].parameters())

    def __call__(self, stacks: np.ndarray) -> np.ndarray:
        """Return features (B, OUTPUTS) of stacks int16 (B, stack, EVENTS, 4).

        Raises:
            ValueError: A row is not an event of the sensor.
        """
        batch = batch_rows(stacks.reshape(-1, *stacks.shape[2:]), self._grid)
        largest, total = (np.zeros((len(batch), WIDTH), self._bias.dtype) for _ in range(2))
        unused = np.empty((len(batch), WIDTH), np.int32)
        _pool(self._factors, Events(batch.code, batch.bin, batch.offsets), largest, total, unused)
        number = np.diff(batch.offsets).astype(self._bias.dtype)[:, None]
        pooled = np.concatenate([largest, total / np.maximum(number, 1.0), number / EVENTS], axis=1)
        return np.maximum(
            dense(pooled.reshape(len(stacks), len(self._weight[0])), self._weight, self._bias), 0.0
        )


class GatedPool(torch.autograd.Function):
    """Maximum and sum over each window's events of places[cell] * gates[time], both at least 0."""

    @staticmethod
    def forward(ctx: Any, places: Tensor, gates: Tensor, events: Events) -> tuple[Tensor, Tensor]:
        """Return maximum and sum (B, F)."""
        factors = Factors(places.detach().numpy(), gates.detach().numpy())
        shape = len(events.offsets) - 1, places.shape[1]
        largest, total = (np.zeros(shape, factors.places.dtype) for _ in range(2))
        winner = np.full(shape, -1, np.int32)
        _pool(factors, events, largest, total, winner)
        ctx.save_for_backward(places, gates)
        ctx.events, ctx.winner = events, winner
        return torch.from_numpy(largest), torch.from_numpy(total)

    @staticmethod
    def backward(ctx: Any, of_largest: Tensor, of_total: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradients of places and gates: every event counts in the sum, winners in the maximum."""
        factors = Factors(*(value.detach().numpy() for value in ctx.saved_tensors))
        found = Factors(*map(np.zeros_like, factors))
        gradients = of_largest.contiguous().numpy(), of_total.contiguous().numpy()
        _spread(*gradients, factors, ctx.events, ctx.winner, found)
        return *(torch.from_numpy(value) for value in found), None


@numba.njit(cache=True, error_model="numpy")
def _pool(factors, events, largest, total, winner) -> None:  # type: ignore[no-untyped-def]
    cell, time, offsets = events.cell, events.time, events.offsets
    for b in range(len(offsets) - 1):
        best, sums, who = largest[b], total[b], winner[b]
        for n in range(offsets[b], offsets[b + 1]):
            place, gate, event = factors.places[cell[n]], factors.gates[time[n]], np.int32(n)
            for j in range(len(best)):
                value = place[j] * gate[j]
                better = value > best[j]
                best[j] = value if better else best[j]
                who[j] = event if better else who[j]
                sums[j] += value


@numba.njit(cache=True, error_model="numpy")
def _spread(of_largest, of_total, factors, events, winner, found) -> None:  # type: ignore[no-untyped-def]
    places, gates, of_places, of_gates = factors.places, factors.gates, found.places, found.gates
    cell, time, offsets = events.cell, events.time, events.offsets
    for b in range(len(offsets) - 1):
        gradient = of_total[b]
        for n in range(offsets[b], offsets[b + 1]):
            place, gate = places[cell[n]], gates[time[n]]
            to_place, to_gate = of_places[cell[n]], of_gates[time[n]]
            for j in range(len(gradient)):
                to_place[j] += gradient[j] * gate[j]
                to_gate[j] += gradient[j] * place[j]
        for j in range(len(gradient)):
            n = winner[b, j]
            if n >= 0:
                of_places[cell[n], j] += of_largest[b, j] * gates[time[n], j]
                of_gates[time[n], j] += of_largest[b, j] * places[cell[n], j]
