"""Map a file into memory, and release the pages that have been read."""

import contextlib
import mmap
from collections.abc import Callable, Iterator

import numpy as np

from envs.recordings.event_file import Request

PAGE = mmap.ALLOCATIONGRANULARITY


def mapped(
    request: Request, start: int, dtype: np.dtype, count: int
) -> tuple[np.ndarray, Callable[[int], None]]:
    """Map a file from byte `start` on, without copying it into memory.

    Returns:
        `count` entries of the dtype, and a function that releases the memory of the entries before an
        index; a later access reads them again.
    """
    with request.path.open("rb") as file:
        whole = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)

    def forget(stop: int) -> None:
        size = (start + stop * dtype.itemsize) // PAGE * PAGE
        if size:
            with contextlib.suppress(OSError, AttributeError, ValueError):  # a hint: not every system has it
                whole.madvise(mmap.MADV_DONTNEED, 0, size)

    return np.frombuffer(whole, dtype, count, start), forget


def mapped_parts(request: Request, start: int, dtype: np.dtype, count: int) -> Iterator[np.ndarray]:
    """Yield the entries of a file in parts of about `part_events` entries."""
    values, forget = mapped(request, start, dtype, count)
    for first in range(0, count, request.part_events):
        stop = min(count, first + request.part_events)
        yield values[first:stop]
        forget(stop)
