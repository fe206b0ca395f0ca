"""When the silhouettes of bodies cross the borders between columns of pixels, on a straight way.

While a silhouette moves within one column, the light of the column's pixels changes almost
linearly; when it passes into the next, one column stops changing and the other begins. So these
are the moments at which a column has to be looked at.
"""

import math
from typing import NamedTuple

import numpy as np

from envs.compiled import inlined, kernel
from envs.raycast.bodies import MIN_DEPTH, see_bodies, silhouette_of
from envs.raycast.columns import Workspace, aim
from envs.raycast.records import Record
from envs.scene import BOX, POLE

BESIDE = 2.0  # columns beside the image in which silhouettes are followed too
CORRECTIONS = 2  # of the time of a crossing, which linear motion estimates first
MOVING = 0.2  # columns; a silhouette that moves farther is looked at once more, half-way
MIN_MOVE = 1e-9  # columns
LOOKS_PER_COLUMN = 4  # at most, on average over the image; beyond it silhouettes cross unseen
MAX_STRETCHES = 16  # of one column in a part of a way


class Way(NamedTuple):
    """A straight way at constant speed; the camera looks along +y.

    Attributes:
        start_x, start_y: Where it begins [m].
        end_x, end_y: Where it ends [m].
        height: Of the camera above the ground [m].
        start_us: When it begins [us].
        moving_us: How long it takes, >= 1 [us].
    """

    start_x: float
    start_y: float
    end_x: float
    end_y: float
    height: float
    start_us: int
    moving_us: int


class Stretch(NamedTuple):
    """A part of a way, in which outlines move little.

    Attributes:
        number: Which one it is, from 1 on.
        begin_us, end_us: When it begins and ends [us].
        before, after: (N, 4), `find_silhouettes` at its begin and at its end.
    """

    number: int
    begin_us: int
    end_us: int
    before: np.ndarray
    after: np.ndarray


class Shifts(NamedTuple):
    """How far the outline of a body may move between two looks at its columns, by its edges [pixels].

    Attributes:
        upright: Of a pole, or a box on the ground.
        level: Of a box above the ground.
        bent: Of a cone or an ellipsoid.
    """

    upright: float
    level: float
    bent: float


class Looks(NamedTuple):
    """At which times which columns are looked at.

    Attributes:
        t_us: Times, int64 [us].
        first: First column of each look, int64.
        last: The column after its last one, int64.
        moving: Of each column of the image, whether a silhouette moves fast in it, bool.
        every: After how many stretches each column of the image is looked at in any case, int64.
    """

    t_us: np.ndarray
    first: np.ndarray
    last: np.ndarray
    moving: np.ndarray
    every: np.ndarray


def make_looks(width: int) -> Looks:
    """Room for the looks at images of `width` columns."""
    size = LOOKS_PER_COLUMN * width
    times, first, last = np.empty((3, size + width), np.int64)
    return Looks(times, first, last, np.empty(width, np.bool_), np.empty(width, np.int64))


@kernel
def aim_along(frame: Record, way: Way, t_us: float) -> None:
    """Aim from where the camera is on its way at a time."""
    part = (t_us - way.start_us) / way.moving_us
    x = way.start_x + (way.end_x - way.start_x) * part
    y = way.start_y + (way.end_y - way.start_y) * part
    aim(frame, x, y, way.height, 0.0, t_us * 1e-6)


@kernel
def find_silhouettes(
    bodies: np.ndarray, width: int, cull: float, room: Workspace, places: np.ndarray
) -> None:
    """Where the silhouettes of the bodies in view stand, seen as `room.frames[0]` says.

    Args:
        bodies: (N,) BODY.
        width: Columns of the image.
        cull: Bodies farther than this are not seen [m].
        room: A `Workspace`.
        places: (N, 4) float64, becomes the column of the left and the right silhouette of each
            body, and about the rows of its top and its foot [pixels]; nan if it is not in view.
    """
    frame, half = room.frames[0], 0.5 * width
    high = 2.0 * frame.horizon
    limit = (half + BESIDE) / frame.focal
    places[:] = math.nan
    for k in range(see_bodies(bodies, frame, -limit, limit, cull, room.seen)):
        body = room.seen[k]
        places[body.number, 0] = _near(half + frame.focal * body.low, width)
        places[body.number, 1] = _near(half + frame.focal * body.high, width)
        per_m = frame.focal / max(MIN_DEPTH, body.forward - body.rx)
        places[body.number, 2] = _near(frame.horizon + per_m * (frame.eye_z - body.top), high)
        places[body.number, 3] = _near(frame.horizon + per_m * (frame.eye_z - body.bottom), high)


@inlined
def _near(place: float, width: float) -> float:
    """A place, moved next to the image if it is far outside: beside a body it is infinite."""
    return min(max(place, -BESIDE), width + BESIDE)


@kernel
def divide_time(
    bodies: np.ndarray, before: np.ndarray, after: np.ndarray, shifts: Shifts, limit: int, looks: Looks
) -> int:
    """Cut a time into stretches, so many that outlines move little in each; say which columns need them all.

    Args:
        bodies: (N,) BODY.
        before: (N, 4), `find_silhouettes` at the begin of the time.
        after: The same at its end.
        shifts: How far outlines may move in a stretch.
        limit: How many stretches there may be, if that is less than `MAX_STRETCHES`.
        looks: Their `every` is filled.

    Returns:
        The number of stretches, a power of two.
    """
    needed, most = looks.every, 1
    needed[:] = 1
    for i in range(len(bodies)):
        moved, stretches = 0.0, 1
        for edge in range(4):
            moved = max(moved, abs(after[i, edge] - before[i, edge]))  # nan is not greater
        shift = _shift_of(bodies[i], shifts)
        while moved > shift * stretches and 2 * stretches <= min(limit, MAX_STRETCHES):
            stretches *= 2
        if stretches > 1:
            first = max(0, int(min(before[i, 0], after[i, 0])))
            for column in range(first, min(len(needed), int(max(before[i, 1], after[i, 1])) + 1)):
                needed[column] = max(needed[column], stretches)
                most = max(most, stretches)
    for column in range(len(needed)):
        looks.every[column] = most // needed[column]
    return most


@inlined
def _shift_of(body: Record, shifts: Shifts) -> float:
    if body.kind == POLE or (body.kind == BOX and body.bottom <= MIN_DEPTH):
        return shifts.upright
    return shifts.level if body.kind == BOX else shifts.bent


@kernel
def find_looks(bodies: np.ndarray, way: Way, stretch: Stretch, room: Workspace, looks: Looks) -> int:
    """The looks that a stretch of a way takes, sorted by time; those at its end by column.

    Args:
        bodies: (N,) BODY.
        way: The whole way.
        stretch: The part of it.
        room: A `Workspace`; its frame is changed.
        looks: Filled with the looks; those beyond its room are left out.

    Returns:
        How many there are.
    """
    before, after, width = stretch.before, stretch.after, len(looks.moving)
    size, half_way_us = 0, (stretch.begin_us + stretch.end_us) // 2
    if half_way_us > stretch.begin_us:
        size = _look_at_moving(stretch, looks, half_way_us)
    for i in range(len(bodies)):
        for side in range(2):
            low, high = min(before[i, side], after[i, side]), max(before[i, side], after[i, side])
            if not (high >= 0.0 and low <= width and high - low > MIN_MOVE):  # also where one is nan
                continue
            for border in range(max(0, math.ceil(low)), min(width, math.floor(high)) + 1):
                t_us = _crossing(bodies[i], side, border, width, way, stretch, room)
                if stretch.begin_us < t_us < stretch.end_us and size < LOOKS_PER_COLUMN * width:
                    size = _add_look(looks, size, t_us, max(0, border - 1), min(width, border + 1))
    return _look_at_end(stretch, looks, size)


@inlined
def _look_at_end(stretch: Stretch, looks: Looks, size: int) -> int:
    """Append the looks at the columns that are due at the end of a stretch; the new number."""
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
    """Begin with looks at the columns in which a silhouette moves far; how many there are."""
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


@kernel
def _crossing(
    body: Record, side: int, border: int, width: int, way: Way, stretch: Stretch, room: Workspace
) -> int:
    """When a silhouette is at a border between columns [us]; its motion is linear at first sight."""
    frame, start = room.frames[0], stretch.before[body.number, side]
    room.seen[0] = body
    per_us = (stretch.after[body.number, side] - start) / (stretch.end_us - stretch.begin_us)
    t_us = stretch.begin_us + (border - start) / per_us
    for _ in range(CORRECTIONS):
        aim_along(frame, way, t_us)
        low, high = silhouette_of(room.seen[0], frame)
        beyond = 0.5 * width + frame.focal * (high if side else low) - border
        t_us = min(max(t_us - beyond / per_us, float(stretch.begin_us)), float(stretch.end_us))
    return round(t_us)


@inlined
def _add_look(looks: Looks, size: int, t_us: int, first: int, last: int) -> int:
    """Add a look, sorted by time; the new number."""
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
