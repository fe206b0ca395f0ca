"""The neighbour filter (`core.neighbour_filter`) of a policy that receives raw events."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from core.neighbour_filter import passing, quiet_sensor


@dataclass(frozen=True)
class EventFilter:
    """A neighbour filter and its state within one episode.

    Attributes:
        support: Neighbours needed, 1 to 8.
        tau_us: Maximum age of a neighbour's last event [us].
        last_us: Time of each pixel's last event, int64 (height + 2, width + 2) with a rim; updated by each
            call.
    """

    support: int
    tau_us: int
    last_us: np.ndarray

    def __call__(self, events: Any) -> dict[str, np.ndarray]:
        """Return the events that pass, in their order.

        Args:
            events: Integer arrays t [us], x, y, p by name, in time order, not earlier than the last call's
                events.

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
        passes = passing(t_us, x, y, self.last_us, self.support, self.tau_us)
        return {name: array[passes] for name, array in arrays.items()}


def filter_of(sensor: Mapping[str, Any], width: int, height: int) -> EventFilter | None:
    """Return the filter of a manifest's sensor settings at an episode's start; None if they define none."""
    if not sensor.get("filter_support"):
        return None
    last_us = quiet_sensor(width, height)
    return EventFilter(int(sensor["filter_support"]), int(sensor["filter_tau_us"]), last_us)
