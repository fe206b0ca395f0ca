"""Map a file into memory, and let go of what has been read."""

import contextlib
import mmap
from collections.abc import Iterator

import numpy as np

from envs.recordings.event_file import Request

PAGE = mmap.ALLOCATIONGRANULARITY


class Mapped:
    """The bytes of a file behind its header, as an array, without copying them into memory."""

    def __init__(self, request: Request, start: int, dtype: np.dtype, count: int) -> None:
        """Map `count` entries of a dtype from byte `start` on."""
        self._start, self._itemsize = start, dtype.itemsize
        with request.path.open("rb") as file:
            self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        self.values = np.frombuffer(self._map, dtype, count, start)

    def forget(self, stop: int) -> None:
        """Take the entries before `stop` out of memory; they are read again if they are needed."""
        size = (self._start + stop * self._itemsize) // PAGE * PAGE
        if size:
            with contextlib.suppress(OSError, AttributeError, ValueError):  # a hint: not every system has it
                self._map.madvise(mmap.MADV_DONTNEED, 0, size)


def mapped_parts(request: Request, start: int, dtype: np.dtype, count: int) -> Iterator[np.ndarray]:
    """Yield the entries of a file in parts of about `part_events` entries."""
    if not count:
        return
    mapped = Mapped(request, start, dtype, count)
    for first in range(0, count, request.part_events):
        stop = min(count, first + request.part_events)
        yield mapped.values[first:stop]
        mapped.forget(stop)
