"""Define how a format is written: a function that adds events, and the parts in which it does."""

from collections.abc import Callable, Iterator

import numpy as np

# Adds events, and labels where the format has them.
Append = Callable[[np.ndarray, np.ndarray | None], None]
CHUNK_EVENTS = 1 << 18  # as many are converted at once


def chunks(events: np.ndarray) -> Iterator[np.ndarray]:
    """Yield events in parts that are converted at once."""
    for first in range(0, len(events), CHUNK_EVENTS):
        yield events[first : first + CHUNK_EVENTS]
