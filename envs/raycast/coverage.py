"""Kernels that paint one column: flat spans between straight edges, by exact coverage.

All that is known while an image is painted is one array, the sheet, of which each row holds
one thing: short lists of arguments are what kernels are fast by. SPANS holds how much
brighter each row of pixels is than the one above, so that a flat span of any length costs few
additions; PAINT holds luminance added to a single row. The background, sky above the horizon
and plain ground below, is added once per column by `develop`, so a span is painted as its
difference from the background and what nothing hides costs nothing.

An edge is straight from the left to the right end of the strip being painted, and given by
its rows there. Where edges part a strip, the shares of each row add up to one exactly.
"""

import numba
import numpy as np

# Kernels allocate nothing, so that arrays need no counting of references: that, by atomic
# instructions at each call, took five times as long as the work.
kernel = numba.njit(cache=True, error_model="numpy", _nrt=False)
inlined = numba.njit(cache=True, error_model="numpy", _nrt=False, forceinline=True)
# What holds for a whole frame, in one array: row of the horizon, focal length [pixels], eye
# [m], heading, time [s], strips per pixel; of the scene: luminance of sky and ground, height
# of the tallest [m], walls (half width, top, ends [m], albedo), Lambert weights, the sun in
# the world and in the camera's frame, and the weight of albedo on level and upright faces.
HORIZON, FOCAL, EYE_X, EYE_Y, EYE_Z, COS, SIN, TIME, SAMPLES = range(9)
SKY, FLOOR, TALLEST, WALL_HALF, WALL_TOP, WALL_NEAR, WALL_FAR, WALL_ALBEDO = range(9, 17)
AMBIENT, DIFFUSE, SUN_X, SUN_Y, SUN_Z, SUN_RIGHT, SUN_FORWARD = range(17, 24)
LIT_UP, LIT_DOWN, LIT_EAST, LIT_WEST, LIT_NORTH, LIT_SOUTH = range(24, 30)
# The textures follow: where in the array each begins, and what it consists of.
GROUND, WALL, BODY, VIEW = 30, 36, 42, 48
PATTERN, FREQUENCY, CONTRAST, SPEED_S, SPEED_Q, STACK = range(6)
FINEST = 1e-9  # [rows] an edge that slopes less is level
# Rows of the sheet: the column that is painted; what shows of ground and walls in it, three
# rows each, see `cover`; the gaps, one edge's end each; what is known of the strip; columns
# that wait for being developed together, because sums that do not wait for each other are fast.
SPANS, PAINT, GROUND_SHOWN, RIGHT_SHOWN, LEFT_SHOWN, GAPS, HIT, WAITING, SHEET = 0, 1, 2, 5, 8, 11, 17, 18, 26
BLOCK = 4
PADDING = 3  # numbers beyond the rows of the image; the last of SPANS is what changes at the horizon


@kernel
def _step(sheet: np.ndarray, layer: int, row: float, change: float) -> None:
    """From `row` downwards all is greater by `change`; exact for a row cut by it."""
    r = int(row)
    below = change * (row - r)
    sheet[layer, r] += change - below
    sheet[layer, r + 1] += below


@kernel
def _ramp(sheet: np.ndarray, layer: int, left: float, right: float, change: float) -> None:
    """Below an edge from row `left` to row `right` all is greater by `change`; exact for the rows it cuts."""
    low, high = min(left, right), max(left, right)
    first, last = int(low), int(high)
    if first == last or high - low < FINEST:
        _step(sheet, layer, 0.5 * (low + high), change)
        return
    part = 0.5 * change / (high - low)
    share = total = 0.0
    for row in range(first, last):
        reach = part * (row + 1.0 - low) * (row + 1.0 - low)
        sheet[layer, row] += reach - total - share
        share, total = reach - total, reach
    rest = part * (high - low) * (high - low) - total + change * (last + 1.0 - high)
    sheet[layer, last] += rest - share
    sheet[layer, last + 1] += change - rest


@kernel
def share_below(row: float, left: float, right: float) -> float:
    """Share of a row that lies below an edge from row `left` to row `right`."""
    low, high = min(left, right), max(left, right)
    spread = high - low
    if spread < FINEST:
        return min(1.0, max(0.0, row + 1.0 - low))
    above, below = min(max(row - low, 0.0), spread), min(max(row + 1.0 - low, 0.0), spread)
    return 0.5 * (below - above) * (below + above) / spread + min(1.0, max(0.0, row + 1.0 - high))


@kernel
def _edge(view: np.ndarray, sheet: np.ndarray, edge: tuple, luminance: float, weight: float) -> None:
    """Paint all below an edge with one luminance over the background."""
    left, right = edge
    horizon = view[HORIZON]
    over_sky, over_floor = weight * (luminance - view[SKY]), weight * (luminance - view[FLOOR])
    if left >= horizon and right >= horizon:
        _ramp(sheet, SPANS, left, right, over_floor)
    elif left <= horizon and right <= horizon:
        _ramp(sheet, SPANS, left, right, over_sky)
        sheet[SPANS, -1] += over_floor - over_sky
    else:
        low, high = min(left, right), max(left, right)
        part = (horizon - low) / (high - low)
        _ramp(sheet, SPANS, low, horizon, part * over_sky)
        _ramp(sheet, SPANS, horizon, high, (1.0 - part) * over_floor)
        sheet[SPANS, -1] += part * (over_floor - over_sky)


@kernel
def fill(view, sheet: np.ndarray, top: tuple, bottom: tuple, luminance: float, weight: float) -> None:
    """Paint what lies between two edges, which must lie in the image, with one luminance."""
    _edge(view, sheet, top, luminance, weight)
    _edge(view, sheet, bottom, luminance, -weight)


@kernel
def develop(view: np.ndarray, sheet: np.ndarray, image: np.ndarray, column: int) -> None:
    """Take the painted column off the sheet; once there are enough, write them into the image."""
    rows, place = image.shape[0] + 2, column % BLOCK
    _step(sheet, SPANS, view[HORIZON], view[FLOOR] - view[SKY] + sheet[SPANS, -1])
    for row in range(rows):
        sheet[WAITING + place, row] = sheet[SPANS, row]
        sheet[WAITING + BLOCK + place, row] = sheet[PAINT, row]
        sheet[SPANS, row] = sheet[PAINT, row] = 0.0
    sheet[SPANS, -1] = 0.0
    if place == BLOCK - 1:
        _sum_block(view[SKY], sheet[WAITING:], image, column - place)
    elif column == image.shape[1] - 1:
        for first in range(column - place, column + 1):
            _sum_column(view[SKY], sheet[WAITING + first % BLOCK :: BLOCK], image, first)


@kernel
def _sum_block(sky: float, waiting: np.ndarray, image: np.ndarray, first: int) -> None:
    """Write columns `first` .. `first` + 3."""
    one = two = three = four = sky
    for row in range(image.shape[0]):
        one += waiting[0, row]
        two += waiting[1, row]
        three += waiting[2, row]
        four += waiting[3, row]
        image[row, first] = one + waiting[4, row]
        image[row, first + 1] = two + waiting[5, row]
        image[row, first + 2] = three + waiting[6, row]
        image[row, first + 3] = four + waiting[7, row]


@kernel
def _sum_column(sky: float, waiting: np.ndarray, image: np.ndarray, column: int) -> None:
    """Write one column."""
    running = sky
    for row in range(image.shape[0]):
        running += waiting[0, row]
        image[row, column] = running + waiting[1, row]


@kernel
def cover(sheet: np.ndarray, layer: int, top: tuple, bottom: tuple, weight: float, u: float) -> None:
    """Note that what lies between two edges shows the surface of `layer`; its pattern follows once per cell.

    Two more layers say where the part that shows of a row has its middle, the first moments:
    in the row, and along the slopes, of which `u` is that of the middle here.
    """
    _ramp(sheet, layer, top[0], top[1], weight)
    _ramp(sheet, layer, bottom[0], bottom[1], -weight)
    _ramp(sheet, layer + 2, top[0], top[1], weight * u)
    _ramp(sheet, layer + 2, bottom[0], bottom[1], -weight * u)
    high, low = 0.5 * (top[0] + top[1]), 0.5 * (bottom[0] + bottom[1])
    first, last = int(high), int(low)
    above, below = high - first, low - last
    sheet[layer + 1, first] += 0.5 * weight * above * (1.0 - above)
    sheet[layer + 1, last] -= 0.5 * weight * below * (1.0 - below)


@kernel
def cover_ground(view, sheet: np.ndarray, top: tuple, bottom: tuple, weight: float, u: float) -> None:
    """As `cover`, for what shows of the ground between two edges."""
    horizon = view[HORIZON]
    top = (max(top[0], horizon), max(top[1], horizon))
    bottom = (max(bottom[0], horizon), max(bottom[1], horizon))
    if top[0] < bottom[0] or top[1] < bottom[1]:
        cover(sheet, GROUND_SHOWN, top, bottom, weight, u)


@inlined
def beyond(edge: tuple, limit: tuple) -> tuple[float, float]:
    """An edge, moved below a limit where it is above.

    Where they cross, what lies between them is a triangle that ends there: it is drawn as one
    of the same area that reaches through the strip.
    """
    one, other = edge[0] - limit[0], edge[1] - limit[1]
    if one >= 0.0 and other >= 0.0:
        return edge
    if one > 0.0:
        return limit[0] + one * one / (one - other), limit[1]
    if other > 0.0:
        return limit[0], limit[1] + other * other / (other - one)
    return limit


@inlined
def is_open(top: tuple, bottom: tuple) -> bool:
    """Whether anything lies between two edges."""
    return top[0] < bottom[0] or top[1] < bottom[1]


@kernel
def cut_gap(gaps: np.ndarray, k: int, new: int, part: float) -> None:
    """Cut gap `k` after a part of its width; the rest becomes gap `new`."""
    for row in range(6):
        gaps[row, new] = gaps[row, k]
    for row in (0, 2, 4):
        middle = gaps[row, k] + part * (gaps[row + 1, k] - gaps[row, k])
        gaps[row + 1, k] = gaps[row, new] = middle


@inlined
def left_of_row(edges: tuple, start: float, end: float) -> tuple[float, float]:
    """From where to where in the strip, of 0 .. 1, two edges leave something of rows start .. end."""
    (top, bottom), left, right = edges, 0.0, 1.0
    if top[0] != top[1]:  # below the upper edge
        crossing = (end - top[0]) / (top[1] - top[0])
        if top[0] < top[1]:
            right = min(right, max(0.0, crossing))
        else:
            left = max(left, min(1.0, crossing))
    if bottom[0] != bottom[1]:  # above the lower edge
        crossing = (start - bottom[0]) / (bottom[1] - bottom[0])
        if bottom[0] > bottom[1]:
            right = min(right, max(0.0, crossing))
        else:
            left = max(left, min(1.0, crossing))
    return left, max(left, right)
