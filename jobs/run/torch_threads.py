"""Let torch take some threads for a while, and give them back."""

import contextlib
from collections.abc import Iterator

import torch


@contextlib.contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Let torch take `count` threads inside; afterwards as many as before.

    Sums are added in another order by other numbers of threads: what one part of a job took must not
    change the digits of the next.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
