"""Set torch's number of threads for a block."""

import contextlib
from collections.abc import Iterator

import torch


@contextlib.contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Set torch's number of threads to `count` for a block, and restore it afterwards.

    Sums are added in another order by other numbers of threads: what one part of a job took must not
    change the digits of the next.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
