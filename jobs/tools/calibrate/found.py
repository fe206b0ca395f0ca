"""What was found of a setting: a value with its interval, or why there is none."""

from typing import NamedTuple

import numpy as np

from jobs.analysis.statistics import CONFIDENCE

DRAWS = 400
TAILS = (1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2


class Found(NamedTuple):
    """A setting of the camera or its faults.

    Attributes:
        value: None: it cannot be told from this recording.
        low, high: Ends of the 95 % interval.
        reason: Why there is no value.
    """

    value: float | None
    low: float = np.nan
    high: float = np.nan
    reason: str = ""


def missing(reason: str) -> Found:
    """A setting that cannot be told."""
    return Found(None, reason=reason)


def at_most(value: float) -> Found:
    """A setting that may as well be 0."""
    return missing(f"at most {value:.2g}")


def resampled(pixels: int, rng: np.random.Generator) -> np.ndarray:
    """How often each of so many pixels is drawn, in `DRAWS` draws of as many with replacement; (DRAWS, P)."""
    return rng.multinomial(pixels, np.full(pixels, 1.0 / pixels), DRAWS).astype(np.float64)


def with_interval(value: float, drawn: np.ndarray) -> Found:
    """A value, and the middle 95 % of what it is in resamples, (D,); what is no number does not count."""
    drawn = drawn[np.isfinite(drawn)]
    low, high = np.quantile(drawn, TAILS) if drawn.size else (np.nan, np.nan)
    return Found(float(value), float(low), float(high))
