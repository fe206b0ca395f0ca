"""Kernels that light and texture surfaces that are curved along a column: ellipsoids and the sides of cones.

Each row of a strip has its own luminance. Input is assumed valid.
"""

import math
from typing import NamedTuple

import numpy as np

from envs.compiled import inlined, kernel
from envs.raycast.bodies import MIN_DEPTH
from envs.raycast.coverage import MIN_RISE, Layer
from envs.raycast.noise import Footprint
from envs.raycast.patterns import mean_pattern
from envs.raycast.records import Bends, Canvas, Ends, Record
from envs.scene import CONE

GAUSS = 0.5 / math.sqrt(3.0)  # distance from the middle of the two points that represent a length of 1
LENGTH = 1.0 / (2.0 * GAUSS)  # represented length over the distance of the two points
POINTS = 4  # sample points per row: at each of two slopes, two heights
LEAST = 1e-300  # instead of 0 in a denominator


class Quadric(NamedTuple):
    """A cone's side or an ellipsoid: right^2 + forward^2 + ratio * up^2 = size around its apex or middle [m].

    Attributes:
        right: Right coordinate of the axis, from the eye.
        forward: Forward coordinate of the axis, from the eye.
        radius: Radius of the footprint.
        ratio: As in the equation; dimensionless.
        over: Height of the eye over the apex or middle.
        size: As in the equation [m^2].
        rest: The left side of the equation minus the right side at the eye [m^2].
    """

    right: float
    forward: float
    radius: float
    ratio: float
    over: float
    size: float
    rest: float


class Light(NamedTuple):
    """Direction of the sun and the terms of a body's light.

    Attributes:
        right: Right component of the unit vector to the sun.
        forward: Its forward component.
        up: Its upward component.
        ambient: Luminance without sun.
        diffuse: Luminance added by the sun at normal incidence.
    """

    right: float
    forward: float
    up: float
    ambient: float
    diffuse: float


class Patch(NamedTuple):
    """Part of a body that is visible in a gap.

    Attributes:
        left: Slope of its left end.
        wide: Its width in slopes.
        top: Its upper edge [rows].
        bottom: Its lower edge [rows].
        first: The first row that it overlaps.
        rows: Number of rows that it overlaps.
        horizon: Row of the horizon.
        per_row: Fall per depth and row.
    """

    left: float
    wide: float
    top: Ends
    bottom: Ends
    first: int
    rows: int
    horizon: float
    per_row: float


class Place(NamedTuple):
    """A point relative to a curved body: right and forward of its axis, above its middle or apex [m]."""

    right: float
    forward: float
    up: float


def make_bends(height: int) -> Bends:
    """Allocate room for images of `height` rows."""
    rows = height + 4  # a cut row at each end, and padding to whole vectors
    return Bends(*np.zeros((5, POINTS * rows)))


@inlined
def _quadric(body: Record, frame: Record) -> Quadric:
    half, radius = 0.5 * (body.top - body.bottom), body.rx
    ratio, over, size = (radius / half) ** 2, frame.eye_z - body.bottom - half, radius * radius
    if body.kind == CONE:
        ratio, over, size = -0.25 * ratio, frame.eye_z - body.top, 0.0
    rest = body.right * body.right + body.forward * body.forward + ratio * over * over - size
    return Quadric(body.right, body.forward, radius, ratio, over, size, rest)


@inlined
def _footprint(shape: Quadric, u: float) -> tuple[float, float]:
    """Return the depths at which slope `u` enters and leaves the footprint [m]."""
    square, beside = 1.0 + u * u, (shape.right - shape.forward * u) / shape.radius
    half = shape.radius * math.sqrt(max(0.0, square - beside * beside))
    middle, per_square = shape.right * u + shape.forward, 1.0 / square
    return max(MIN_DEPTH, (middle - half) * per_square), max(MIN_DEPTH, (middle + half) * per_square)


@inlined
def _meet(shape: Quadric, u: float, fall: float, nearest: float, farthest: float) -> Place:
    """Return the point where the ray of slope `u` and `fall` per depth meets a quadric, between two depths.

    The depth is a root of a * depth^2 - 2 * b * depth + rest.
    """
    a = 1.0 + u * u + shape.ratio * fall * fall
    b = shape.right * u + shape.forward + shape.ratio * shape.over * fall
    root = math.sqrt(max(0.0, b * b - a * shape.rest))
    # Seen from inside the cone's continuation above its apex, the second crossing is the side.
    outside = shape.rest > 0.0
    above, below = shape.rest if outside else b - root, b + root if outside else a
    depth = min(max(above / (below if below != 0.0 else -LEAST), nearest), farthest)
    return Place(depth * u - shape.right, depth - shape.forward, shape.over - fall * depth)


@kernel
def shade_rows(canvas: Canvas, body: Record, top: Ends, bottom: Ends) -> None:
    """Light a cone's side or an ellipsoid between two edges in the gap, row by row, including its pattern."""
    frame, strip, lights = canvas.frame, canvas.strip, canvas.bends.lights
    first, last = int(min(top.left, top.right)), math.ceil(max(bottom.left, bottom.right))
    left, wide = strip.gap_slopes.left, strip.gap_slopes.right - strip.gap_slopes.left
    patch = Patch(left, wide, top, bottom, first, last - first, frame.horizon, 1.0 / frame.focal)
    base, shape = strip.weight * body.albedo, _quadric(body, frame)
    light = Light(frame.sun_right, frame.sun_forward, frame.sun_z, base * frame.ambient, base * frame.diffuse)
    _light_points(shape, light, patch, canvas.bends)
    if frame.body_texture.contrast > 0.0:
        _texture_rows(canvas, body, shape, patch)
    paint = canvas.accumulators[Layer.PAINT]
    for k in range(patch.rows):
        paint[first + k] += lights[4 * k] + lights[4 * k + 1] + (lights[4 * k + 2] + lights[4 * k + 3])


@kernel
def _texture_rows(canvas: Canvas, body: Record, shape: Quadric, patch: Patch) -> None:
    """Multiply the lights of each row by the mean of the pattern over the row's visible part.

    The row's sample points have the mean and the spread of its visible part. The pattern is averaged over a
    parallelogram with the same mean and spread, so a row cut by an edge gets the pattern of its visible part.
    """
    frame, bends = canvas.frame, canvas.bends
    lights, turns, ups, talls = bends.lights, bends.turns, bends.ups, bends.talls
    _find_turns(POINTS * patch.rows, turns, bends.aheads)
    facing, height = math.atan2(-body.dy, -body.dx), body.y + frame.eye_z - shape.over
    for j in range(0, POINTS * patch.rows, POINTS):
        left = talls[j] / max(1e-9, talls[j] + talls[j + 1])
        right = 1.0 - left
        one, other = 0.5 * _back(turns[j + 2] - turns[j]), 0.5 * _back(turns[j + 3] - turns[j + 1])
        across = _back(turns[j + 1] - turns[j]) + other - one
        up, up_other = 0.5 * (ups[j] + ups[j + 2]), 0.5 * (ups[j + 1] + ups[j + 3])
        s = body.x + body.turn * (facing + turns[j] + one + right * across)
        q = height + left * up + right * up_other
        wide = LENGTH * 2.0 * math.sqrt(max(0.0, left * right))
        turn = 2.0 * LENGTH * (left * one + right * other)
        rise = LENGTH * (left * (ups[j + 2] - ups[j]) + right * (ups[j + 3] - ups[j + 1]))
        sides = Footprint(body.turn * wide * across, wide * (up_other - up), body.turn * turn, rise)
        factor = 1.0 + mean_pattern(canvas, frame.body_texture, s, q, sides)
        for k in range(j, j + POINTS):
            lights[k] *= factor


@inlined
def _back(turn: float) -> float:
    """Return a difference of two angles, wrapped to [-pi, pi) [rad]."""
    return turn - 2.0 * math.pi * math.floor(turn / (2.0 * math.pi) + 0.5)


@kernel
def _find_turns(points: int, turns: np.ndarray, aheads: np.ndarray) -> None:
    """Replace sines in `turns`, with cosines in `aheads`, by the angles [rad]; without branches."""
    for p in range(points):
        turns[p] = _angle(turns[p], aheads[p])


@inlined
def _angle(sine: float, cosine: float) -> float:
    """Compute `math.atan2` to 1e-6, without branches."""
    length = math.sqrt(max(LEAST, sine * sine + cosine * cosine))
    half = sine / (length + abs(cosine))  # tangent of half the angle; then x, of a quarter of it
    x = half / (1.0 + math.sqrt(1.0 + half * half))
    square = x * x
    series = 1.0 / 9.0 - square * (1.0 / 11.0 - square * (1.0 / 13.0 - square / 15.0))
    series = 1.0 - square * (1.0 / 3.0 - square * (0.2 - square * (1.0 / 7.0 - square * series)))
    angle = 4.0 * x * series
    return angle if cosine >= 0.0 else math.copysign(math.pi, sine) - angle


@kernel
def _light_points(shape: Quadric, light: Light, patch: Patch, bends: Bends) -> None:
    """Fill `bends.lights` with the luminance at four points of each row, times the part of the row of each.

    There are two points at each of two slopes, within the part of the row between the two edges. The other
    arrays of `bends` get the positions of the points. The loop has no branches, so that it compiles to
    vector instructions.
    """
    top, bottom, horizon, per_row = patch.top, patch.bottom, patch.horizon, patch.per_row
    lights, turns, aheads, ups, talls = bends
    fall_top, fall_bottom = top.right - top.left, bottom.right - bottom.left
    per_top, per_bottom = _inverse(fall_top), _inverse(fall_bottom)
    high, low = min(top.left, top.right), max(bottom.left, bottom.right)
    top_falls, top_rises = 1.0 * (fall_top >= MIN_RISE), 1.0 * (fall_top <= -MIN_RISE)
    bottom_falls, bottom_rises = 1.0 * (fall_bottom >= MIN_RISE), 1.0 * (fall_bottom <= -MIN_RISE)
    rows = patch.rows + patch.rows % 2  # a partly filled vector would take as long as many full ones
    for p in range(POINTS * rows):
        row = float(patch.first + (p >> 2))
        start, end = max(high, row), min(low, row + 1.0)
        # Range of the strip in which part of the row lies between the edges.
        below_top = min(1.0, max(0.0, (end - top.left) * per_top))
        above_bottom = min(1.0, max(0.0, (start - bottom.left) * per_bottom))
        right = min(1.0 - top_falls * (1.0 - below_top), 1.0 - bottom_rises * (1.0 - above_bottom))
        left = max(top_rises * below_top, bottom_falls * above_bottom)
        right = max(left, right)
        one, other = left + (0.5 - GAUSS) * (right - left), left + (0.5 + GAUSS) * (right - left)
        upper, upper_other = max(start, top.left + one * fall_top), max(start, top.left + other * fall_top)
        tall = max(0.0, min(end, bottom.left + one * fall_bottom) - upper)
        tall_other = max(0.0, min(end, bottom.left + other * fall_bottom) - upper_other)
        all_tall = max(1e-9, tall + tall_other)
        share = (_below(row, top, per_top) - _below(row, bottom, per_bottom)) / all_tall
        if p & 1:
            one, upper, tall = other, upper_other, tall_other
        u = patch.left + one * patch.wide
        fall = (upper + (0.5 + (float(p & 2) - 1.0) * GAUSS) * tall - horizon) * per_row
        nearest, farthest = _footprint(shape, u)
        place = _meet(shape, u, fall, nearest, farthest)
        length = math.sqrt(max(LEAST, shape.size + shape.ratio * (shape.ratio - 1.0) * place.up * place.up))
        towards = place.right * light.right + place.forward * light.forward
        towards = (towards + shape.ratio * place.up * light.up) / length
        turns[p] = place.right * shape.forward - place.forward * shape.right
        aheads[p] = -(place.right * shape.right + place.forward * shape.forward)
        ups[p], talls[p] = place.up, tall
        lights[p] = 0.5 * tall * share * (light.ambient + light.diffuse * min(1.0, max(0.0, towards)))


@inlined
def _inverse(rise: float) -> float:
    """Return 1 / rise; 0 for a level edge."""
    return 1.0 / rise if abs(rise) >= MIN_RISE else 0.0


@inlined
def _below(row: float, edge: Ends, per_rise: float) -> float:
    """Compute `coverage.share_below` without branches."""
    low, spread = min(edge.left, edge.right), abs(edge.right - edge.left)
    above, below = min(max(row - low, 0.0), spread), min(max(row + 1.0 - low, 0.0), spread)
    cut = 0.5 * (below - above) * (below + above) * abs(per_rise)
    return cut + min(1.0, max(0.0, row + 1.0 - low - spread))
