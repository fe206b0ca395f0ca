"""Spatio-temporal correlation filter: an event without recent events at neighbouring pixels is noise.

An event passes if at least `support` of its 8 neighbours fired, in either polarity, at most `tau_us`
earlier. Its own pixel does not count, so a hot pixel alone never passes. A removed event still counts as
a neighbour of later ones. Among simultaneous events only those earlier in the stream count: the result
depends on the order of the stream, but not on how the stream is cut into pieces.

Source: the background activity filter of Delbruck, "Frame-free dynamic digital vision" (2008).
"""

import numba
import numpy as np

NEVER = -(2**62)  # earlier than any time minus any tau


def quiet_sensor(width: int, height: int) -> np.ndarray:
    """Return the last firing time of each pixel of a sensor that has never fired.

    int64 (height + 2, width + 2) [us], including a rim of one pixel that cannot fire.
    """
    return np.full((height + 2, width + 2), NEVER, np.int64)


def filter_neighbours(events: np.ndarray, last_us: np.ndarray, support: int, tau_us: int) -> np.ndarray:
    """Return the events that pass, in their order.

    Args:
        events: Events with fields t [us], x, y, in time order and within the sensor; t >= 0 and not earlier
            than the events of previous calls.
        last_us: From `quiet_sensor` at the start of an episode; updated in place.
        support: Neighbours needed, 0 to 8; 0 passes every event and does not update `last_us`.
        tau_us: Maximum age of a neighbour's last event [us], at least 0.

    Raises:
        ValueError: `support` or `tau_us` is out of its range.
    """
    if not 0 <= support <= 8 or tau_us < 0:
        raise ValueError(f"support must be in 0..8 and tau_us >= 0; got {support} and {tau_us}.")
    if support == 0:
        return events
    x, y = (events[name].astype(np.int64) for name in "xy")
    return events[passing(events["t"], x, y, last_us, support, tau_us)]


@numba.njit(cache=True, error_model="numpy")
def filter_all(
    events: np.ndarray, ends: np.ndarray, last_us: np.ndarray, support: np.ndarray, tau_us: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Run `filter_neighbours` for several sensors.

    Args:
        events: EVENT of all sensors, one sensor after the other.
        ends: int64 (B + 1,), sensor b has events ends[b] .. ends[b + 1] - 1.
        last_us: int64 (B, height + 2, width + 2), from `quiet_sensor`; updated in place.
        support: int64 (B,), in 0..8.
        tau_us: int64 (B,), >= 0.

    Returns:
        EVENT of the events that pass, and their ends.
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
def passing(
    t_us: np.ndarray, x: np.ndarray, y: np.ndarray, last_us: np.ndarray, support: int, tau_us: int
) -> np.ndarray:
    """Return which events pass, bool (N,). Arguments as in `filter_neighbours`, int64 (N,) each."""
    passes = np.empty(t_us.size, np.bool_)
    for i in range(t_us.size):
        passes[i] = is_supported(x[i], y[i], t_us[i], last_us, support, tau_us)
    return passes


@numba.njit(cache=True, error_model="numpy")
def is_supported(x: int, y: int, t_us: int, last_us: np.ndarray, support: int, tau_us: int) -> bool:
    """Whether one event passes. Stores its time as the last one of its pixel."""
    since_us, fired = t_us - tau_us, 0
    for row in range(y, y + 3):  # the rim shifts pixels by one
        for column in range(x, x + 3):
            fired += last_us[row, column] >= since_us
    fired -= last_us[y + 1, x + 1] >= since_us
    last_us[y + 1, x + 1] = t_us
    return fired >= support
