"""A sample of the event windows that a frozen encoder was shown, to measure its drift on."""

from collections import deque
from typing import Any

import numpy as np

from models.encoder.event_batch import cut_packed

MOST = 128  # windows


class WindowSample:
    """The newest windows: one of each vector step, of each episode in turn.

    Attributes:
        windows: As `models.encoder.event_batch.cut_packed` cuts them.
        steps: Vector steps so far, which say whose turn it is.
    """

    def __init__(self) -> None:
        """Begin without windows."""
        self.windows: deque[np.ndarray] = deque(maxlen=MOST)
        self.steps = 0

    def add(self, observations: Any) -> None:
        """Copy the window of the episode whose turn it is, out of packed windows of all episodes."""
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
        """Continue from the windows of `arrays`, after so many steps."""
        ends = np.cumsum(arrays["met_rows"])[:-1]
        windows = np.split(arrays["met"], ends) if len(arrays["met_rows"]) else []
        self.windows, self.steps = deque(windows, maxlen=MOST), steps
