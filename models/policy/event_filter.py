"""The neighbour filter of a policy that is shown raw events; that of `envs.events.neighbour_filter`.

An event passes if at least `support` of its 8 neighbours fired, in either polarity, at most `tau_us` before.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np

NEVER = -(2**62)  # earlier than any time minus any tau


@dataclass(frozen=True)
class EventFilter:
    """What a filter remembers of one episode.

    Attributes:
        support: Neighbours needed, 1 to 8.
        tau_us: How long ago they may have fired, at most [us].
        last_us: When each pixel fired last, int64 (height + 2, width + 2) with a rim; changed by each call.
    """

    support: int
    tau_us: int
    last_us: np.ndarray

    @classmethod
    def begin(cls, support: int, tau_us: int, width: int, height: int) -> "EventFilter":
        """That of an episode without events yet, on a sensor of so many pixels."""
        return cls(support, tau_us, np.full((height + 2, width + 2), NEVER, np.int64))

    def __call__(self, events: Any) -> dict[str, np.ndarray]:
        """The events that pass, in their order.

        Args:
            events: Integer arrays t [us], x, y, p by name, in time order, not before those of the last call.

        Raises:
            ValueError: An event lies outside the sensor.
        """
        arrays = {name: np.asarray(events[name]) for name in ("t", "x", "y", "p")}
        t_us, x, y = (arrays[name].astype(np.int64) for name in ("t", "x", "y"))
        height, width = np.subtract(self.last_us.shape, 2)
        outside = (x < 0) | (x >= width) | (y < 0) | (y >= height)
        if outside.any():
            at = int(outside.argmax())
            rule = f"must lie within {width} x {height} pixels"
            raise ValueError(f"events {rule}; event {at} is at x={x[at]}, y={y[at]}")
        passing = _passing(t_us, x, y, self.last_us, self.support, self.tau_us)
        return {name: array[passing] for name, array in arrays.items()}


def filter_of(sensor: Mapping[str, Any], width: int, height: int) -> EventFilter | None:
    """The filter of a policy's sensor settings, as a manifest holds them; None without one."""
    if not sensor.get("filter_support"):
        return None
    return EventFilter.begin(int(sensor["filter_support"]), int(sensor["filter_tau_us"]), width, height)


@numba.njit(cache=True, error_model="numpy")
def _passing(
    t_us: np.ndarray, x: np.ndarray, y: np.ndarray, last_us: np.ndarray, support: int, tau_us: int
) -> np.ndarray:
    """Which events pass, bool (N,); each becomes the last of its pixel."""
    passing = np.empty(t_us.size, np.bool_)
    for i in range(t_us.size):
        since_us, fired = t_us[i] - tau_us, 0
        for row in range(y[i], y[i] + 3):  # the rim shifts pixels by one
            for column in range(x[i], x[i] + 3):
                fired += last_us[row, column] >= since_us
        fired -= last_us[y[i] + 1, x[i] + 1] >= since_us
        last_us[y[i] + 1, x[i] + 1] = t_us[i]
        passing[i] = fired >= support
    return passing
