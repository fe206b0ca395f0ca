"""The maximum over events, or a lower rank, as torch operations for a GPU (see `models.encoder.context`).

All sums of a feature and a code are computed at once (4 N D bytes) and searched window by window; the
gradient then flows to the winners alone. Sums and maxima are rounded as on a CPU.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from models.encoder.products import affine


class Events(NamedTuple):
    """Cell and time bin of each event, `offsets` as in `EventBatch`, and the code of each time bin."""

    cell: np.ndarray
    bin: np.ndarray
    offsets: np.ndarray
    codes: np.ndarray


def max_on_device(
    h: Tensor, weight: Tensor, bias: Tensor, events: Events, squash: bool, rank: int
) -> tuple[Tensor, Tensor]:
    """Compute `models.encoder.context.MaxContext` with torch operations, on the device of the inputs.

    Returns:
        Contexts (B, D) with a gradient, and the time bin int64 (B, D) of the event behind each value, 0 if
        there is none. Equal values rank in the order of their events.
    """
    features = torch.relu(affine(h, weight, bias))
    features = torch.tanh(features) if squash else features
    cell, bins = (torch.from_numpy(part).to(h.device, torch.int64) for part in (events.cell, events.bin))
    code, offsets = torch.tensor(events.codes, device=h.device), events.offsets
    best = features.new_zeros((len(offsets) - 1, features.shape[1]))
    winner = torch.zeros_like(best, dtype=torch.int64)
    if len(cell) == 0:
        return best, winner
    with torch.no_grad():
        value = features.index_select(0, cell).add_(code.index_select(0, bins))
        for b, (first, stop) in enumerate(zip(offsets[:-1].tolist(), offsets[1:].tolist(), strict=True)):
            if stop - first >= rank:
                best[b], winner[b] = _of_rank(value[first:stop], rank)
                winner[b] += first
    seen, columns = best > 0, torch.arange(features.shape[1], device=features.device)
    raised = features[cell[winner], columns] + code[bins[winner], columns]
    return torch.where(seen, raised, 0.0), torch.where(seen, bins[winner], 0)


def _of_rank(values: Tensor, rank: int) -> tuple[Tensor, Tensor]:
    """Return the rank-th largest value of each column (D,) and its row; equal values rank in row order."""
    if rank == 1:
        return torch.max(values, 0)
    ordered, rows = torch.sort(values, dim=0, descending=True, stable=True)
    return ordered[rank - 1], rows[rank - 1]
