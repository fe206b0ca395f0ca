"""Time pieces of work in alternation, so that a slow minute of the machine affects all of them equally."""

import time
from collections.abc import Callable, Hashable, Mapping
from typing import TypeVar

import numpy as np

Name = TypeVar("Name", bound=Hashable)


def interleaved(
    work: Mapping[Name, Callable[[], object]],
    rounds: int = 5,
    clock: Callable[[], float] = time.perf_counter,
    before: Mapping[Name, Callable[[], object]] | None = None,
) -> dict[Name, float]:
    """Return the median time of each piece of work [s]. A first round, which compiles, does not count.

    Args:
        work: Name -> the piece to time.
        rounds: How often each piece is timed.
        clock: Returns seconds of wall time or, like `time.process_time`, of process time.
        before: Name -> untimed function to run before each timing of the piece.
    """
    taken: dict[Name, list[float]] = {name: [] for name in work}
    for _ in range(rounds + 1):
        for name, piece in work.items():
            if before is not None:
                before[name]()
            start = clock()
            piece()
            taken[name].append(clock() - start)
    return {name: float(np.median(seconds[1:])) for name, seconds in taken.items()}
