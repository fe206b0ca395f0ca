"""The frozen encoder as an exact lookup table (appendix C), also for streams (appendix A.3).

x, y, p and the time bin are bounded: the context network is 2 H W rows of features and one row
of embedding per time bin. A context is the maximum of their sums, floored at 0, so that

    context(any chunks of a window, in any order) == context(the window),   bit for bit:

a sum is rounded the same in every chunk, and a maximum does not round. The rows are computed
in float64 and rounded once, to the model's precision or a smaller one; `tests/test_table.py`
states the distance to the module.
"""

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import torch

from models.batch import Grid, index_events, index_packed
from models.embedding import embedding_table
from models.evae import EventVAE

PRECISIONS = ("model", "int16", "int8")
INT16_TOP, INT8_TOP = 32_767, 127


@dataclass(frozen=True)
class EncoderTable:
    """An event encoder without a network: read-only arrays.

    Attributes:
        grid: Sensor size and time bins.
        features: (cells, D) rows for each (p, y, x), or (y, x) without polarity; >= 0.
        embedding: (time_bins, D), or one row of zeros for an encoder without time.
        hidden: Weight (256, D) and bias (256,) of the encoder's first layer; the weight takes
            a context in the units of the rows.
        head: Weight (latent, 256) and bias (latent,) of mu.
    """

    grid: Grid
    features: np.ndarray
    embedding: np.ndarray
    hidden: tuple[np.ndarray, np.ndarray]
    head: tuple[np.ndarray, np.ndarray]

    @classmethod
    def from_evae(
        cls, evae: EventVAE, precision: str = "model", time_bins: int | None = None
    ) -> "EncoderTable":
        """Tabulate a model by its running statistics.

        Args:
            evae: The model.
            precision: Of the rows. "model": the model's dtype (float32), exact. "int16": fixed
                point with one scale for all, a power of two, of 2^-11 for features below 15;
                it halves what an event reads, and is more exact than float16, which CPUs
                would have to convert. "int8": one scale for each feature.
            time_bins: Another resolution of time than the model's; None: the model's, exact.

        Raises:
            ValueError: Unknown precision, or time_bins out of the model's range.
        """
        if precision not in PRECISIONS:
            raise ValueError(f"precision must be one of {', '.join(PRECISIONS)}, got {precision!r}")
        settings = evae.settings if time_bins is None else {**evae.settings, "time_bins": time_bins}
        dtype = str(evae.encoder[0].weight.dtype).removeprefix("torch.")
        exact = EventVAE(**settings).double()
        exact.load_state_dict(evae.state_dict())
        with torch.no_grad():
            features = exact.ecn.cell_features().numpy()
        if settings["variant"] == "brp_full":
            grid = exact.grid
            embedding = embedding_table(grid.time_bins, settings["context"], "float64")
        else:
            grid, embedding = exact.grid._replace(time_bins=1), np.zeros((1, settings["context"]))
        features, embedding, scale = _rounded(features, embedding, precision, dtype)
        first, _, last = exact.encoder
        latent = settings["latent"]
        return cls(
            grid=grid,
            features=_read_only(features),
            embedding=_read_only(embedding),
            hidden=(_read_only(_array(first.weight) * scale, dtype), _read_only(_array(first.bias), dtype)),
            head=(
                _read_only(_array(last.weight)[:latent], dtype),
                _read_only(_array(last.bias)[:latent], dtype),
            ),
        )

    def empty(self) -> np.ndarray:
        """Context (D,) of no event: zeros, int16 for rows of int8, whose sums it holds."""
        dtype = np.int16 if self.features.dtype == np.int8 else self.features.dtype
        return np.zeros(self.features.shape[1], dtype)

    def update(self, context: np.ndarray, events: Any, start_us: int, window_us: int) -> np.ndarray:
        """Context (D,) after more events of the same window; `context` is left as it was.

        Raises:
            ValueError: As `models.batch.index_events`, or `context` is not one of this table's.
        """
        own = self.empty()
        if context.shape != own.shape or context.dtype != own.dtype:
            expected = f"{own.dtype} {own.shape}"
            raise ValueError(
                f"context must be {expected} (start from empty()), got {context.dtype} {context.shape}"
            )
        address = index_events(tuple(events[name] for name in "txyp"), start_us, window_us, self.grid)
        result = context.copy()
        _raise_to(self.features, self.embedding, address, result)
        return result

    def latent(self, context: np.ndarray) -> np.ndarray:
        """Latent mu (latent,) of a context (D,)."""
        return _mlp(context.astype(self.head[1].dtype), *self.hidden, *self.head)

    def encode(self, events: Any, start_us: int, window_us: int) -> np.ndarray:
        """Latent mu (latent,) of one window; without events, that of the zero context.

        Args:
            events: Structured array with integer fields t [us], x, y [pixels], p (-1 or +1).
            start_us: Start of the window on the clock of t.
            window_us: Length of the window [us].

        Raises:
            ValueError: As `models.batch.index_events`.
        """
        return self.latent(self.update(self.empty(), events, start_us, window_us))

    def encode_windows(self, windows: np.ndarray) -> np.ndarray:
        """Latents (B, latent) of packed windows, int32 (B, capacity + 1, 4); each as `encode`'s, bit for bit.

        Raises:
            ValueError: As `models.batch.index_packed`.
        """
        latents = np.empty((len(windows), len(self.head[1])), self.head[1].dtype)
        for row, window in enumerate(windows):
            context = self.empty()
            _raise_to(self.features, self.embedding, index_packed(window, self.grid), context)
            latents[row] = self.latent(context)
        return latents


def _rounded(
    features: np.ndarray, embedding: np.ndarray, precision: str, dtype: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray | float]:
    """Rows of features and embedding in their precision, and what one unit of theirs is worth."""
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
def _raise_to(features, embedding, address, context) -> None:  # type: ignore[no-untyped-def]
    """Raise `context` (D,) to the maximum over the addressed events (2, N).

    Four events at a time, so that the context is read and written a quarter as often; the
    last four may hold an event several times, which changes no maximum.
    """
    cells, last = len(features), address.shape[1] - 1
    for n in range(0, last + 1, 4):
        second, third, fourth = min(n + 1, last), min(n + 2, last), min(n + 3, last)
        feature_1, code_1 = features[address[0, n] % cells], embedding[address[1, n]]
        feature_2, code_2 = features[address[0, second] % cells], embedding[address[1, second]]
        feature_3, code_3 = features[address[0, third] % cells], embedding[address[1, third]]
        feature_4, code_4 = features[address[0, fourth] % cells], embedding[address[1, fourth]]
        for j in range(len(context)):
            early = max(feature_1[j] + code_1[j], feature_2[j] + code_2[j])
            late = max(feature_3[j] + code_3[j], feature_4[j] + code_4[j])
            context[j] = max(max(early, late), context[j])


# Reordering the sums lets them use vector registers (20 times faster); it decides no event.
@numba.njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _mlp(context, hidden_weight, hidden_bias, weight, bias):  # type: ignore[no-untyped-def]
    """Second half of the encoder: ReLU layer, then mu."""
    hidden = hidden_bias.copy()
    for i in range(len(hidden)):
        total = hidden[i]
        for j in range(len(context)):
            total += hidden_weight[i, j] * context[j]
        hidden[i] = max(total, np.float32(0.0))
    latent = bias.copy()
    for i in range(len(latent)):
        total = latent[i]
        for j in range(len(hidden)):
            total += weight[i, j] * hidden[j]
        latent[i] = total
    return latent
