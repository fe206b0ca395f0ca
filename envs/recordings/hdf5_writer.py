"""Write events as HDF5 in DSEC's layout, in parts, with filters that every HDF5 reader supports."""

import contextlib
import io
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from core.files import replaced
from envs.recordings.event_file import Append
from envs.recordings.hdf5 import check_span
from envs.recordings.hdf5_layouts import NOISE

CHUNK = 1 << 16
TYPES = {"events/t": "i8", "events/x": "u2", "events/y": "u2", "events/p": "u1"}
# Filters that are part of HDF5 itself; others need a plug-in that C++ and MATLAB do not have.
PACKING = {"compression": "gzip", "compression_opts": 1, "shuffle": True, "fletcher32": True}
FILL_MS = 1 << 20  # entries of the index that are written at once


@contextlib.contextmanager
def hdf5_writer(path: Path, width: int, height: int, is_labelled: bool) -> Iterator[Append]:
    """Yield a function that adds events to an HDF5 file, with the sensor's size as attributes.

    Raises:
        ValueError: The events last too long for an index of milliseconds.
    """
    types = TYPES | ({NOISE: "u1"} if is_labelled else {})
    with replaced(path) as part, Forgiving(part, "w+") as target:
        with h5py.File(target, "w") as file:
            for name, kind in types.items():
                file.create_dataset(name, (0,), kind, maxshape=(None,), chunks=(CHUNK,), **PACKING)
            file.create_dataset("ms_to_idx", (0,), "u8", maxshape=(None,), chunks=(CHUNK,), **PACKING)
            file.attrs["width"], file.attrs["height"] = width, height
            file.attrs["timestamp_scale_ms"] = 1e-3
            file["t_offset"] = np.int64(0)
            yield Adding(path, file, target)
        target.check()


class Forgiving(io.FileIO):
    """A file that defers write errors: HDF5 crashes the process if a write fails, as on a full disk."""

    error: OSError | None = None

    def check(self) -> None:
        """Raise the first error, if there was one."""
        if self.error is not None:
            raise self.error

    def write(self, data: memoryview) -> int:  # type: ignore[override]
        """Write all bytes."""
        rest = memoryview(data).cast("B")
        try:
            while len(rest) and self.error is None:
                rest = rest[super().write(rest) :]
        except OSError as error:
            self.error = error
        return len(data)

    def truncate(self, size: int | None = None) -> int:
        """Set the size of the file."""
        try:
            if self.error is None:
                super().truncate(size)
        except OSError as error:
            self.error = error
        return size or 0


class Adding:
    """Add events to the data sets of a file, at most one chunk at a time."""

    def __init__(self, path: Path, file: h5py.File, target: Forgiving) -> None:
        """Start with empty data sets."""
        self._path, self._file, self._target = path, file, target
        self._offset_us: int | None = None
        self._count, self._next_ms = 0, 0

    def __call__(self, events: np.ndarray, is_noise: np.ndarray | None) -> None:
        """Add events; raises ValueError if they last too long, OSError if the disk is full.

        Rows are written for all columns at a time, so that a truncated file contains whole events.
        """
        for first in range(0, len(events), CHUNK):
            rows = slice(first, first + CHUNK)
            self._add(events[rows], None if is_noise is None else is_noise[rows])

    def _add(self, events: np.ndarray, is_noise: np.ndarray | None) -> None:
        """Add some events."""
        if self._offset_us is None:
            self._offset_us = int(events["t"][0])
            self._file["t_offset"][()] = self._offset_us
        t_us = events["t"] - self._offset_us
        check_span(self._path, t_us)
        columns = {"t": t_us, "x": events["x"], "y": events["y"], "p": events["p"] > 0}
        for name, values in columns.items():
            self._extend(f"events/{name}", values)
        if is_noise is not None:
            self._extend(NOISE, is_noise)
        self._index(t_us)
        self._count += len(events)
        self._target.check()

    def _extend(self, name: str, values: np.ndarray) -> None:
        """Add values to a data set."""
        data = self._file[name]
        first = len(data)
        data.resize((first + len(values),))
        data[first:] = values

    def _index(self, t_us: np.ndarray) -> None:
        """Extend the index by the first event at or after each new millisecond."""
        stop = int(t_us[-1]) // 1000 + 1
        for first in range(self._next_ms, stop, FILL_MS):
            ms = np.arange(first, min(stop, first + FILL_MS), dtype=np.int64)
            self._extend("ms_to_idx", self._count + np.searchsorted(t_us, ms * 1000).astype(np.uint64))
        self._next_ms = max(self._next_ms, stop)
