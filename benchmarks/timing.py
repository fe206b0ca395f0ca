"""Time of pieces of work that take turns, so that a slow minute of the machine hits all of them alike."""

import time
from collections.abc import Callable, Hashable, Mapping
from typing import TypeVar

import numpy as np

Name = TypeVar("Name", bound=Hashable)


def interleaved(
    work: Mapping[Name, Callable[[], object]],
    rounds: int = 5,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[Name, float]:
    """Median seconds of each piece of work; a first round, which compiles, does not count.

    Args:
        work: Name -> what is timed.
        rounds: How often each piece is timed.
        clock: Tells seconds: wall time, or `time.thread_time` and the like.
    """
    taken: dict[Name, list[float]] = {name: [] for name in work}
    for _ in range(rounds + 1):
        for name, piece in work.items():
            start = clock()
            piece()
            taken[name].append(clock() - start)
    return {name: float(np.median(seconds[1:])) for name, seconds in taken.items()}
