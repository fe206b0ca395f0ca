"""The maximum over events, or a lower rank, by operations of torch for a GPU (`models.encoder.context`).

All sums of a feature and a code are made at once (4 N D bytes) and searched window by window; the gradient
then follows the winners alone. Sums and maxima are rounded as on a processor.
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
        features: Of each cell (U, D), >= 0, on any device.
        codes: Of each time bin (T, D), in the precision of the features.
        address: Cell and time bin of each event, integers (N,) each.
        offsets: Window b holds events offsets[b] .. offsets[b + 1] - 1, int64 (B + 1,).
        rank: 1 for the largest; a window of fewer events has the context 0.

    Returns:
        Context (B, D) with a gradient, and the bin int64 (B, D) of the event that it is from, of equal ones
        the first in the order of ranks, 0 without one.
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
    """Return the rank-th largest of each column (D,) and its row; equal values stay in order."""
    if rank == 1:
        return torch.max(values, 0)
    ordered, rows = torch.sort(values, dim=0, descending=True, stable=True)
    return ordered[rank - 1], rows[rank - 1]
