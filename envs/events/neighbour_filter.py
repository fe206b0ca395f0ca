"""Spatio-temporal correlation filter: an event without recent events beside it is taken for noise.

An event passes if at least `support` of its 8 neighbours fired, in either polarity, at most `tau_us`
earlier. Its own pixel says nothing, so that a hot pixel alone never passes. What is refused counts as
a neighbour all the same. Of events at one time those before it in the stream count, those after it do not:
what passes depends on the order of the stream, and not on how it is cut into pieces.

Source: the background activity filter of Delbruck, "Frame-free dynamic digital vision" (2008).
"""

import numba
import numpy as np

NEVER = -(2**62)  # earlier than any time minus any tau


def quiet_sensor(width: int, height: int) -> np.ndarray:
    """When each pixel last fired: never. int64 (height + 2, width + 2) [us], with a rim that cannot fire."""
    return np.full((height + 2, width + 2), NEVER, np.int64)


def filter_neighbours(events: np.ndarray, last_us: np.ndarray, support: int, tau_us: int) -> np.ndarray:
    """The events that pass, in their order.

    Args:
        events: EVENT in time order, within the sensor, t >= 0 and not before those of earlier calls.
        last_us: As of `quiet_sensor` at the start of an episode; it is brought up to date.
        support: Neighbours needed, 0 to 8; 0 passes every event, and leaves `last_us` as it was.
        tau_us: How long ago they may have fired [us], at least 0.

    Raises:
        ValueError: `support` or `tau_us` is out of its range.
    """
    if not 0 <= support <= 8 or tau_us < 0:
        raise ValueError(f"support must be in 0..8 and tau_us >= 0; got {support} and {tau_us}.")
    return events if support == 0 else events[_passing(events, last_us, support, tau_us)]


@numba.njit(cache=True, error_model="numpy")
def filter_all(
    events: np.ndarray, ends: np.ndarray, last_us: np.ndarray, support: np.ndarray, tau_us: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """`filter_neighbours` of several sensors.

    Args:
        events: EVENT of all, sensor after sensor.
        ends: int64 (B + 1,), sensor b has events ends[b] .. ends[b + 1] - 1.
        last_us: int64 (B, height + 2, width + 2), as of `quiet_sensor`, brought up to date.
        support: int64 (B,), in 0..8.
        tau_us: int64 (B,), >= 0.

    Returns:
        EVENT of those that pass, and their ends.
    """
    kept, new_ends, count = np.empty_like(events), np.zeros_like(ends), 0
    for b in range(support.size):
        for i in range(ends[b], ends[b + 1]):
            event = events[i]
            x, y = np.int64(event.x), np.int64(event.y)
            if support[b] == 0 or is_supported(x, y, event.t, last_us[b], support[b], tau_us[b]):
                kept[count] = event
                count += 1
        new_ends[b + 1] = count
    return kept[:count], new_ends


@numba.njit(cache=True, error_model="numpy")
def _passing(events: np.ndarray, last_us: np.ndarray, support: int, tau_us: int) -> np.ndarray:
    """Which events pass, bool (N,)."""
    passing = np.empty(events.size, np.bool_)
    for i in range(events.size):
        event = events[i]
        passing[i] = is_supported(np.int64(event.x), np.int64(event.y), event.t, last_us, support, tau_us)
    return passing


@numba.njit(cache=True, error_model="numpy")
def is_supported(x: int, y: int, t_us: int, last_us: np.ndarray, support: int, tau_us: int) -> bool:
    """Whether one event passes; it becomes the last of its pixel."""
    since_us, fired = t_us - tau_us, 0
    for row in range(y, y + 3):  # the rim shifts pixels by one
        for column in range(x, x + 3):
            fired += last_us[row, column] >= since_us
    fired -= last_us[y + 1, x + 1] >= since_us
    last_us[y + 1, x + 1] = t_us
    return fired >= support
