"""Convert the events of a sensor into the events of a sensor with fewer, larger pixels."""

from typing import Literal

import numba
import numpy as np

from envs.events import EVENT
from envs.recordings.event_file import check_events


def downscale_events(
    events: np.ndarray,
    from_shape: tuple[int, int],
    to_shape: tuple[int, int],
    rule: Literal["integrate", "funnel"] = "integrate",
) -> np.ndarray:
    """Return events as a sensor with larger pixels would have sent them.

    Pixel (x, y) belongs to the larger pixel (x * new_width // width, y * new_height // height);
    if the sizes do not divide, blocks differ by one row or column.

    "integrate": a larger pixel sees the mean log luminance of its block, so each event of the
    block changes it by threshold / pixels of the block. It fires when the sum of polarities since
    its last event reaches plus or minus the number of pixels of the block; the remainder carries
    over. A change that the whole block shares gives the events of one pixel; noise that cancels
    in the block gives none. The sum starts at zero. Gruel et al. (VISAPP 2022) compare this
    family of rules ("event count") with the next one.

    "funnel": every event remains, at the divided coordinates ("event funnelling" in that paper).
    The number of events does not change, so the rate per pixel grows by the number of pixels in
    a block. Real sensors do not behave like this, but many readers do.

    Args:
        events: EVENT array (N,), sorted by t, inside `from_shape`.
        from_shape: Rows and columns of the sensor [px].
        to_shape: Rows and columns of the larger pixels; at most `from_shape`.
        rule: "integrate" or "funnel".

    Returns:
        EVENT array, sorted by t; "integrate" gives at most one event per event, at its time. In
        each block of n pixels the sums of polarities obey -n < sum in - n * sum out < n.

    Raises:
        ValueError: `to_shape` is larger than `from_shape` or not positive, the rule is unknown, or
            events are not valid for `from_shape`.
    """
    check_events(events, from_shape[1], from_shape[0])
    return Downscaler(from_shape, to_shape, rule)(events)


class Downscaler:
    """Apply `downscale_events` part by part; the sums of the blocks carry over to the next part."""

    def __init__(
        self,
        from_shape: tuple[int, int],
        to_shape: tuple[int, int],
        rule: Literal["integrate", "funnel"] = "integrate",
    ) -> None:
        """Start with the sums of all blocks at zero; raises as in `downscale_events`."""
        if not all(0 < new <= old for old, new in zip(from_shape, to_shape, strict=True)):
            raise ValueError(f"to_shape must lie between (1, 1) and from_shape={from_shape}, got {to_shape}")
        if rule not in ("integrate", "funnel"):
            raise ValueError(f"rule must be 'integrate' or 'funnel', got {rule!r}")
        self._row_of, self._column_of = (
            np.arange(old) * new // old for old, new in zip(from_shape, to_shape, strict=True)
        )
        self._rule = rule
        self._sizes = np.outer(np.bincount(self._row_of), np.bincount(self._column_of))
        self._sums = np.zeros(self._sizes.shape, np.int64)

    def __call__(self, events: np.ndarray) -> np.ndarray:
        """Return the events of the larger pixels for the next part of a valid recording."""
        if self._rule == "funnel":
            moved = events.copy()
            moved["x"], moved["y"] = self._column_of[events["x"]], self._row_of[events["y"]]
            return moved
        moved = np.empty(len(events), EVENT)
        count = _integrate(events, self._row_of, self._column_of, self._sizes, self._sums, moved)
        return moved[:count].copy()


@numba.njit(cache=True, error_model="numpy")
def _integrate(
    events: np.ndarray,
    row_of: np.ndarray,
    column_of: np.ndarray,
    sizes: np.ndarray,
    sums: np.ndarray,
    moved: np.ndarray,
) -> int:
    """Fill `moved`, return its number of events; `sizes` and `sums` are pixels and polarities per block."""
    count = 0
    for i in range(events.size):
        event = events[i]
        row, column = row_of[event.y], column_of[event.x]
        total = sums[row, column] + event.p
        if abs(total) >= sizes[row, column]:
            total -= event.p * sizes[row, column]
            new = moved[count]
            new.t, new.x, new.y, new.p = event.t, column, row, event.p
            count += 1
        sums[row, column] = total
    return count
