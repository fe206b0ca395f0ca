"""Cut a way into stretches of time that are short enough for a column's contents to move little in each.

Silhouettes get their own looks (`envs.raycast.silhouettes`). This file handles motion across rows: of tops
and feet of bodies and walls, of slanted outlines, and of the patterns on them.
"""

import math
from typing import NamedTuple

import numpy as np

from envs.compiled import inlined, kernel
from envs.raycast.bodies import MIN_DEPTH, depths, root, section, silhouette_of
from envs.raycast.columns import Workspace
from envs.raycast.records import Record
from envs.raycast.silhouettes import BESIDE, Looks, Way, near
from envs.scene import BOX, POLE
from envs.scene.textures import NOISE

MAX_STRETCHES = 16  # per column in a part of a way
SIGHTS = (0.125, 0.5, 0.875)  # fractions of a body's visible width at which its rows are measured
ROWS = 5  # numbers at each sight: rows of top, side, underside and end, and the logarithm of the depth
PATTERN = 4.0  # allowed motion of a pattern on a body, over the allowed motion of a level outline


class Shifts(NamedTuple):
    """Largest motion of a body's outline between two looks at its columns, by kind of edge [pixels].

    Attributes:
        upright: For poles and for boxes on the ground.
        level: For boxes above the ground, for all tops and feet, and for walls.
        bent: For cones and ellipsoids.
    """

    upright: float
    level: float
    bent: float


class Outlines(NamedTuple):
    """Image positions of the followed bodies at two places of a way.

    Attributes:
        followed: (N,) int64, the numbers of the bodies. Of this and the other arrays the first K are in use.
        before, after: (N, 2), silhouettes of the bodies, from `silhouettes.find_silhouettes`.
        rows_before, rows_after: (N, R), rows of the bodies, from `find_rows`.
    """

    followed: np.ndarray
    before: np.ndarray
    after: np.ndarray
    rows_before: np.ndarray
    rows_after: np.ndarray


def make_outlines(num_bodies: int) -> Outlines:
    """Allocate room for the outlines of `num_bodies` bodies."""
    places, rows = np.empty((2, num_bodies, 2)), np.empty((2, num_bodies, len(SIGHTS) * ROWS))
    return Outlines(np.empty(num_bodies, np.int64), *places, *rows)


@kernel
def find_rows(
    bodies: np.ndarray,
    followed: np.ndarray,
    width: int,
    way: Way,
    shifts: Shifts,
    room: Workspace,
    rows: np.ndarray,
) -> None:
    """Find the image rows of near bodies, as seen by `room.frames[0]`.

    Args:
        bodies: (N,) BODY.
        followed: (K,) int64, numbers of the bodies to look for.
        width: Columns of the image.
        way: The way to cut.
        shifts: Largest motion of outlines in a stretch.
        room: A `Workspace`.
        rows: (N, 3 * ROWS) float64, filled with each body's rows [pixels] and the logarithms of its depths
            [m]; nan if it is out of view, or so far that none of its rows moves by more than `shifts`.
    """
    frame = room.frames[0]
    limit = (0.5 * width + BESIDE) / frame.focal
    moved_m = math.hypot(way.end_x - way.start_x, way.end_y - way.start_y)
    moved_m += math.hypot(frame.body_texture.speed_s, frame.body_texture.speed_q) * way.moving_us * 1e-6
    for k in range(len(followed)):
        rows[k] = math.nan
        body = bodies[followed[k]]
        own_m = moved_m
        if body.moves:
            own_m += (math.hypot(body.vx, body.vy) + abs(body.vz)) * way.moving_us * 1e-6
        still_m = (frame.focal + frame.horizon + BESIDE) * own_m / min(shifts.level, _shift_of(body, shifts))
        ahead_m = body.y - max(body.rx, body.ry) - frame.eye_y
        if body.moves:
            ahead_m += body.vy * (frame.time - body.since)
        if ahead_m > still_m + own_m:
            continue
        room.seen[0] = bodies[followed[k]]
        body = room.seen[0]
        low, high = silhouette_of(body, frame)
        low, high = max(low, -limit), min(high, limit)
        if low > high:
            continue
        for sight in range(len(SIGHTS)):
            if body.kind != POLE or SIGHTS[sight] == 0.5:  # a pole is upright and level
                u = low + SIGHTS[sight] * (high - low)
                _note_rows(body, frame, u, rows[k, sight * ROWS : (sight + 1) * ROWS])


@inlined
def _note_rows(body: Record, frame: Record, u: float, rows: np.ndarray) -> None:
    high = 2.0 * frame.horizon
    seen = section(body, frame, u, 0.0 if body.kind == BOX else root(body, u))
    rows[0], rows[1] = near(seen.cap, high), near(seen.side, high)
    rows[2], rows[3] = near(seen.under, high), near(seen.end, high)
    entry, _ = depths(body, frame, u)
    rows[4] = math.log(max(MIN_DEPTH, entry))


@kernel
def divide_time(
    bodies: np.ndarray,
    count: int,
    outlines: Outlines,
    way: Way,
    frame: Record,
    shifts: Shifts,
    limit: int,
    looks: Looks,
) -> int:
    """Choose the number of stretches, so that outlines move little in each, and the looks of each column.

    Args:
        bodies: (N,) BODY.
        count: Number of followed bodies.
        outlines: Outlines of the followed bodies at the start and at the end of the way.
        way: The way.
        frame: FRAME of a camera on the way.
        shifts: Largest motion of outlines in a stretch.
        limit: Largest number of stretches, if less than `MAX_STRETCHES`.
        looks: `Looks` whose `every` is filled: the stretches between two looks at each column.

    Returns:
        The number of stretches, a power of two.
    """
    needed, limit = looks.every, min(limit, MAX_STRETCHES)
    needed[:] = 1
    for k in range(count):
        body = bodies[outlines.followed[k]]
        stretches = _stretches(_moved(body, k, outlines, way, frame, shifts), limit)
        if stretches > 1:
            first = max(0, int(min(outlines.before[k, 0], outlines.after[k, 0])))
            last = min(len(needed), int(max(outlines.before[k, 1], outlines.after[k, 1])) + 1)
            for column in range(first, last):
                needed[column] = max(needed[column], stretches)
    if frame.wall_top > 0.0 and (way.start_x != way.end_x or _is_sharp(frame.wall_texture)):
        for column in range(len(needed)):
            u = (column + 0.5 - 0.5 * len(needed)) / frame.focal
            needed[column] = max(needed[column], _stretches(_wall_moved(u, way, frame) / shifts.level, limit))
    most = 1
    for column in range(len(needed)):
        most = max(most, needed[column])
    for column in range(len(needed)):
        needed[column] = most // needed[column]
    return most


@inlined
def _stretches(moved: float, limit: int) -> int:
    """Return the smallest power of two >= `moved`, the motion over the allowed motion; at most `limit`."""
    stretches = 1
    while moved > stretches and 2 * stretches <= limit:
        stretches *= 2
    return stretches


@inlined
def _moved(body: Record, k: int, outlines: Outlines, way: Way, frame: Record, shifts: Shifts) -> float:
    """Return the motion of a body's outline over the motion allowed in a stretch."""
    shift = _shift_of(body, shifts)
    level, moved = min(shift, shifts.level), 0.0
    for side in range(2):
        moved = max(moved, abs(outlines.after[k, side] - outlines.before[k, side]) / shift)
    for sight in range(len(SIGHTS)):
        before = outlines.rows_before[k, sight * ROWS : (sight + 1) * ROWS]
        after = outlines.rows_after[k, sight * ROWS : (sight + 1) * ROWS]
        for row in range(ROWS - 1):
            moved = max(moved, abs(after[row] - before[row]) / level)  # nan is not greater
        if _is_sharp(frame.body_texture):
            moved = max(moved, _pattern_moved(before, after, way, frame) / (PATTERN * level))
    return moved


@inlined
def _pattern_moved(before: np.ndarray, after: np.ndarray, way: Way, frame: Record) -> float:
    """Return the motion of the pattern on a body within the rows that the body covers [pixels]."""
    reach = max(abs(before[0] - frame.horizon), abs(before[ROWS - 2] - frame.horizon))
    texture = frame.body_texture
    alone_m = math.hypot(texture.speed_s, texture.speed_q) * way.moving_us * 1e-6
    grows = abs(after[ROWS - 1] - before[ROWS - 1])
    return reach * grows + frame.focal * alone_m * math.exp(-before[ROWS - 1])


@inlined
def _shift_of(body: Record, shifts: Shifts) -> float:
    if body.kind == POLE or (body.kind == BOX and body.bottom <= MIN_DEPTH):
        return shifts.upright
    return shifts.level if body.kind == BOX else shifts.bent


@inlined
def _wall_moved(u: float, way: Way, frame: Record) -> float:
    """Return the largest motion of the wall's upper and lower line and pattern along slope `u` [pixels]."""
    wall = math.copysign(frame.wall_half, u)
    before, after = (wall - way.start_x) * u, (wall - way.end_x) * u
    if before <= 0.0 or after <= 0.0:  # straight ahead, or from beyond a wall
        return 0.0
    y = way.start_y + before / (u * u)
    if y < frame.wall_near or y > frame.wall_far:
        return 0.0
    one, other = frame.focal * u * u / before, frame.focal * u * u / after  # rows for each metre of height
    high, moved = 2.0 * frame.horizon, 0.0
    for drop in (way.height, way.height - frame.wall_top):
        row, row_after = near(frame.horizon + drop * one, high), near(frame.horizon + drop * other, high)
        moved = max(moved, abs(row_after - row))
    if _is_sharp(frame.wall_texture):
        texture, away_m = frame.wall_texture, min(before, after) / abs(u)
        alone_m = math.hypot(texture.speed_s, texture.speed_q) * way.moving_us * 1e-6
        along_m = abs(u) * (abs(way.end_y - way.start_y) + alone_m) + abs(way.end_x - way.start_x)
        reach = max(frame.focal * abs(u), min(frame.horizon, abs(frame.wall_top - way.height) * one))
        moved = max(moved, reach * along_m / away_m)
    return moved


@inlined
def _is_sharp(texture: Record) -> bool:
    """Whether a texture shows edges."""
    return texture.contrast > 0.0 and texture.pattern != NOISE
