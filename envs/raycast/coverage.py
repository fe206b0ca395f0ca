"""Kernels that paint one column: areas between straight edges, by exact coverage.

Layer STEPS of the accumulators holds the difference in brightness between each row of pixels
and the row above, so that a flat area of any height costs few additions; PAINT holds luminance
added to a single row. `resolve` adds the background (sky above the horizon, plain ground below)
once per column: an area is painted as its difference from the background, and background
that nothing hides costs nothing.

An edge is straight from the left to the right end of the strip being painted, and is given by
its rows at both ends. Where edges divide a strip, the shares of each row add up to exactly one.
"""

from enum import IntEnum

import numpy as np

from envs.compiled import inlined, kernel
from envs.raycast.records import Ends, Record

MIN_RISE = 1e-9  # [rows] an edge that rises less counts as level
BLOCK = 4  # columns resolved together, because independent sums run in parallel
PADDING = 3  # elements of a layer beyond the rows of the image


class Layer(IntEnum):
    """First index of each layer of the accumulators."""

    STEPS = 0  # the last element is the change at the horizon
    PAINT = 1
    GROUND = 2  # visible parts of ground and walls, three layers each, see `cover`
    RIGHT_WALL = 5
    LEFT_WALL = 8


LAYERS = Layer.LEFT_WALL + 3


@kernel
def _step(layer: np.ndarray, row: float, change: float) -> None:
    """Add `change` to everything below `row`; exact for the pixel row that it cuts."""
    r = int(row)
    below = change * (row - r)
    layer[r] += change - below
    layer[r + 1] += below


@kernel
def _ramp(layer: np.ndarray, left: float, right: float, change: float) -> None:
    """Add `change` to everything below an edge from row `left` to `right`; exact for the rows it cuts."""
    low, high = min(left, right), max(left, right)
    first, last = int(low), int(high)
    if first == last or high - low < MIN_RISE:
        _step(layer, 0.5 * (low + high), change)
        return
    part = 0.5 * change / (high - low)
    share = total = 0.0
    for row in range(first, last):
        reach = part * (row + 1.0 - low) * (row + 1.0 - low)
        layer[row] += reach - total - share
        share, total = reach - total, reach
    rest = part * (high - low) * (high - low) - total + change * (last + 1.0 - high)
    layer[last] += rest - share
    layer[last + 1] += change - rest


@kernel
def share_below(row: float, edge: Ends) -> float:
    """Return the share of a row that lies below an edge."""
    low, high = min(edge.left, edge.right), max(edge.left, edge.right)
    spread = high - low
    if spread < MIN_RISE:
        return min(1.0, max(0.0, row + 1.0 - low))
    above, below = min(max(row - low, 0.0), spread), min(max(row + 1.0 - low, 0.0), spread)
    return 0.5 * (below - above) * (below + above) / spread + min(1.0, max(0.0, row + 1.0 - high))


@kernel
def _paint_below(frame: Record, steps: np.ndarray, edge: Ends, luminance: float, weight: float) -> None:
    """Paint everything below an edge with one luminance over the background."""
    left, right = edge
    horizon = frame.horizon
    over_sky, over_floor = weight * (luminance - frame.sky), weight * (luminance - frame.floor)
    if left >= horizon and right >= horizon:
        _ramp(steps, left, right, over_floor)
    elif left <= horizon and right <= horizon:
        _ramp(steps, left, right, over_sky)
        steps[-1] += over_floor - over_sky
    else:
        low, high = min(left, right), max(left, right)
        part = (horizon - low) / (high - low)
        _ramp(steps, low, horizon, part * over_sky)
        _ramp(steps, horizon, high, (1.0 - part) * over_floor)
        steps[-1] += part * (over_floor - over_sky)


@kernel
def fill(
    frame: Record, accumulators: np.ndarray, top: Ends, bottom: Ends, luminance: float, weight: float
) -> None:
    """Paint the area between two edges, which must lie in the image, with one luminance."""
    steps = accumulators[Layer.STEPS]
    _paint_below(frame, steps, top, luminance, weight)
    _paint_below(frame, steps, bottom, luminance, -weight)


@kernel
def resolve(
    frame: Record, accumulators: np.ndarray, image: np.ndarray, column: int, first: int, last: int
) -> None:
    """Finish a painted column; write the block into the image if it is full or this is the last column.

    Columns `first` .. `last` - 1 are painted, each into its place in the accumulators (BLOCK, LAYERS, ...).
    """
    place = (column - first) % BLOCK
    steps = accumulators[place, Layer.STEPS]
    _step(steps, frame.horizon, frame.floor - frame.sky + steps[-1])
    if place == BLOCK - 1 or column == last - 1:
        _sum_block(frame.sky, accumulators, image, column - place, place + 1)


@kernel
def _sum_block(sky: float, painted: np.ndarray, image: np.ndarray, first: int, count: int) -> None:
    """Write columns `first` .. `first` + `count` - 1 of a block and clear the block; it sums all of them."""
    one = two = three = four = sky
    for row in range(image.shape[0]):
        one += painted[0, Layer.STEPS, row]
        two += painted[1, Layer.STEPS, row]
        three += painted[2, Layer.STEPS, row]
        four += painted[3, Layer.STEPS, row]
        painted[0, Layer.STEPS, row], painted[1, Layer.STEPS, row] = one, two
        painted[2, Layer.STEPS, row], painted[3, Layer.STEPS, row] = three, four
    for k in range(count):  # a loop of its own, which compiles to wide instructions, unlike the sums above
        for row in range(image.shape[0]):
            image[row, first + k] = painted[k, Layer.STEPS, row] + painted[k, Layer.PAINT, row]
    painted[:, Layer.STEPS : Layer.GROUND] = 0.0


@kernel
def cover(shown: np.ndarray, top: Ends, bottom: Ends, weight: float, u: float) -> None:
    """Record that a surface is visible between two edges; `envs.raycast.patterns` adds its pattern later.

    Args:
        shown: The surface's three layers: the visible share of each row, and the first moments of
            this part down the row and along the slopes.
        top: Upper edge.
        bottom: Lower edge.
        weight: Width of the area [pixels].
        u: Slope of its middle.
    """
    _ramp(shown[0], top.left, top.right, weight)
    _ramp(shown[0], bottom.left, bottom.right, -weight)
    _ramp(shown[2], top.left, top.right, weight * u)
    _ramp(shown[2], bottom.left, bottom.right, -weight * u)
    high, low = 0.5 * (top.left + top.right), 0.5 * (bottom.left + bottom.right)
    first, last = int(high), int(low)
    above, below = high - first, low - last
    shown[1, first] += 0.5 * weight * above * (1.0 - above)
    shown[1, last] -= 0.5 * weight * below * (1.0 - below)


@kernel
def cover_ground(
    frame: Record, accumulators: np.ndarray, top: Ends, bottom: Ends, weight: float, u: float
) -> None:
    """Apply `cover` to the ground between two edges; none of it is visible above the horizon."""
    top = Ends(max(top.left, frame.horizon), max(top.right, frame.horizon))
    bottom = Ends(max(bottom.left, frame.horizon), max(bottom.right, frame.horizon))
    if is_open(top, bottom):
        cover(accumulators[Layer.GROUND : Layer.RIGHT_WALL], top, bottom, weight, u)


@inlined
def ends(record: Record) -> Ends:
    """Return the value of an ENDS record."""
    return Ends(record.left, record.right)


@inlined
def put(record: Record, value: Ends) -> None:
    """Write the value of an ENDS record."""
    record.left, record.right = value


@inlined
def beyond(edge: Ends, limit: Ends) -> Ends:
    """Return an edge, moved down to a limit where it is above the limit.

    Where the two cross, the area between them is a triangle that ends at the crossing. It is replaced by a
    triangle of the same area that spans the strip.
    """
    one, other = edge.left - limit.left, edge.right - limit.right
    if one >= 0.0 and other >= 0.0:
        return edge
    if one > 0.0:
        return Ends(limit.left + one * one / (one - other), limit.right)
    if other > 0.0:
        return Ends(limit.left, limit.right + other * other / (other - one))
    return limit


@inlined
def is_open(top: Ends, bottom: Ends) -> bool:
    """Whether anything lies between two edges."""
    return top.left < bottom.left or top.right < bottom.right


@inlined
def _cut_ends(left: Record, right: Record, part: float) -> None:
    """Cut an edge, of which `right` is a copy, so that `left` and `right` hold one part each."""
    left.right = right.left = left.left + part * (left.right - left.left)


@kernel
def cut_gap(gaps: np.ndarray, k: int, new: int, part: float) -> None:
    """Cut gap `k` at a fraction of its width; the rest becomes gap `new`."""
    gaps[new] = gaps[k]
    left, right = gaps[k], gaps[new]
    _cut_ends(left.top, right.top, part)
    _cut_ends(left.bottom, right.bottom, part)
    _cut_ends(left.reach, right.reach, part)
