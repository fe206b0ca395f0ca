"""The frozen encoder as an exact lookup table (appendix C), also for streams (appendix A.3).

x, y, p and the time bin are bounded: the context network is 2 H W rows of features and one row
of embedding per time bin. A context is the maximum of their sums, floored at 0, so that

    context(any chunks of a window, in any order) == context(the window),   bit for bit:

a sum is rounded the same in every chunk, and a maximum does not round. The rows are computed
in float64 and rounded once; `tests/test_table.py` states the distance to the module.
"""

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import torch

from models.batch import Grid, index_events, index_packed
from models.embedding import embedding_table
from models.evae import EventVAE


@dataclass(frozen=True)
class EncoderTable:
    """An event encoder without a network: read-only arrays of the model's dtype (float32).

    Attributes:
        grid: Sensor size and time bins.
        features: (cells, D) rows for each (p, y, x), or (y, x) without polarity; >= 0.
        embedding: (time_bins, D), or one row of zeros for an encoder without time.
        hidden: Weight (256, D) and bias (256,) of the encoder's first layer.
        head: Weight (latent, 256) and bias (latent,) of mu.
    """

    grid: Grid
    features: np.ndarray
    embedding: np.ndarray
    hidden: tuple[np.ndarray, np.ndarray]
    head: tuple[np.ndarray, np.ndarray]

    @classmethod
    def from_evae(cls, evae: EventVAE) -> "EncoderTable":
        """Tabulate a model by its running statistics; the table has the model's dtype."""
        settings, dtype = evae.settings, str(evae.encoder[0].weight.dtype).removeprefix("torch.")
        context, latent = settings["context"], settings["latent"]
        exact = EventVAE(**settings).double()
        exact.load_state_dict(evae.state_dict())
        with torch.no_grad():
            features = _read_only(exact.ecn.cell_features(), dtype)
        first, _, last = exact.encoder
        if settings["variant"] == "brp_full":
            grid, embedding = evae.grid, embedding_table(settings["time_bins"], context, dtype)
        else:
            grid, embedding = evae.grid._replace(time_bins=1), _read_only(torch.zeros(1, context), dtype)
        return cls(
            grid=grid,
            features=features,
            embedding=embedding,
            hidden=(_read_only(first.weight, dtype), _read_only(first.bias, dtype)),
            head=(_read_only(last.weight[:latent], dtype), _read_only(last.bias[:latent], dtype)),
        )

    def empty(self) -> np.ndarray:
        """Context (D,) of no event: zeros."""
        return np.zeros(self.features.shape[1], self.features.dtype)

    def update(self, context: np.ndarray, events: Any, start_us: int, window_us: int) -> np.ndarray:
        """Context (D,) after more events of the same window; `context` is left as it was.

        Raises:
            ValueError: As `models.batch.index_events`, or `context` is not one of this table's.
        """
        if context.shape != self.features.shape[1:] or context.dtype != self.features.dtype:
            expected = f"{self.features.dtype} {self.features.shape[1:]}"
            raise ValueError(
                f"context must be {expected} (start from empty()), got {context.dtype} {context.shape}"
            )
        address = index_events(tuple(events[name] for name in "txyp"), start_us, window_us, self.grid)
        result = context.copy()
        _raise_to(self.features, self.embedding, address, result)
        return result

    def latent(self, context: np.ndarray) -> np.ndarray:
        """Latent mu (latent,) of a context (D,)."""
        return _mlp(context, *self.hidden, *self.head)

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
        latents = np.empty((len(windows), len(self.head[1])), self.features.dtype)
        for row, window in enumerate(windows):
            context = self.empty()
            _raise_to(self.features, self.embedding, index_packed(window, self.grid), context)
            latents[row] = self.latent(context)
        return latents


def _read_only(tensor: torch.Tensor, dtype: str) -> np.ndarray:
    array = np.ascontiguousarray(tensor.detach().numpy()).astype(dtype)
    array.setflags(write=False)
    return array


@numba.njit(cache=True, error_model="numpy")
def _raise_to(features, embedding, address, context) -> None:  # type: ignore[no-untyped-def]
    """Raise `context` (D,) to the maximum over the addressed events (2, N)."""
    cells = len(features)
    for n in range(address.shape[1]):
        feature, code = features[address[0, n] % cells], embedding[address[1, n]]
        for j in range(len(context)):
            value = feature[j] + code[j]
            context[j] = value if value > context[j] else context[j]


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
