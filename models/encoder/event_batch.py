"""Convert windows of raw events to table indices (addresses), checked once on entry.

x, y, p and the time bin take finitely many values (appendix C), so an event is two small
integers. Training (`EventBatch`) and the frozen table read the same addresses.
"""

import itertools
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


class Span(NamedTuple):
    """Start of a window on the clock of its events, and its length [us]."""

    start_us: int
    window_us: int


@dataclass(frozen=True)
class EventBatch:
    """Windows of events as addresses; windows may be empty and of different sizes.

    Attributes:
        grid: Sensor size and time bins of the addresses.
        code: int32 (N,): ((p > 0) * height + y) * width + x.
        bin: int32 (N,): time bin in the event's own window.
        offsets: int64 (B + 1,): window b holds events offsets[b] .. offsets[b + 1] - 1.
    """

    grid: Grid
    code: np.ndarray
    bin: np.ndarray
    offsets: np.ndarray

    def __post_init__(self) -> None:
        """Raise ValueError for addresses that would make a kernel read outside its tables."""
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
        if (ends[1:] < ends[:-1]).any():
            raise ValueError(f"offsets must not decrease, got {ends}")

    @classmethod
    def known(cls, grid: Grid, address: np.ndarray, offsets: np.ndarray) -> "EventBatch":
        """Return a batch of addresses (2, N) that this module has computed, without checking them."""
        batch = object.__new__(cls)
        batch.__dict__.update(grid=grid, code=address[0], bin=address[1], offsets=offsets)
        return batch

    def __len__(self) -> int:
        """Return the number of windows."""
        return len(self.offsets) - 1

    @property
    def window(self) -> np.ndarray:
        """Return the window of each event, int64 (N,)."""
        return np.repeat(np.arange(len(self)), np.diff(self.offsets))

    @property
    def x(self) -> np.ndarray:
        """Return the column of each event, int32 (N,)."""
        return self.code % self.grid.width

    @property
    def y(self) -> np.ndarray:
        """Return the row of each event, int32 (N,)."""
        return self.code // self.grid.width % self.grid.height

    @property
    def on(self) -> np.ndarray:
        """Return which events are ON, bool (N,)."""
        return self.code >= self.grid.width * self.grid.height


def index_events(fields: tuple[np.ndarray, ...], start_us: int, window_us: int, grid: Grid) -> np.ndarray:
    """Return the addresses of one window's events.

    Args:
        fields: t [us], x, y [pixels], p (-1 or +1): integer arrays (N,) in this order.
        start_us: Start of the window on the clock of t.
        window_us: Length of the window, 1 .. 2^46.
        grid: Sensor size and time bins.

    Returns:
        int32 (2, N): code and time bin, as in `EventBatch`.

    Raises:
        ValueError: A field is not integer, an event lies outside the sensor, p is not -1 or +1,
            or the length of the window is out of range.
    """
    for name, values in zip("txyp", fields, strict=True):
        if values.dtype.kind not in "iu":
            raise ValueError(f"event field {name} must hold integers (t: int64 us), got {values.dtype}")
    if not 1 <= window_us <= MAX_WINDOW_US:
        raise ValueError(f"window_us must be in 1..{MAX_WINDOW_US}, got {window_us}")
    address = np.empty((2, len(fields[0])), np.int32)
    bad = _index(*fields, Span(int(start_us), int(window_us)), grid, address)
    if bad >= 0:
        x, y, p = (int(values[bad]) for values in fields[1:])
        rule = f"need 0 <= x < {grid.width}, 0 <= y < {grid.height}, p = -1 or 1; crop before encoding"
        raise ValueError(f"event {bad} has x={x}, y={y}, p={p}: {rule}")
    return address


@numba.njit(cache=True, error_model="numpy")
def _index(t, x, y, p, span, grid, address) -> int:  # type: ignore[no-untyped-def]
    """Fill `address` (2, N); return the index of the first invalid event, or -1."""
    width, height = grid.width, grid.height
    for n in range(len(t)):
        column, row, sign = np.int64(x[n]), np.int64(y[n]), np.int64(p[n])
        if column < 0 or column >= width or row < 0 or row >= height or sign * sign != 1:
            return n
        address[0, n] = ((sign + 1) // 2 * height + row) * width + column
        address[1, n] = time_bin(np.int64(t[n]), span.start_us, span.window_us, grid.time_bins)
    return -1


def batch_windows(windows: Iterable[tuple[Any, int, int]], grid: Grid) -> EventBatch:
    """Batch windows given as (events, start_us, window_us); events have the fields t, x, y, p by name.

    Raises:
        ValueError: As in `index_events`.
    """
    parts = [
        index_events(tuple(events[name] for name in "txyp"), start_us, window_us, grid)
        for events, start_us, window_us in windows
    ]
    address = parts[0] if len(parts) == 1 else np.concatenate([np.empty((2, 0), np.int32), *parts], axis=1)
    return EventBatch.known(grid, address, _sums([part.shape[1] for part in parts]))


def batch_packed(windows: np.ndarray | Sequence[np.ndarray], grid: Grid) -> EventBatch:
    """Batch packed windows of any lengths in one compiled call.

    Args:
        windows: Each an int32 (rows, 4): row 0 is [count, dropped, window_us, 0], the next `count`
            rows are [t - start, x, y, p]. A window without events may be all zeros. One array
            (B, capacity + 1, 4) of equally long windows is not copied.
        grid: Sensor size and time bins.

    Raises:
        ValueError: Wrong shape or dtype, a count larger than the rows, or as in `index_events`; the message
            names the window.
    """
    rows, starts = _flat_rows(windows)
    address, offsets, bad = _index_packed(rows, starts, grid)
    if bad >= 0:
        _refuse(bad, rows[starts[bad] : starts[bad + 1]], grid)
    return EventBatch.known(grid, address, offsets)


def _flat_rows(windows: np.ndarray | Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows (R, 4) of all windows, and each window's start and the last one's end (B + 1,)."""
    for number, window in enumerate(windows):
        if window.shape[1:] != (4,) or not len(window) or window.dtype.kind != "i":
            rule = "a packed window is int32 (count + 1, 4)"
            raise ValueError(f"window {number}: {rule}, got {window.dtype} {window.shape}")
    starts = _sums([len(window) for window in windows])
    if isinstance(windows, np.ndarray):
        return windows.reshape(-1, 4), starts
    return np.concatenate([np.empty((0, 4), np.int32), *windows]), starts


@numba.njit(cache=True, error_model="numpy")
def _index_packed(rows, starts, grid):  # type: ignore[no-untyped-def]
    """Return addresses int32 (2, N), offsets (B + 1,), and the first invalid window or -1."""
    offsets = np.zeros(len(starts), np.int64)
    for b in range(len(starts) - 1):
        count, window_us = rows[starts[b], 0], rows[starts[b], 2]
        if not 0 <= count < starts[b + 1] - starts[b] or (count > 0 and not 1 <= window_us <= MAX_WINDOW_US):
            return np.empty((2, 0), np.int32), offsets, b
        offsets[b + 1] = offsets[b] + count
    address = np.empty((2, offsets[-1]), np.int32)
    for b in range(len(starts) - 1):
        first, count = starts[b] + 1, offsets[b + 1] - offsets[b]
        events = rows[first : first + count]
        span = Span(np.int64(0), np.int64(rows[first - 1, 2]))  # type: ignore[arg-type]
        own = address[:, offsets[b] : offsets[b + 1]]
        if _index(events[:, 0], events[:, 1], events[:, 2], events[:, 3], span, grid, own) >= 0:
            return address, offsets, b
    return address, offsets, -1


def _refuse(number: int, window: np.ndarray, grid: Grid) -> None:
    """Raise ValueError with the reason why `_index_packed` rejected a window."""
    count, window_us = int(window[0, 0]), int(window[0, 2])
    if not 0 <= count < len(window):
        raise ValueError(f"window {number} announces {count} events, its capacity is {len(window) - 1}")
    try:
        index_events(tuple(window[1 : count + 1].T), 0, window_us, grid)
    except ValueError as error:
        raise ValueError(f"window {number}: {error}") from None


def cut_packed(window: np.ndarray) -> np.ndarray:
    """Return a copy of the used rows of a packed window, int32 (count + 1, 4)."""
    return window[: int(window[0, 0]) + 1].copy()


def thin(batch: EventBatch, most: int) -> EventBatch:
    """Return at most `most` events of each window, spread evenly over their order.

    A larger window is divided into `most` equal parts; the middle event of each part is returned.
    """
    counts = np.diff(batch.offsets)
    if counts.max(initial=0) <= most:
        return batch
    kept = np.minimum(counts, most)
    offsets = np.zeros_like(batch.offsets)
    np.cumsum(kept, out=offsets[1:])
    window = np.repeat(np.arange(len(batch)), kept)
    place = np.arange(offsets[-1]) - offsets[window]
    chosen = batch.offsets[window] + (2 * place + 1) * counts[window] // (2 * kept[window])
    return EventBatch.known(batch.grid, np.stack([batch.code[chosen], batch.bin[chosen]]), offsets)


def event_rows(batch: EventBatch, size: int) -> np.ndarray:
    """Return windows as arrays of fixed size, int16 (B, size, 4): [kind, time bin, x, y] of each event.

    kind is 1 for ON, 2 for OFF, and 0 for the empty rows after the window's last event. Assumes at most
    `size` events in each window, and width, height and time bins of at most 2^15.
    """
    rows = np.zeros((len(batch), size, 4), np.int16)
    _roll(batch.code, batch.bin, batch.offsets, batch.grid, rows)
    return rows


@numba.njit(cache=True, error_model="numpy")
def _roll(code, bins, offsets, grid, rows) -> None:  # type: ignore[no-untyped-def]
    width, height = grid.width, grid.height
    for b in range(len(rows)):
        for k in range(offsets[b + 1] - offsets[b]):
            cell, row = code[offsets[b] + k], rows[b, k]
            row[0] = ROW_ON if cell >= width * height else ROW_OFF
            row[1] = bins[offsets[b] + k]
            row[2], row[3] = cell % width, cell // width % height


def batch_rows(rows: np.ndarray, grid: Grid) -> EventBatch:
    """Batch windows in the format of `event_rows`, integers (B, size, 4); skip empty rows.

    Raises:
        ValueError: A row is not an event of the grid.
    """
    address = np.empty((2, rows.shape[0] * rows.shape[1]), np.int32)
    offsets = np.zeros(len(rows) + 1, np.int64)
    bad = _unroll(rows, grid, address, offsets)
    if bad >= 0:
        kind, time, x, y = rows.reshape(-1, 4)[bad].tolist()
        rule = f"need kind 0, 1 or 2, time < {grid.time_bins}, x < {grid.width}, y < {grid.height}"
        raise ValueError(f"row {bad} of events has kind={kind}, time={time}, x={x}, y={y}: {rule}")
    return EventBatch.known(grid, address[:, : offsets[-1]], offsets)


@numba.njit(cache=True, error_model="numpy")
def _unroll(rows, grid, address, offsets) -> int:  # type: ignore[no-untyped-def]
    """Fill `address` and `offsets`; return the index of the first invalid row, or -1."""
    width, height = grid.width, grid.height
    found = 0
    for b in range(rows.shape[0]):
        for k in range(rows.shape[1]):
            kind, time = np.int64(rows[b, k, 0]), np.int64(rows[b, k, 1])
            x, y = np.int64(rows[b, k, 2]), np.int64(rows[b, k, 3])
            if kind == ROW_EMPTY:
                continue
            inside = 0 <= x < width and 0 <= y < height and 0 <= time < grid.time_bins
            if not inside or (kind != ROW_ON and kind != ROW_OFF):
                return b * rows.shape[1] + k
            address[0, found] = ((kind == ROW_ON) * height + y) * width + x
            address[1, found] = time
            found += 1
        offsets[b + 1] = found
    return -1


def distinct(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the distinct values of non-negative integers, their counts, and the index of each value in them.

    Returns:
        present (U,) in ascending order, multiplicity (U,), rank int32 (N,) with present[rank] == values.
    """
    multiplicity = np.bincount(values)
    present = np.flatnonzero(multiplicity)
    rank = np.empty(len(multiplicity), np.int32)
    rank[present] = np.arange(len(present), dtype=np.int32)
    return present, multiplicity[present], rank[values]


def _sums(sizes: list[int]) -> np.ndarray:
    """Return 0 and the running sums of sizes, int64 (B + 1,); faster than numpy for short lists."""
    return np.array(list(itertools.accumulate(sizes, initial=0)), np.int64)
