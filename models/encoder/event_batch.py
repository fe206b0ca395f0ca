"""Events as addresses: windows of raw events become table indices, checked once at the border.

x, y, p and the time bin take finitely many values (appendix C), so that an event is two small
integers. Training (`EventBatch`) and the frozen table read the same addresses.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numba
import numpy as np

from models.encoder.embedding import time_bin

MAX_WINDOW_US = 1 << 46
ROW_EMPTY, ROW_ON, ROW_OFF = 0, 1, 2  # kinds of a row of `event_rows`


class Grid(NamedTuple):
    """The finite set of events: x < width, y < height, p = -1 or +1, and a time bin."""

    width: int
    height: int
    time_bins: int


@dataclass(frozen=True)
class EventBatch:
    """Windows of events as addresses; empty windows and mixed sizes are welcome.

    Attributes:
        grid: What the addresses mean.
        code: int32 (N,): ((p > 0) * height + y) * width + x.
        bin: int32 (N,): time bin in the event's own window.
        offsets: int64 (B + 1,): window b holds events offsets[b] .. offsets[b + 1] - 1.
    """

    grid: Grid
    code: np.ndarray
    bin: np.ndarray
    offsets: np.ndarray

    def __post_init__(self) -> None:
        """Refuse addresses that would make a kernel read outside its tables."""
        limits = (
            ("code", self.code, 2 * self.grid.width * self.grid.height),
            ("bin", self.bin, self.grid.time_bins),
        )
        for name, values, limit in limits:
            if values.dtype != np.int32 or values.shape != self.code.shape:
                raise ValueError(f"{name} must be int32, one per event, got {values.dtype} {values.shape}")
            if len(values) and not 0 <= values.min() <= values.max() < limit:
                raise ValueError(f"{name} must lie in 0..{limit - 1}, got {values.min()}..{values.max()}")
        ends = self.offsets
        if ends.dtype != np.int64 or len(ends) < 1 or ends[0] != 0 or ends[-1] != len(self.code):
            raise ValueError(f"offsets must be int64 from 0 to {len(self.code)} events, got {ends}")
        if np.any(np.diff(ends) < 0):
            raise ValueError(f"offsets must not decrease, got {ends}")

    def __len__(self) -> int:
        """Number of windows."""
        return len(self.offsets) - 1


def address_events(events: Any, start_us: int, window_us: int, grid: Grid) -> np.ndarray:
    """As `index_events`, of events whose fields t, x, y, p have names."""
    return index_events(tuple(events[name] for name in "txyp"), start_us, window_us, grid)


def index_events(fields: tuple[np.ndarray, ...], start_us: int, window_us: int, grid: Grid) -> np.ndarray:
    """Addresses of one window's events.

    Args:
        fields: t [us], x, y [pixels], p (-1 or +1): integer arrays (N,) in this order.
        start_us: Start of the window on the clock of t.
        window_us: Length of the window, 1 .. 2^46.
        grid: Sensor size and time bins.

    Returns:
        int32 (2, N): code and time bin, as in `EventBatch`.

    Raises:
        ValueError: A field is not integer, an event lies off the sensor or has another
            polarity, or the window has no length.
    """
    for name, values in zip("txyp", fields, strict=True):
        if values.dtype.kind not in "iu":
            raise ValueError(f"event field {name} must hold integers (t: int64 us), got {values.dtype}")
    if not 1 <= window_us <= MAX_WINDOW_US:
        raise ValueError(f"window_us must be in 1..{MAX_WINDOW_US}, got {window_us}")
    address = np.empty((2, len(fields[0])), np.int32)
    bad = _index(*fields, (int(start_us), int(window_us)), (grid.width, grid.height, grid.time_bins), address)
    if bad >= 0:
        x, y, p = (int(values[bad]) for values in fields[1:])
        rule = f"need 0 <= x < {grid.width}, 0 <= y < {grid.height}, p = -1 or 1; crop before encoding"
        raise ValueError(f"event {bad} has x={x}, y={y}, p={p}: {rule}")
    return address


@numba.njit(cache=True, error_model="numpy")
def _index(t, x, y, p, span, grid, address) -> int:  # type: ignore[no-untyped-def]
    """Fill `address` (2, N); the index of the first refused event, or -1."""
    width, height, time_bins = grid
    for n in range(len(t)):
        column, row, sign = np.int64(x[n]), np.int64(y[n]), np.int64(p[n])
        if column < 0 or column >= width or row < 0 or row >= height or sign * sign != 1:
            return n
        address[0, n] = ((sign + 1) // 2 * height + row) * width + column
        address[1, n] = time_bin(np.int64(t[n]), span[0], span[1], time_bins)
    return -1


def batch_windows(windows: Iterable[tuple[Any, int, int]], grid: Grid) -> EventBatch:
    """Batch windows given as (events, start_us, window_us); events as in `address_events`.

    Raises:
        ValueError: As `index_events`.
    """
    return _join([address_events(*window, grid) for window in windows], grid)


def batch_packed(windows: np.ndarray | Sequence[np.ndarray], grid: Grid) -> EventBatch:
    """Batch packed windows, int32 (B, capacity + 1, 4) as the environment observes them, or cut short.

    Raises:
        ValueError: As `unpack_fields` and `index_events`.
    """
    return _join([index_packed(window, grid) for window in windows], grid)


def index_packed(window: np.ndarray, grid: Grid) -> np.ndarray:
    """Addresses int32 (2, count) of one packed window, int32 (capacity + 1, 4).

    Row 0 is [count, dropped, window_us, 0], the next `count` rows are [t - start, x, y, p].
    A window without events may be all zeros.

    Raises:
        ValueError: Wrong shape or dtype, a count beyond the capacity, or as `index_events`.
    """
    if window.dtype.kind != "i" or window.ndim != 2 or window.shape[1] != 4 or len(window) < 1:
        raise ValueError(f"a packed window is int32 (capacity + 1, 4), got {window.dtype} {window.shape}")
    count, window_us = int(window[0, 0]), int(window[0, 2])
    if not 0 <= count < len(window):
        raise ValueError(f"packed window announces {count} events, its capacity is {len(window) - 1}")
    if count == 0:
        return np.empty((2, 0), np.int32)
    rows = window[1 : count + 1]
    return index_events((rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3]), 0, window_us, grid)


def cut_packed(window: np.ndarray) -> np.ndarray:
    """The used rows of a packed window, int32 (count + 1, 4), as a copy to keep."""
    return window[: int(window[0, 0]) + 1].copy()


def thin(address: np.ndarray, most: int) -> np.ndarray:
    """At most `most` of a window's addresses (2, N), evenly over their order.

    Of N > most the one in the middle of each of `most` equal parts is kept.
    """
    count = address.shape[1]
    if count <= most:
        return address
    return address[:, ((2 * np.arange(most) + 1) * count) // (2 * most)]


@numba.njit(cache=True, error_model="numpy")
def event_rows(address: np.ndarray, size: int, width: int, height: int) -> np.ndarray:
    """A window's addresses as an array of fixed size, int16 (size, 4): [kind, time bin, x, y] each.

    Args:
        address: int32 (2, N) with N <= size; sides and time bins are at most 2^15.
        size: Rows.
        width: Pixels.
        height: Pixels.

    Returns:
        kind is 1 for ON, 2 for OFF, 0 for no event: the rows after the N events.
    """
    rows = np.zeros((size, 4), np.int16)
    for n in range(address.shape[1]):
        code = address[0, n]
        rows[n, 0] = ROW_ON if code >= width * height else ROW_OFF
        rows[n, 1] = address[1, n]
        rows[n, 2], rows[n, 3] = code % width, code // width % height
    return rows


def batch_rows(rows: np.ndarray, grid: Grid) -> EventBatch:
    """Batch windows given as `event_rows`, integers (B, size, 4); rows without an event are left out.

    Raises:
        ValueError: A row is no event of the grid.
    """
    address = np.empty((2, rows.shape[0] * rows.shape[1]), np.int32)
    offsets = np.zeros(len(rows) + 1, np.int64)
    bad = _unroll(rows, (grid.width, grid.height, grid.time_bins), address, offsets)
    if bad >= 0:
        kind, time, x, y = rows.reshape(-1, 4)[bad].tolist()
        rule = f"need kind 0, 1 or 2, time < {grid.time_bins}, x < {grid.width}, y < {grid.height}"
        raise ValueError(f"row {bad} of events has kind={kind}, time={time}, x={x}, y={y}: {rule}")
    code, time_bins = address[:, : offsets[-1]]
    return EventBatch(grid, code, time_bins, offsets)


@numba.njit(cache=True, error_model="numpy")
def _unroll(rows, grid, address, offsets) -> int:  # type: ignore[no-untyped-def]
    """Fill `address` and `offsets`; the index of the first refused row, or -1."""
    width, height, time_bins = grid
    found = 0
    for b in range(rows.shape[0]):
        for k in range(rows.shape[1]):
            kind, time = np.int64(rows[b, k, 0]), np.int64(rows[b, k, 1])
            x, y = np.int64(rows[b, k, 2]), np.int64(rows[b, k, 3])
            if kind == ROW_EMPTY:
                continue
            inside = 0 <= x < width and 0 <= y < height and 0 <= time < time_bins
            if not inside or (kind != ROW_ON and kind != ROW_OFF):
                return b * rows.shape[1] + k
            address[0, found] = ((kind == ROW_ON) * height + y) * width + x
            address[1, found] = time
            found += 1
        offsets[b + 1] = found
    return -1


def distinct(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distinct non-negative integers, how often each occurs, and the place of each value among them.

    Returns:
        present (U,) in rising order, multiplicity (U,), rank int32 (N,) with present[rank] == values.
    """
    multiplicity = np.bincount(values)
    present = np.flatnonzero(multiplicity)
    rank = np.empty(len(multiplicity), np.int32)
    rank[present] = np.arange(len(present), dtype=np.int32)
    return present, multiplicity[present], rank[values]


def _join(parts: list[np.ndarray], grid: Grid) -> EventBatch:
    offsets = np.zeros(len(parts) + 1, np.int64)
    np.cumsum([part.shape[1] for part in parts], out=offsets[1:])
    code, time_bins = np.concatenate([np.empty((2, 0), np.int32), *parts], axis=1)
    return EventBatch(grid, code, time_bins, offsets)
