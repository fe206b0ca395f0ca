"""Times at which silhouettes cross the borders between columns of pixels on a straight way.

While a silhouette moves within one column, the light of the column's pixels changes almost
linearly. When it passes into the next column, the first stops changing and the next one starts.
So these are the moments at which a column has to be rendered.
"""

import math
from typing import NamedTuple

import numpy as np

from envs.compiled import inlined, kernel
from envs.raycast.bodies import silhouette_of
from envs.raycast.columns import Workspace, aim
from envs.raycast.records import Record
from envs.scene import BOX

BESIDE = 2.0  # [columns] margin beside the image in which silhouettes are followed too
MOVING = 0.2  # [columns] a silhouette that moves farther gets one more look, half-way
MIN_MOVE = 1e-9  # [columns] smallest motion of a silhouette that counts
NEARBY = 1e-6  # [m] more than any rounding error of distances
LOOKS_PER_COLUMN = 4  # most looks on average over the image; crossings beyond it get no look


class Way(NamedTuple):
    """A straight way at constant speed; the camera looks along +y.

    Attributes:
        start_x, start_y: Start of the way [m].
        end_x, end_y: End of the way [m].
        height: Height of the camera above the ground [m].
        start_us: Start time [us].
        moving_us: Duration, >= 1 [us].
    """

    start_x: float
    start_y: float
    end_x: float
    end_y: float
    height: float
    start_us: int
    moving_us: int


class Stretch(NamedTuple):
    """A part of a way in which outlines move little.

    Attributes:
        number: Number of the stretch in its way, from 1.
        begin_us, end_us: Start and end time [us].
        followed: (K,) int64, numbers of the bodies in view, from `follow_bodies`.
        before, after: (K, 2), their silhouettes at start and end, from `find_silhouettes`.
    """

    number: int
    begin_us: int
    end_us: int
    followed: np.ndarray
    before: np.ndarray
    after: np.ndarray


class Looks(NamedTuple):
    """Times and columns of the looks of a stretch.

    Attributes:
        t_us: Time of each look, int64 [us].
        first: First column of each look, int64.
        last: The column after the last column of each look, int64.
        moving: Whether a silhouette moves fast in each column of the image, bool.
        every: Number of stretches after which each column of the image is rendered in any case, int64.
    """

    t_us: np.ndarray
    first: np.ndarray
    last: np.ndarray
    moving: np.ndarray
    every: np.ndarray


def make_looks(width: int) -> Looks:
    """Allocate room for the looks at images of `width` columns."""
    size = LOOKS_PER_COLUMN * width
    times, first, last = np.empty((3, size + width), np.int64)
    return Looks(times, first, last, np.empty(width, np.bool_), np.empty(width, np.int64))


@kernel
def aim_along(frame: Record, way: Way, t_us: float) -> None:
    """Aim the frame from the camera's place on its way at a time."""
    part = (t_us - way.start_us) / way.moving_us
    x = way.start_x + (way.end_x - way.start_x) * part
    y = way.start_y + (way.end_y - way.start_y) * part
    aim(frame, x, y, way.height, 0.0, t_us * 1e-6)


@kernel
def follow_bodies(
    bodies: np.ndarray, way: Way, focal: float, width: int, cull: float, numbers: np.ndarray
) -> int:
    """Find the bodies that may be in view at the start or the end of a way.

    Args:
        bodies: (N,) BODY.
        way: The way; bodies in view only between its ends are not found.
        focal: Focal length of the camera [pixels].
        width: Columns of the image.
        cull: Bodies farther than this are left out [m].
        numbers: (N,) int64, whose first elements become the numbers of these bodies, in ascending order.

    Returns:
        The number of bodies found.
    """
    limit, count = (0.5 * width + BESIDE) / focal, 0
    slack = math.sqrt(1.0 + limit * limit)
    for i in range(len(bodies)):
        body = bodies[i]
        reach = body.rx if body.kind != BOX else math.hypot(body.rx, body.ry)
        for end in range(2):
            x, y = (way.end_x, way.end_y) if end else (way.start_x, way.start_y)
            if body.moves:  # move the camera instead of the body
                late = (way.start_us + end * way.moving_us) * 1e-6 - body.since
                x, y = x - body.vx * late, y - body.vy * late
            beside, forward = abs(body.x - x), body.y - y
            ahead = forward + reach > 0.0 and beside <= limit * forward + slack * reach
            if ahead and beside * beside + forward * forward <= (cull + reach) ** 2:
                numbers[count] = i
                count += 1
                break
    return count


@kernel
def find_near(bodies: np.ndarray, way: Way, focal: float, width: int, cull: float, near: np.ndarray) -> int:
    """Collect the bodies that can be in view anywhere on a way; each look needs to consider only these.

    Args:
        bodies: (N,) BODY.
        way: The way.
        focal: Focal length of the camera [pixels].
        width: Columns of the image.
        cull: Bodies farther than this are left out [m].
        near: (N,) BODY, whose first elements become these bodies, in the same order.

    Returns:
        The number of bodies found.
    """
    limit, count = 0.5 * width / focal, 0
    slack = math.sqrt(1.0 + limit * limit)
    moved = math.hypot(way.end_x - way.start_x, way.end_y - way.start_y)
    for i in range(len(bodies)):
        body = bodies[i]
        beside, forward = body.x - way.start_x, body.y - way.start_y
        reach = (body.rx if body.kind != BOX else math.hypot(body.rx, body.ry)) + moved + NEARBY
        if body.moves:
            late = way.start_us * 1e-6 - body.since
            beside, forward = beside + body.vx * late, forward + body.vy * late
            reach += math.hypot(body.vx, body.vy) * way.moving_us * 1e-6
        ahead = forward + reach > 0.0 and abs(beside) <= limit * forward + slack * reach
        if ahead and beside * beside + forward * forward <= (cull + reach) ** 2:
            near[count] = body
            count += 1
    return count


@kernel
def find_silhouettes(
    bodies: np.ndarray, followed: np.ndarray, width: int, room: Workspace, places: np.ndarray
) -> None:
    """Find the silhouettes of bodies as seen by `room.frames[0]`.

    Args:
        bodies: (N,) BODY.
        followed: (K,) int64, numbers of the bodies to look for.
        width: Columns of the image.
        room: A `Workspace`.
        places: (K, 2) float64, filled with the columns of each body's left and right silhouette [pixels].
            Silhouettes out of view or at infinity (the eye is beside the body) are put next to the image.
    """
    frame, half = room.frames[0], 0.5 * width
    for k in range(len(followed)):
        room.seen[0] = bodies[followed[k]]
        low, high = silhouette_of(room.seen[0], frame)
        if low > high:  # behind the eye
            low = high = -math.inf if room.seen[0].right < 0.0 else math.inf
        places[k, 0] = near(half + frame.focal * low, width)
        places[k, 1] = near(half + frame.focal * high, width)


@inlined
def near(place: float, size: float) -> float:
    """Limit a place to an image of `size` pixels and a margin of `BESIDE` around it."""
    return min(max(place, -BESIDE), size + BESIDE)


@kernel
def find_looks(bodies: np.ndarray, focal: float, way: Way, stretch: Stretch, looks: Looks) -> int:
    """Find the looks of a stretch of a way, sorted by time; looks at its end are sorted by column.

    Args:
        bodies: (N,) BODY.
        focal: Focal length of the camera [pixels].
        way: The whole way.
        stretch: The stretch of the way.
        looks: Filled with the looks; looks beyond its room are left out.

    Returns:
        The number of looks.
    """
    before, after, width = stretch.before, stretch.after, len(looks.moving)
    size, half_way_us = 0, (stretch.begin_us + stretch.end_us) // 2
    if half_way_us > stretch.begin_us:
        size = _look_at_moving(stretch, looks, half_way_us)
    for k in range(len(stretch.followed)):
        for side in range(2):
            low, high = min(before[k, side], after[k, side]), max(before[k, side], after[k, side])
            if high < 0.0 or low > width or high - low <= MIN_MOVE:
                continue
            for border in range(max(0, math.ceil(low)), min(width, math.floor(high)) + 1):
                t_us = _crossing(bodies[stretch.followed[k]], side, (border - 0.5 * width) / focal, way)
                inside = stretch.begin_us + 0.5 < t_us < stretch.end_us - 0.5
                if inside and size < LOOKS_PER_COLUMN * width:
                    size = _add_look(looks, size, round(t_us), max(0, border - 1), min(width, border + 1))
    return _look_at_end(stretch, looks, size)


@inlined
def _look_at_end(stretch: Stretch, looks: Looks, size: int) -> int:
    """Append the looks at the columns due at the end of a stretch; return the new number of looks."""
    due, width = False, len(looks.every)
    for column in range(width):
        before, due = due, stretch.number % looks.every[column] == 0
        if due and not before:
            looks.t_us[size], looks.first[size] = stretch.end_us, column
            size += 1
        if due:
            looks.last[size - 1] = column + 1
    return size


@inlined
def _look_at_moving(stretch: Stretch, looks: Looks, t_us: int) -> int:
    """Start with the looks at the columns in which a silhouette moves far; return the number of looks."""
    before, after, moving, width = stretch.before, stretch.after, looks.moving, len(looks.moving)
    moving[:] = False
    for i in range(len(before)):
        for side in range(2):
            low, high = min(before[i, side], after[i, side]), max(before[i, side], after[i, side])
            if high - low > MOVING and high >= 0.0 and low < width:
                moving[int(max(0.0, low)) : int(high) + 1] = True
    size = column = 0
    while column < width:
        if moving[column]:
            first = column
            while column < width and moving[column]:
                column += 1
            looks.t_us[size], looks.first[size], looks.last[size] = t_us, first, column
            size += 1
        column += 1
    return size


@inlined
def _crossing(body: Record, side: int, u: float, way: Way) -> float:
    """Return the time when the left or right silhouette of a body is at slope `u` [us]; not finite if never.

    At that time the ray touches the body: the axis's offset from the ray, linear in time, equals the body's
    reach.
    """
    moved = way.end_x - way.start_x - u * (way.end_y - way.start_y)
    away = body.x - way.start_x - u * (body.y - way.start_y)
    if body.moves:
        across = body.vx - u * body.vy
        moved -= across * way.moving_us * 1e-6
        away += across * (way.start_us * 1e-6 - body.since)
    reach = body.rx + abs(u) * body.ry if body.kind == BOX else body.rx * math.sqrt(1.0 + u * u)
    return way.start_us + (away + reach if side else away - reach) / moved * way.moving_us


@inlined
def _add_look(looks: Looks, size: int, t_us: int, first: int, last: int) -> int:
    """Insert a look in the order of time; return the new number of looks."""
    j = size
    while j > 0 and looks.t_us[j - 1] > t_us:
        looks.t_us[j], looks.first[j], looks.last[j] = (
            looks.t_us[j - 1],
            looks.first[j - 1],
            looks.last[j - 1],
        )
        j -= 1
    looks.t_us[j], looks.first[j], looks.last[j] = t_us, first, last
    return size + 1
