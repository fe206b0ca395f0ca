"""The frozen encoder as an exact lookup table (appendix C), also for streams (appendix A.3).

x, y, p and the time bin are bounded, so the context network is 2 H W rows of features and one row
of embedding per time bin. A context is the maximum of their sums, floored at 0, so that

    context(any chunks of a window, in any order) == context(the window),   bit for bit:

a sum is rounded the same in every chunk, and a maximum does not round. The rows are computed
in float64 and rounded once, to the model's precision or a smaller one; `tests/models/encoder/test_table.py`
states the bound on the difference from the model.

With `pool_rank` r > 1 a context holds the r largest sums of each feature, (r, D). Such lists also merge in
any order, so chunks stay exact. The latent reads the r-th sum.

With EventNet's coding a context also holds the time bin of the event behind each magnitude, the
newest in a tie. The phase of that bin is applied when the latent is computed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numba
import numpy as np
import torch

from models.encoder.embedding import bin_centres, eventnet_phase, time_code
from models.encoder.evae import EventVAE
from models.encoder.event_batch import EventBatch, Grid, batch_packed, batch_windows, thin

PRECISIONS = ("model", "int16", "int8")
INT16_TOP, INT8_TOP = 32_767, 127
BLOCK = 128  # features whose largest sums are sorted together; of 16 to 256 the fastest for 256 features


@dataclass(frozen=True)
class EncoderTable:
    """An event encoder without a network: read-only arrays.

    Attributes:
        grid: Sensor size and time bins.
        features: (cells, D) rows for each (p, y, x), or (y, x) without polarity; >= 0.
        embedding: Code of each time bin (time_bins, D), or one row of zeros for an encoder without time.
        hidden: Weight (256, D or 2 D) and bias (256,) of the encoder's first layer; the weight
            takes a context in the units of the rows.
        head: Weight (latent, 256) and bias (latent,) of mu.
        phase: Real and imaginary part of each time bin's phase (2, time_bins), for EventNet's coding.
        pool_rank: Rank of the sum of each feature that the latent reads, see `models.encoder.context`.
        most_events: Whole windows are thinned to this number of events before they are encoded
            (`models.encoder.event_batch.thin`); None: never. `update` uses every event of a stream.
    """

    grid: Grid
    features: np.ndarray
    embedding: np.ndarray
    hidden: tuple[np.ndarray, np.ndarray]
    head: tuple[np.ndarray, np.ndarray]
    phase: np.ndarray | None = None
    pool_rank: int = 1
    most_events: int | None = None

    @classmethod
    def from_evae(
        cls, evae: EventVAE, precision: str = "model", time_bins: int | None = None
    ) -> "EncoderTable":
        """Tabulate a model, using its running statistics.

        Args:
            evae: The model.
            precision: Number type of the rows. "model": the model's dtype (float32), exact.
                "int16": fixed point with one scale for all rows, a power of two, 2^-11 for features
                below 15; it halves the bytes read per event, and is more exact than float16, which
                CPUs would have to convert. "int8": one scale for each feature.
            time_bins: Resolution of time; None: the model's, exact.

        Raises:
            ValueError: The precision is unknown, time_bins is out of the model's range, or the weights
                are neither float32 nor float64.
        """
        if precision not in PRECISIONS:
            raise ValueError(f"precision must be one of {', '.join(PRECISIONS)}, got {precision!r}")
        dtype = str(evae.encoder[0].weight.dtype).removeprefix("torch.")
        if dtype not in ("float32", "float64"):
            raise ValueError(f"weights must be float32 or float64, got {dtype}: call evae.float()")
        exact = _exact(evae, time_bins)
        with torch.no_grad():
            features = exact.ecn.cell_features().numpy()
        coding = exact.ecn.coding
        grid = exact.grid._replace(time_bins=1) if coding == "none" else exact.grid
        embedding = time_code(bin_centres(grid.time_bins), features.shape[1], coding)
        features, embedding, scale = _rounded(features, embedding, precision, dtype)
        rows = _read_only(np.concatenate((features, embedding)))  # large enough for large pages of memory
        first, _, last = exact.encoder
        hidden = _array(first.weight) * np.resize(scale, first.in_features), _array(first.bias)
        head = [_array(part)[: evae.settings.latent] for part in (last.weight, last.bias)]
        return cls(
            grid=grid,
            features=rows[: len(features)],
            embedding=rows[len(features) :],
            hidden=(_read_only(hidden[0], dtype), _read_only(hidden[1], dtype)),
            head=(_read_only(head[0], dtype), _read_only(head[1], dtype)),
            phase=eventnet_phase(grid.time_bins, dtype) if coding == "eventnet" else None,
            pool_rank=exact.ecn.pool_rank,
        )

    def empty(self) -> np.ndarray:
        """Return the context of an empty window: zeros (D,); int16 for int8 rows, to hold their sums.

        With a pool rank above 1 it is (pool_rank, D), the largest sums in descending order. With EventNet's
        coding it is (2, D), magnitudes and time bins, and int32 for integer rows.
        """
        dtype = self.features.dtype
        if self.phase is not None:
            return np.zeros((2, self.features.shape[1]), np.int32 if dtype.kind == "i" else dtype)
        shape = self.features.shape[1:] if self.pool_rank == 1 else (self.pool_rank, self.features.shape[1])
        return np.zeros(shape, np.int16 if dtype == np.int8 else dtype)

    def update(self, context: np.ndarray, events: Any, start_us: int, window_us: int) -> np.ndarray:
        """Return the context after more events of the same window; `context` (see `empty`) is not changed.

        Raises:
            ValueError: As in `models.encoder.event_batch.index_events`, or `context` has not the shape and
                dtype of this table's contexts.
        """
        own = self.empty()
        if context.shape != own.shape or context.dtype != own.dtype:
            expected = f"{own.dtype} {own.shape}"
            raise ValueError(
                f"context must be {expected} (start from empty()), got {context.dtype} {context.shape}"
            )
        result = context.copy()
        self._raise(batch_windows([(events, start_us, window_us)], self.grid), result[None])
        return result

    def _raise(self, batch: EventBatch, contexts: np.ndarray) -> None:
        """Raise each of `contexts` (B, ...) to the maximum of itself and its window's events."""
        kernel = _raise_to if self.phase is None else _raise_to_newest
        given = self.features, self.embedding, batch.code, batch.bin, batch.offsets, contexts
        if self.pool_rank == 1:
            kernel(*given)
        else:
            _raise_ranks(*given, (0,) * self.pool_rank)

    def latent(self, context: np.ndarray) -> np.ndarray:
        """Return the latent mu (latent,) of a context."""
        return self._latents(context[None])[0]

    def _latents(self, contexts: np.ndarray) -> np.ndarray:
        """Return latents (B, latent) of contexts (B, ...)."""
        read = contexts if self.pool_rank == 1 else np.ascontiguousarray(contexts[:, -1])
        values = read.astype(self.head[1].dtype, copy=False)
        if self.phase is not None:
            turns = self.phase[:, contexts[:, 1].astype(np.int64)]  # (2, B, D)
            values = np.concatenate(list(values[:, 0] * turns), axis=1)
        return _mlp(values, *self.hidden, *self.head)

    def encode(self, events: Any, start_us: int, window_us: int) -> np.ndarray:
        """Return the latent mu (latent,) of one window; without events, the latent of the zero context.

        Args:
            events: Structured array with integer fields t [us], x, y [pixels], p (-1 or +1).
            start_us: Start of the window on the clock of t.
            window_us: Length of the window [us].

        Raises:
            ValueError: As in `models.encoder.event_batch.index_events`.
        """
        return self.encode_batch(batch_windows([(events, start_us, window_us)], self.grid))[0]

    def encode_windows(self, windows: np.ndarray | Sequence[np.ndarray]) -> np.ndarray:
        """Return latents (B, latent) of packed windows int32 (rows, 4) of any lengths; same bits as `encode`.

        Raises:
            ValueError: As in `models.encoder.event_batch.batch_packed`.
        """
        return self.encode_batch(batch_packed(windows, self.grid))

    def encode_batch(self, batch: EventBatch) -> np.ndarray:
        """Return the latents (B, latent) of a batch on this table's `grid`."""
        own = self.empty()
        contexts = np.zeros((len(batch), *own.shape), own.dtype)
        self._raise(batch if self.most_events is None else thin(batch, self.most_events), contexts)
        return self._latents(contexts)


def _exact(evae: EventVAE, time_bins: int | None) -> EventVAE:
    """Return the model in float64 without its decoder, with `time_bins` time bins unless None."""
    settings = evae.settings
    exact = EventVAE.of(settings if time_bins is None else replace(settings, time_bins=time_bins))
    del exact.decoder  # not needed here, and large in float64
    exact = exact.double()
    exact.load_state_dict({k: v for k, v in evae.state_dict().items() if not k.startswith("decoder.")})
    return exact


def _rounded(
    features: np.ndarray, embedding: np.ndarray, precision: str, dtype: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray | float]:
    """Return the rows of features and embedding in this precision, and the value of one unit."""
    if precision == "model":
        return features.astype(dtype), embedding.astype(dtype), 1.0
    highest = features.max(axis=0) + 1.0  # the embedding lies in [-1, 1]
    if precision == "int16":
        scale = 2.0 ** np.ceil(np.log2(highest.max() / INT16_TOP))
        return np.rint(features / scale).astype("i2"), np.rint(embedding / scale).astype("i2"), scale
    scale = highest / INT8_TOP
    return np.rint(features / scale).astype("i1"), np.rint(embedding / scale).astype("i1"), scale


def _array(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().numpy()


def _read_only(array: np.ndarray, dtype: Any = None) -> np.ndarray:
    array = np.array(array, dtype, order="C")
    array.setflags(write=False)
    return array


@numba.njit(cache=True, error_model="numpy")
def _raise_to(features, embedding, code, bins, offsets, contexts) -> None:  # type: ignore[no-untyped-def]
    """Raise each row of `contexts` (B, D) to the maximum over its window's events.

    Processes four events at a time, so that the context is read and written a quarter as often; the
    last four may repeat an event, which changes no maximum. Each sum is cast to the type of the context,
    because numba would widen integers to int64, and fewer would fit into a vector register.
    """
    cells, unit = len(features), contexts.dtype.type
    for b in range(len(contexts)):
        context, last = contexts[b], offsets[b + 1] - 1
        for n in range(offsets[b], last + 1, 4):
            second, third, fourth = min(n + 1, last), min(n + 2, last), min(n + 3, last)
            feature_1, code_1 = features[code[n] % cells], embedding[bins[n]]
            feature_2, code_2 = features[code[second] % cells], embedding[bins[second]]
            feature_3, code_3 = features[code[third] % cells], embedding[bins[third]]
            feature_4, code_4 = features[code[fourth] % cells], embedding[bins[fourth]]
            for j in range(len(context)):
                early = max(unit(feature_1[j] + code_1[j]), unit(feature_2[j] + code_2[j]))
                late = max(unit(feature_3[j] + code_3[j]), unit(feature_4[j] + code_4[j]))
                context[j] = max(max(early, late), context[j])


@numba.njit(cache=True, error_model="numpy")
def _raise_ranks(features, embedding, code, bins, offsets, contexts, levels) -> None:  # type: ignore[no-untyped-def]
    """Run `_raise_to` for the largest sums: contexts (B, levels, D), in descending order of the levels."""
    cells, size = len(features), features.shape[1]
    none = np.zeros(size, features.dtype)
    blocks = np.zeros(((size + BLOCK - 1) // BLOCK, len(levels), BLOCK), contexts.dtype)
    for b in range(len(contexts)):
        for j in range(size):
            blocks[j // BLOCK, :, j % BLOCK] = contexts[b, :, j]
        whole = offsets[b + 1] - (offsets[b + 1] - offsets[b]) % 4
        for n in range(offsets[b], whole, 4):
            event_1 = features[code[n] % cells], embedding[bins[n]]
            event_2 = features[code[n + 1] % cells], embedding[bins[n + 1]]
            event_3 = features[code[n + 2] % cells], embedding[bins[n + 2]]
            event_4 = features[code[n + 3] % cells], embedding[bins[n + 3]]
            _sort_in(blocks, levels, event_1, event_2, event_3, event_4)
        for n in range(whole, offsets[b + 1]):
            event_1 = features[code[n] % cells], embedding[bins[n]]
            _sort_in(blocks, levels, event_1, (none, none), (none, none), (none, none))
        for j in range(size):
            contexts[b, :, j] = blocks[j // BLOCK, :, j % BLOCK]


@numba.njit(cache=True, error_model="numpy")
def _sort_in(blocks, levels, event_1, event_2, event_3, event_4) -> None:  # type: ignore[no-untyped-def]
    """Sort four events (row, code) into the largest sums (blocks, levels, BLOCK).

    The number of levels is part of the tuple's type, so the loop over levels is unrolled and a block's
    largest sums stay in registers. A row of zeros with a code of zeros changes nothing.
    """
    unit = blocks.dtype.type
    (row_1, code_1), (row_2, code_2) = event_1, event_2
    (row_3, code_3), (row_4, code_4) = event_3, event_4
    for block in range(len(blocks)):
        first, top = block * BLOCK, blocks[block]
        for i in range(min(BLOCK, len(row_1) - first)):
            j = first + i
            value_1, value_2 = unit(row_1[j] + code_1[j]), unit(row_2[j] + code_2[j])
            value_3, value_4 = unit(row_3[j] + code_3[j]), unit(row_4[j] + code_4[j])
            for k in range(len(levels)):
                largest = top[k, i]
                largest, value_1 = max(largest, value_1), min(largest, value_1)
                largest, value_2 = max(largest, value_2), min(largest, value_2)
                largest, value_3 = max(largest, value_3), min(largest, value_3)
                largest, value_4 = max(largest, value_4), min(largest, value_4)
                top[k, i] = largest


@numba.njit(cache=True, error_model="numpy")
def _raise_to_newest(features, embedding, code, bins, offsets, contexts) -> None:  # type: ignore[no-untyped-def]
    """Raise magnitudes and their time bins in `contexts` (B, 2, D); the newest event wins a tie."""
    cells, unit = len(features), contexts.dtype.type
    for b in range(len(contexts)):
        best, newest = contexts[b]
        for n in range(offsets[b], offsets[b + 1]):
            feature, shift, time = features[code[n] % cells], embedding[bins[n]], unit(bins[n])
            for j in range(len(best)):
                value = unit(feature[j] + shift[j])
                better = (value > best[j]) | ((value == best[j]) & (time > newest[j]))
                best[j] = value if better else best[j]
                newest[j] = time if better else newest[j]


@numba.njit(cache=True, error_model="numpy")
def _mlp(contexts, hidden_weight, hidden_bias, weight, bias):  # type: ignore[no-untyped-def]
    """Compute the second half of the encoder: ReLU layer, then mu (B, latent), from contexts (B, K)."""
    hidden = dense(contexts, hidden_weight, hidden_bias)
    return dense(np.maximum(hidden, np.float32(0.0)), weight, bias)


# Reordered sums can use vector registers (20 times faster). Which event wins does not depend on them.
@numba.njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def dense(inputs, weight, bias):  # type: ignore[no-untyped-def]
    """Return the products inputs (B, K) @ weight (M, K).T + bias (M,).

    Processes two rows of each matrix at a time, so that each number is loaded half as often. An odd last row
    is processed twice, so that its sums have the same order in any batch, which BLAS does not guarantee.
    """
    outputs = np.empty((len(inputs), len(bias)), bias.dtype)
    for i in range(0, len(bias), 2):
        k = min(i + 1, len(bias) - 1)
        for b in range(0, len(inputs), 2):
            c = min(b + 1, len(inputs) - 1)
            total_ib, total_ic, total_kb, total_kc = bias[i], bias[i], bias[k], bias[k]
            for j in range(inputs.shape[1]):
                total_ib += weight[i, j] * inputs[b, j]
                total_ic += weight[i, j] * inputs[c, j]
                total_kb += weight[k, j] * inputs[b, j]
                total_kc += weight[k, j] * inputs[c, j]
            outputs[b, i], outputs[c, i] = total_ib, total_ic
            outputs[b, k], outputs[c, k] = total_kb, total_kc
    return outputs
