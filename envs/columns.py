"""Kernels of the ray caster: which poles are in view, what a column shows, what a pixel means.

They assume valid input; `envs.raycast` checks it. x right, y forward, z up; a slope u is
right / forward in the camera's frame, so that x_pixel = width / 2 + focal * u.
"""

import math
from typing import NamedTuple

import numba
import numpy as np

NEAR = 1e-9  # [m]; smallest depth, so that a division is always defined
# Columns of the array of poles in view: centre in the camera's frame [m], distance^2 - radius^2,
# slopes right / forward of its left and right edge, radius, top [m], albedo, luminance of the cap.
RIGHT, FORWARD, POWER, LOW, HIGH, RADIUS, TOP, ALBEDO, CAP = range(9)


class World(NamedTuple):
    """A scene as the kernels read it; metres and luminances."""

    half_width: float
    wall_height: float
    walls_near: float
    walls_far: float
    wall_facing_right: float
    wall_facing_left: float
    ground: float
    sky: float
    ambient: float
    diffuse: float
    sun_x: float
    sun_y: float


class Camera(NamedTuple):
    """Pose and geometry; x right, y forward, z up, yaw counter-clockwise from above."""

    x: float
    y: float
    z: float
    cos: float
    sin: float
    width: int
    height: int
    focal: float  # [pixels]


@numba.njit(cache=True, error_model="numpy")
def _see_poles(poles: np.ndarray, camera: Camera) -> np.ndarray:
    """(M, 9) what the columns need of each pole in view, in the columns named RIGHT .. CAP."""
    seen = np.empty((len(poles), 9))
    count = 0
    limit = 0.5 * camera.width / camera.focal
    for i in range(len(poles)):
        dx, dy = poles[i, 0] - camera.x, poles[i, 1] - camera.y
        radius, top = poles[i, 2], poles[i, 3]
        right = dx * camera.cos + dy * camera.sin
        forward = dy * camera.cos - dx * camera.sin
        distance = math.hypot(right, forward)
        power = (distance - radius) * (distance + radius)
        low, high = _edges(right, forward, radius, power)
        if (power > 0.0 or camera.z > top) and low < limit and high > -limit:
            seen[count, RIGHT], seen[count, FORWARD], seen[count, POWER] = right, forward, power
            seen[count, LOW], seen[count, HIGH], seen[count, RADIUS] = low, high, radius
            seen[count, TOP], seen[count, ALBEDO], seen[count, CAP] = top, poles[i, 4], poles[i, 5]
            count += 1
    return seen[:count]


@numba.njit(cache=True, error_model="numpy")
def _edges(right: float, forward: float, radius: float, power: float) -> tuple[float, float]:
    """Slopes u = right / forward of both tangents to a circle; +-inf where one points backwards."""
    if power <= 0.0:
        return -math.inf, math.inf
    tangent = math.sqrt(power)
    left_forward = forward * tangent + right * radius
    right_forward = forward * tangent - right * radius
    if left_forward <= 0.0 and right_forward <= 0.0:
        return math.inf, -math.inf
    low = (right * tangent - forward * radius) / left_forward if left_forward > 0.0 else -math.inf
    high = (right * tangent + forward * radius) / right_forward if right_forward > 0.0 else math.inf
    return low, high


@numba.njit(cache=True, error_model="numpy")
def _cuts(world: World, camera: Camera, seen: np.ndarray, samples: int) -> np.ndarray:
    """Sorted positions [pixels] that cut the image into strips without a silhouette inside."""
    slopes = np.empty(2 * len(seen) + 4)
    slopes[: len(seen)] = seen[:, LOW]
    slopes[len(seen) : 2 * len(seen)] = seen[:, HIGH]
    for k in range(4):
        dx = (world.half_width if k < 2 else -world.half_width) - camera.x
        dy = (world.walls_near if k % 2 else world.walls_far) - camera.y
        forward = dy * camera.cos - dx * camera.sin
        right = dx * camera.cos + dy * camera.sin
        slopes[2 * len(seen) + k] = right / forward if forward > 0.0 else math.inf
    breaks = np.sort(0.5 * camera.width + camera.focal * slopes)
    grid = camera.width * samples + 1
    cuts = np.empty(grid + len(breaks))
    size, k = 0, int(np.searchsorted(breaks, 0.0))
    for i in range(grid):
        while k < len(breaks) and breaks[k] < i / samples:
            cuts[size] = breaks[k]
            size, k = size + 1, k + 1
        cuts[size] = i / samples
        size += 1
    return cuts[:size]


@numba.njit(cache=True, error_model="numpy")
def _insert(depths: np.ndarray, things: np.ndarray, count: int, depth: float, thing: int) -> int:
    """Insert `thing` at `depth` into the `count` hits sorted by depth; the new count."""
    k = count
    while k > 0 and depths[k - 1] > depth:
        depths[k], things[k] = depths[k - 1], things[k - 1]
        k -= 1
    depths[k], things[k] = depth, thing
    return count + 1


@numba.njit(cache=True, error_model="numpy")
def _hit(world: World, camera: Camera, seen: np.ndarray, u: float, scratch: tuple) -> int:
    """All along slope `u`, nearest first: depth [m] and row of `seen`, or -1, -2 for a wall."""
    depths, things, _, _ = scratch
    count = 0
    for i in range(len(seen)):
        if seen[i, LOW] <= u <= seen[i, HIGH]:
            middle = seen[i, RIGHT] * u + seen[i, FORWARD]
            far = middle + math.sqrt(max(0.0, middle * middle - (1.0 + u * u) * seen[i, POWER]))
            # power / far is (middle - root) / (1 + u u) without its cancellation.
            depth = max(NEAR, seen[i, POWER] / far) if far > 0.0 else NEAR
            count = _insert(depths, things, count, depth, i)
    dx = u * camera.cos - camera.sin
    for side in (-1, 1):
        depth = (side * world.half_width - camera.x) / dx
        y = camera.y + depth * (u * camera.sin + camera.cos)
        if depth > NEAR and world.walls_near <= y <= world.walls_far:
            count = _insert(depths, things, count, depth, -1 if side < 0 else -2)
    return count


@numba.njit(cache=True, error_model="numpy")
def _shade_pole(world: World, camera: Camera, seen: np.ndarray, u: float, depth: float, i: int) -> float:
    right, forward = depth * u - seen[i, RIGHT], depth - seen[i, FORWARD]
    sun_right = world.sun_x * camera.cos + world.sun_y * camera.sin
    sun_forward = world.sun_y * camera.cos - world.sun_x * camera.sin
    cosine = (right * sun_right + forward * sun_forward) / seen[i, RADIUS]
    return seen[i, ALBEDO] * (world.ambient + world.diffuse * min(1.0, max(0.0, cosine)))


@numba.njit(cache=True, error_model="numpy", inline="always")  # a call costs more than the work
def _push(rows: np.ndarray, values: np.ndarray, count: int, row: float, luminance: float) -> int:
    """Cover with `luminance` what lies between the highest covered row and `row`."""
    values[count] = luminance
    rows[count + 1] = min(max(row, 0.0), rows[count])
    return count + 1


@numba.njit(cache=True, error_model="numpy", inline="always")
def _column(world: World, camera: Camera, seen: np.ndarray, u: float, scratch: tuple) -> int:
    """Compose a column from below: values[k] covers rows[k + 1] .. rows[k]; the number of spans.

    Exact because all stands on the ground and the camera is above it: what is farther is
    visible only above what is nearer.
    """
    depths, things, rows, values = scratch
    horizon = 0.5 * camera.height
    rows[0], count = camera.height, 0
    for k in range(_hit(world, camera, seen, u, scratch)):
        scale, i = camera.focal / depths[k], things[k]
        top = seen[i, TOP] if i >= 0 else world.wall_height
        summit = horizon + scale * (camera.z - top)
        if summit >= rows[count] and camera.z <= top:
            continue
        count = _push(rows, values, count, horizon + scale * camera.z, world.ground)
        if i >= 0:
            count = _push(rows, values, count, summit, _shade_pole(world, camera, seen, u, depths[k], i))
        else:
            side = world.half_width if i == -2 else -world.half_width
            luminance = world.wall_facing_right if camera.x > side else world.wall_facing_left
            count = _push(rows, values, count, summit, luminance)
        if i >= 0 and camera.z > top:
            behind = horizon + camera.focal * (camera.z - top) / _leave(seen, u, i)
            count = _push(rows, values, count, behind, seen[i, CAP])
    count = _push(rows, values, count, horizon, world.ground)
    return _push(rows, values, count, 0.0, world.sky)


@numba.njit(cache=True, error_model="numpy")
def _leave(seen: np.ndarray, u: float, i: int) -> float:
    """Depth at which slope `u` leaves the pole in row `i` of `seen` [m]."""
    middle = seen[i, RIGHT] * u + seen[i, FORWARD]
    square = 1.0 + u * u
    return max(NEAR, (middle + math.sqrt(max(0.0, middle * middle - square * seen[i, POWER]))) / square)


@numba.njit(cache=True, error_model="numpy")
def _scratch(size: int) -> tuple:
    """Depths and things of a column's hits; rows and values of its spans."""
    return np.empty(size + 2), np.empty(size + 2, np.int64), np.empty(3 * size + 9), np.empty(3 * size + 9)


@numba.njit(cache=True, error_model="numpy")
def render_area(poles: np.ndarray, world: World, camera: Camera, samples: int) -> np.ndarray:
    """Mean luminance over the area of each pixel."""
    seen = _see_poles(poles, camera)
    cuts = _cuts(world, camera, seen, samples)
    scratch = _scratch(len(seen))
    rows, values = scratch[2], scratch[3]
    # steps[r] holds how much row r is brighter than row r - 1: one span is four additions.
    steps = np.zeros((camera.height + 2, camera.width))
    for k in range(len(cuts) - 1):
        wide, middle = cuts[k + 1] - cuts[k], 0.5 * (cuts[k] + cuts[k + 1])
        column = min(int(middle), camera.width - 1)
        spans = _column(world, camera, seen, (middle - 0.5 * camera.width) / camera.focal, scratch)
        above = 0.0
        for i in range(spans - 1, -1, -1):
            row = int(rows[i + 1])
            change = wide * (values[i] - above)
            steps[row, column] += change * (row + 1 - rows[i + 1])
            steps[row + 1, column] += change * (rows[i + 1] - row)
            above = values[i]
    image = np.empty((camera.height, camera.width), np.float32)
    for row in range(camera.height):
        if row > 0:
            steps[row] += steps[row - 1]
        image[row] = steps[row]
    return image


@numba.njit(cache=True, error_model="numpy")
def render_points(poles: np.ndarray, world: World, camera: Camera) -> np.ndarray:
    """Luminance at the centre of each pixel."""
    seen = _see_poles(poles, camera)
    scratch = _scratch(len(seen))
    rows, values = scratch[2], scratch[3]
    image = np.empty((camera.height, camera.width), np.float32)
    for column in range(camera.width):
        _column(world, camera, seen, (column + 0.5 - 0.5 * camera.width) / camera.focal, scratch)
        span = 0
        for row in range(camera.height - 1, -1, -1):
            while rows[span + 1] > row + 0.5:
                span += 1
            image[row, column] = values[span]
    return image
