"""The maximum over events, or a lower rank, as torch operations for a GPU (see `models.encoder.context`).

All sums of a feature and a code are computed at once (4 N D bytes) and searched window by window; the
gradient then flows to the winners alone. Sums and maxima are rounded as on a CPU.
"""

import numpy as np
import torch
from torch import Tensor


def max_context(
    features: Tensor,
    codes: np.ndarray,
    address: tuple[np.ndarray, np.ndarray],
    offsets: np.ndarray,
    rank: int = 1,
) -> tuple[Tensor, Tensor]:
    """Return the rank-th largest over a window's events of ReLU(features[cell] + codes[bin]).

    Args:
        features: Features of each cell (U, D), >= 0, on any device.
        codes: Code of each time bin (T, D), in the precision of the features.
        address: Cell and time bin of each event, integers (N,) each.
        offsets: Window b holds events offsets[b] .. offsets[b + 1] - 1, int64 (B + 1,).
        rank: 1 for the largest; a window with fewer events has the context 0.

    Returns:
        Contexts (B, D) with a gradient, and the time bin int64 (B, D) of the event behind each value, 0 if
        there is none. Equal values rank in the order of their events.
    """
    cell, bins = (torch.from_numpy(part).to(features.device, torch.int64) for part in address)
    code = torch.tensor(codes, device=features.device)
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
