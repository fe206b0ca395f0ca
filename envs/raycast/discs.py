"""Kernels that draw spheres pixel by pixel (`renderer=spheres`), for worlds of hundreds of spheres.

The strips of `envs.raycast.columns` are exact, but each silhouette in a column cuts all bodies there. Here a
sphere covers the share of a cell that a straight edge along its silhouette would cover; the uncovered shares
of spheres one behind the other multiply; and the light is that at the middle of the cell. A cell is a pixel,
or one of samples^2 parts of it. A disc narrower than `NARROW` is drawn as a rectangle of the same area. Walls
and textures are not drawn. Input is assumed valid.
"""

import math

import numpy as np

from envs.compiled import inlined, kernel
from envs.raycast.bodies import MIN_DEPTH, see_bodies
from envs.raycast.records import Record

NARROW = 1.5  # [cells], width or height of a disc
SQUARE = 0.5 * math.sqrt(math.pi)  # sides of a rectangle over the axes of an ellipse of the same area
GAPS = (301, 132, 57, 23, 10, 4, 1)  # for the Shell sort
LEAST = 1e-12  # instead of 0 in a denominator


@kernel
def paint_discs(
    bodies: np.ndarray,
    frame: Record,
    image: np.ndarray,
    columns: tuple[int, int],
    cull: float,
    seen: np.ndarray,
    order: np.ndarray,
    room: np.ndarray,
) -> None:
    """Fill some columns of an image (H, W) with spheres, sky and ground.

    Args:
        bodies: (N,) BODY, spheres.
        frame: FRAME record.
        image: float32 (H, W).
        columns: The first one, and the one after the last.
        cull: Spheres farther than this are not drawn [m].
        seen: (N,) BODY, room.
        order: (N,) int64, room.
        room: float64 of 2 * samples * H elements or more, zero before and after.
    """
    half, fine, height = 0.5 * image.shape[1], frame.samples, image.shape[0]
    first, last = columns
    low, high = (first - half) / frame.focal, (last - half) / frame.focal
    count = see_bodies(bodies, frame, low, high, cull, seen)
    for i in range(count):
        _outline(seen[i], frame)
        order[i] = i
    _sort(seen, order[:count])
    cells = room.reshape(room.size)
    shown, light = cells[: fine * height], cells[fine * height : 2 * fine * height]
    for column in range(first, last):
        for row in range(height):
            image[row, column] = 0.0
        for part in range(fine):
            left = column - half + part / fine
            shown[:] = 1.0
            for k in range(count):
                body = seen[order[k]]
                if frame.focal * body.low < left + 1.0 / fine and frame.focal * body.high > left:
                    _cover(body, frame, left, shown, light)
            _add(frame, shown, light, image[:, column])
    cells[: 2 * fine * height] = 0.0


@kernel
def _sort(seen: np.ndarray, order: np.ndarray) -> None:
    """Sort spheres from near to far (Shell 1959, with gaps after Ciura 2001)."""
    for gap in GAPS:
        for i in range(gap, order.size):
            new, j = order[i], i
            while j >= gap and seen[order[j - gap]].power > seen[new].power:
                order[j] = order[j - gap]
                j -= gap
            order[j] = new


@inlined
def _add(frame: Record, shown: np.ndarray, light: np.ndarray, pixels: np.ndarray) -> None:
    """Add the cells of a column to the pixels, and the shares `shown` of sky and ground behind them."""
    fine = frame.samples
    per_pixel = 1.0 / (fine * fine)
    for row in range(pixels.size):
        total = 0.0
        for cell in range(fine * row, fine * row + fine):
            sky = min(1.0, max(0.0, fine * frame.horizon - cell))
            total += light[cell] + shown[cell] * (sky * frame.sky + (1.0 - sky) * frame.floor)
            light[cell] = 0.0
        pixels[row] += total * per_pixel


@kernel
def _outline(body: Record, frame: Record) -> None:
    """Store the first and last row of a sphere, `cap` and `end`, and its squared tangent length, `power`.

    If two spheres do not overlap, the one with the shorter tangents may hide the other.
    """
    radius, forward, up = body.rx, body.forward, _up(body, frame)
    power = forward * forward + up * up - radius * radius
    body.cap, body.end = -math.inf, math.inf
    if power > 0.0:
        tangent = math.sqrt(power)
        over, under = forward * tangent - up * radius, forward * tangent + up * radius
        if over > 0.0:
            body.cap = frame.horizon - frame.focal * (up * tangent + forward * radius) / over
        if under > 0.0:
            body.end = frame.horizon - frame.focal * (up * tangent - forward * radius) / under
    body.power = power + body.right * body.right


@inlined
def _up(body: Record, frame: Record) -> float:
    """Return the height of a sphere's middle above the eye [m]."""
    return 0.5 * (body.top + body.bottom) - frame.eye_z


@inlined
def _cover(body: Record, frame: Record, left: float, shown: np.ndarray, light: np.ndarray) -> None:
    """Paint a sphere into one column of cells, which begins at `left` [pixels], behind nearer spheres.

    `shown` is the share of each cell that nearer spheres leave uncovered.
    """
    fine = frame.samples
    first = int(fine * min(max(body.cap, 0.0), 2.0 * frame.horizon))
    last = math.ceil(fine * min(max(body.end, 0.0), 2.0 * frame.horizon))
    wide, tall = frame.focal * (body.high - body.low), body.end - body.cap
    if fine * min(wide, tall) < NARROW:
        _cover_narrow(body, frame, left, first, shown[first:last], light[first:last])
    else:
        bulge = 1.0 / (12.0 * fine * min(wide, tall))
        _cover_wide(body, frame, left, first, bulge, shown[first:last], light[first:last])


@kernel
def _cover_wide(
    body: Record, frame: Record, left: float, first: int, bulge: float, shown: np.ndarray, light: np.ndarray
) -> None:
    """Paint a disc that is several cells wide, from row `first` on.

    On average over a cell, an arc is farther inside than its tangent by `bulge` [cells]. The loop has no
    branches, so that it compiles to vector instructions.
    """
    right, forward, radius, up = body.right, body.forward, body.rx, _up(body, frame)
    focal, horizon = frame.samples * frame.focal, frame.samples * frame.horizon
    sun_right, sun_forward, sun_up = frame.sun_right, frame.sun_forward, frame.sun_z
    ambient, diffuse = body.albedo * frame.ambient, body.albedo * frame.diffuse
    u, per_row, per_radius = (frame.samples * left + 0.5) / focal, 1.0 / focal, 1.0 / radius
    square, top = 1.0 + u * u, horizon - first - 0.5
    for row in range(shown.size):  # from 0, or numba would check each index for being negative
        v = (top - row) * per_row
        per_square = 1.0 / (square + v * v)
        # The ray's point nearest to the sphere's middle, relative to that middle.
        depth = (right * u + forward + up * v) * per_square
        x, y, z = depth * u - right, depth - forward, depth * v - up
        miss = math.sqrt(x * x + y * y + z * z)
        across = max(LEAST, math.sqrt(x * x + z * z))
        inside = (radius - miss) * miss * focal / (max(MIN_DEPTH, depth) * across) - bulge
        share = _share(inside, abs(x), abs(z), 1.0 / across)
        share = share if depth > 0.0 else 0.0
        back = math.sqrt(max(0.0, radius * radius - miss * miss) * per_square)
        towards = (x - back * u) * sun_right + (y - back) * sun_forward + (z - back * v) * sun_up
        towards = min(1.0, max(0.0, towards * (per_radius if miss < radius else 1.0 / miss)))
        part = shown[row] * share
        light[row] += part * (ambient + diffuse * towards)
        shown[row] -= part


@inlined
def _share(inside: float, x: float, z: float, per_across: float) -> float:
    """Return the share of a cell on this side of a straight edge.

    Args:
        inside: Distance of the cell's middle from the edge, positive on this side [cells].
        x: Horizontal component of the edge's normal, >= 0.
        z: Vertical component of the edge's normal, >= 0.
        per_across: 1 / length of the normal.
    """
    most, least = max(x, z) * per_across, min(x, z) * per_across
    away = abs(inside)
    corner = max(0.0, 0.5 * (most + least) - away)
    rest = 0.5 * corner * corner / max(LEAST, most * least)
    rest = 0.5 - away / most if away <= 0.5 * (most - least) else rest
    return 1.0 - rest if inside > 0.0 else rest


@kernel
def _cover_narrow(
    body: Record, frame: Record, left: float, first: int, shown: np.ndarray, light: np.ndarray
) -> None:
    """Paint a disc narrower than `NARROW` as a rectangle of the same area, with the light of its middle."""
    fine, up = frame.samples, _up(body, frame)
    wide = SQUARE * 0.5 * fine * frame.focal * (body.high - body.low)
    tall = SQUARE * 0.5 * fine * (body.end - body.cap)
    middle = 0.5 * fine * frame.focal * (body.high + body.low)
    level = 0.5 * fine * (body.cap + body.end) - first
    across = max(0.0, min(fine * left + 1.0, middle + wide) - max(fine * left, middle - wide))
    away = math.sqrt(body.right * body.right + body.forward * body.forward + up * up)
    towards = -(body.right * frame.sun_right + body.forward * frame.sun_forward + up * frame.sun_z) / away
    lit = body.albedo * (frame.ambient + frame.diffuse * min(1.0, max(0.0, towards)))
    for row in range(shown.size):
        down = max(0.0, min(row + 1.0, level + tall) - max(float(row), level - tall))
        part = shown[row] * across * down
        light[row] += part * lit
        shown[row] -= part
