"""The time of an event as network input: a bin of its window, and the code of that bin.

Time is normalised by the fixed window, t = (t_us - start_us) / window_us in (0, 1], newest
near 1 (appendix A.3), and then quantised to the centre of one of `time_bins` bins. The grid
is part of the model, so a table with one row per bin reproduces the model exactly.

A code is added to the features of an event before the maximum over events:

- "additive": sines and cosines of t (paper equation 1).
- "eventnet": minus the age 1 - t, EventNet's decay. EventNet's rotation by the age of the winning
  event follows after the maximum (`eventnet_phase`).
- "none": nothing.
"""

import functools
from typing import get_args

import numba
import numpy as np
import numpy.typing as npt

from models.kinds import Coding

CODINGS: tuple[str, ...] = get_args(Coding)


def temporal_embedding(t: npt.ArrayLike, context: int) -> np.ndarray:
    """Embed normalised times: [sin(w t) | cos(w t)] with w_i = 100 / 1000^(i / context).

    Args:
        t: Times in [0, 1], any shape (...,).
        context: Even number of features.

    Returns:
        float64 (..., context), values in [-1, 1].

    Raises:
        ValueError: `context` is odd or below 2, or a time is outside [0, 1] or not finite.

    Source: paper equation 1 and appendix A.2, with the constants of the published code:
    i = 0 .. context/2 - 1, from 15.9 down to 0.51 cycles per window.
    """
    if context < 2 or context % 2:
        raise ValueError(f"context must be even and at least 2 (a sine and a cosine each), got {context}")
    times = np.asarray(t, np.float64)
    if not np.all((times >= 0) & (times <= 1)):
        raise ValueError("t must lie in [0, 1]: subtract the start of the window and divide by its length")
    phase = times[..., None] * (100.0 / 1000.0 ** (np.arange(context // 2) / context))
    return np.concatenate([np.sin(phase), np.cos(phase)], axis=-1)


def time_code(t: npt.ArrayLike, context: int, coding: str) -> np.ndarray:
    """Return the codes that are added to the features of events at normalised times: float64 (..., context).

    Raises:
        ValueError: As in `temporal_embedding`, or the coding is unknown.

    Source: paper equation 1 and equation 4 (appendix A.2).
    """
    embedded = temporal_embedding(t, context)
    if coding == "additive":
        return embedded
    if coding not in CODINGS:
        raise ValueError(f"coding must be one of {', '.join(CODINGS)}, got {coding!r}")
    times = np.asarray(t, np.float64)[..., None]
    return np.broadcast_to(times - 1.0 if coding == "eventnet" else 0.0, embedded.shape)


def bin_centres(time_bins: int) -> np.ndarray:
    """Return the normalised centre of each bin (time_bins,); left edges would triple the latent's error."""
    return (np.arange(time_bins) + 0.5) / time_bins


@functools.lru_cache(maxsize=4)
def embedding_table(
    time_bins: int, context: int, dtype: str = "float32", coding: str = "additive"
) -> np.ndarray:
    """Return the code of each bin's centre, read-only `dtype` (time_bins, context); one zero row for "none".

    Computed in float64 and rounded once.
    """
    centres = bin_centres(1 if coding == "none" else time_bins)
    table = np.array(time_code(centres, context, coding), dtype)
    table.setflags(write=False)
    return table


@functools.lru_cache(maxsize=4)
def eventnet_phase(time_bins: int, dtype: str) -> np.ndarray:
    """Return real and imaginary part of exp(-i 2 pi age) of each bin, read-only `dtype` (2, time_bins).

    Source: paper equation 4 (appendix A.2), from EventNet (Sekikawa et al. 2019).
    """
    angle = 2.0 * np.pi * (1.0 - bin_centres(time_bins))
    phase = np.stack([np.cos(angle), -np.sin(angle)]).astype(dtype)
    phase.setflags(write=False)
    return phase


@numba.njit(cache=True, error_model="numpy")
def time_bin(t_us: int, start_us: int, window_us: int, time_bins: int) -> int:
    """Return the bin of an event: clip(floor(time_bins (t_us - start_us) / window_us), 0, time_bins - 1).

    Exact integer arithmetic; a float32 clock would lose microseconds after 17 s. An event outside
    its window gets the nearest bin. Assumes window_us in [1, 2^46] and time_bins <= 65536,
    so that nothing overflows.
    """
    offset_us = min(max(t_us, start_us), start_us + window_us) - start_us
    return min(offset_us * time_bins // window_us, time_bins - 1)
