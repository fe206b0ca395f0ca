"""Read N-MNIST and N-Caltech101: 40 bits per event, x 8, y 8, p 1, t 23 (microseconds)."""

from collections.abc import Iterator

import numpy as np

from envs.recordings.clocks import unwrap
from envs.recordings.event_file import Opened, Part, Request, assemble, whole_entries
from envs.recordings.mapped import mapped_parts

NMNIST_SIZE = (34, 34)
OVERFLOW_ROW, OVERFLOW_US = 240, 1 << 13


def read_nmnist(request: Request) -> Opened:
    """Open an N-MNIST or N-Caltech101 file; the size is N-MNIST's unless the caller gives another.

    Row 240 marks an overflow of the camera's own counter: it is no event, and shifts all later
    times by 8,192 us, as in the data set's own reader. The 23-bit clock of 8.4 s is unwrapped.
    """
    count = request.check_declared(whole_entries(request, 0, 5))
    if request.width is None and request.height is None:
        request = request.sized(*NMNIST_SIZE)
    return Opened("nmnist", request, _parts(request, count))


def _parts(request: Request, count: int) -> Iterator[Part]:
    """Yield the events of the 5-byte entries."""
    last_us, turns = -1, 0
    for raw in mapped_parts(request, 0, np.dtype("V5"), count):
        body = raw.view(np.uint8).reshape(-1, 5)
        counter = (body[:, 2] & 127).astype(np.uint32) << 16 | body[:, 3].astype(np.uint32) << 8 | body[:, 4]
        overflows = body[:, 1] == OVERFLOW_ROW
        counted = unwrap(counter, 23, last_us)
        t_us = counted + OVERFLOW_US * (turns + np.cumsum(overflows))
        last_us, turns = int(counted[-1]), turns + int(np.count_nonzero(overflows))
        request.tally.skipped += int(np.count_nonzero(overflows))
        kept = body[~overflows]
        yield assemble(request, t_us[~overflows], kept[:, 0], kept[:, 1], kept[:, 2] >> 7)
