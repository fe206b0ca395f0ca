"""Estimate of a setting: a value with its interval, or the reason for its absence."""

from typing import NamedTuple

import numpy as np

from jobs.analysis.statistics import CONFIDENCE

DRAWS = 400
TAILS = (1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2


class Found(NamedTuple):
    """Estimate of a setting of the camera or its faults.

    Attributes:
        value: The estimate; None: this recording does not determine the setting.
        low, high: Ends of the 95 % interval.
        reason: Why there is no value.
    """

    value: float | None
    low: float = np.nan
    high: float = np.nan
    reason: str = ""


def missing(reason: str) -> Found:
    """Return the estimate of a setting that cannot be determined."""
    return Found(None, reason=reason)


def neither(reason: str) -> tuple[Found, Found]:
    """Return two estimates that cannot be determined, for the same reason."""
    return missing(reason), missing(reason)


def at_most(value: float) -> Found:
    """Return an estimate without a value, with an upper limit as its reason."""
    return missing(f"at most {value:.2g}")


def resampled(pixels: int, rng: np.random.Generator) -> np.ndarray:
    """Count how often each pixel is drawn in each of `DRAWS` resamples with replacement; (DRAWS, P)."""
    return rng.multinomial(pixels, np.full(pixels, 1.0 / pixels), DRAWS).astype(np.float64)


def with_interval(value: float, drawn: np.ndarray) -> Found:
    """Return a value with the middle 95 % of its finite resamples, (D,), as its interval."""
    drawn = drawn[np.isfinite(drawn)]
    low, high = np.quantile(drawn, TAILS) if drawn.size else (np.nan, np.nan)
    return Found(float(value), float(low), float(high))
