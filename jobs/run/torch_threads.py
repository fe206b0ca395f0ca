"""Set torch's number of threads for a block."""

import contextlib
from collections.abc import Iterator

import torch


@contextlib.contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Set torch's number of threads to `count` for a block, and restore it afterwards.

    The number of threads changes the order of sums and so their rounding: the number that one part of a job
    uses must not change the results of the next part.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
