"""A sample of the event windows that a frozen encoder has read, for measuring its drift."""

from collections import deque
from typing import Any

import numpy as np

from models.encoder.event_batch import cut_packed

MOST = 128  # windows


class WindowSample:
    """The newest windows: one per vector step, from each environment in turn.

    Attributes:
        windows: Windows as returned by `models.encoder.event_batch.cut_packed`.
        steps: Number of vector steps so far, which determines whose turn it is.
    """

    def __init__(self) -> None:
        """Start without windows."""
        self.windows: deque[np.ndarray] = deque(maxlen=MOST)
        self.steps = 0

    def add(self, observations: Any) -> None:
        """Copy the window of the environment whose turn it is from all environments' packed windows."""
        self.windows.append(cut_packed(observations[self.steps % len(observations)]))
        self.steps += 1

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the windows as arrays, for `load`."""
        windows = list(self.windows)
        return {
            "met": np.concatenate(windows) if windows else np.empty(0),
            "met_rows": np.array([len(window) for window in windows], np.int64),
        }

    def load(self, arrays: dict[str, np.ndarray], steps: int) -> None:
        """Restore the windows of `arrays`, after `steps` vector steps."""
        ends = np.cumsum(arrays["met_rows"])[:-1]
        windows = np.split(arrays["met"], ends) if len(arrays["met_rows"]) else []
        self.windows, self.steps = deque(windows, maxlen=MOST), steps
