"""Point samples of a scene by intersecting each ray with every surface: slow, plain, independent.

One ray per pixel centre, direction (right, forward, up) = (u, 1, -v), so that the parameter
along a ray is its depth [m]. Every body gives where the ray enters it, the nearest wins (a
depth buffer), and textures are evaluated exactly at the point hit. Nothing here is shared
with the column renderer, which is why it serves as its truth. Input is assumed valid.
"""

import math
from pathlib import Path
from typing import NamedTuple

import numba
import numpy as np

import envs
from core import forget_stale_kernels
from envs.raycast.renderer import focal_length
from envs.scene import CONE, ELLIPSOID, POLE, Scene
from envs.scene.textures import TILE, TILE_PERIODS, Texture, around, noise_tile

forget_stale_kernels(Path(__file__).parent, Path(envs.__file__).parent)
SKY, GROUND, WALL, BODY = range(4)  # what a ray hits
kernel = numba.njit(cache=True, error_model="numpy")


class Camera(NamedTuple):
    """Where the eye is [m], where it looks, and an image of `focal` pixels focal length."""

    x: float
    y: float
    z: float
    cos: float
    sin: float
    width: int
    height: int
    focal: float


class Walls(NamedTuple):
    """At x = +-half; how high they are, where they begin and end in y [m]."""

    half: float
    height: float
    near: float
    far: float


class Hits(NamedTuple):
    """What rays hit, arrays of one shape.

    Attributes:
        surface: int8, one of SKY, GROUND, WALL, BODY.
        thing: int64 index of the obstacle, 0 or 1 for the left or right wall.
        depth: float64 distance along the optical axis [m], inf for the sky.
        normal: (..., 3) float64 outward unit normal.
        point: (..., 3) float64 [m].
    """

    surface: np.ndarray
    thing: np.ndarray
    depth: np.ndarray
    normal: np.ndarray
    point: np.ndarray


@kernel
def _enter_round(eye: np.ndarray, ray: np.ndarray, radius: float) -> tuple[float, float]:
    """Where a ray enters and leaves an endless upright cylinder around the origin; (inf, -inf): never."""
    square = ray[0] * ray[0] + ray[1] * ray[1]
    middle = -(eye[0] * ray[0] + eye[1] * ray[1]) / square
    beside = eye[0] * ray[1] - eye[1] * ray[0]
    rest = (radius * radius - beside * beside / square) / square
    if rest < 0.0:
        return math.inf, -math.inf
    return middle - math.sqrt(rest), middle + math.sqrt(rest)


@kernel
def _enter_slab(eye: float, ray: float, half: float) -> tuple[float, float]:
    """Where a ray enters and leaves -half < coordinate < half."""
    if ray == 0.0:
        return (-math.inf, math.inf) if abs(eye) < half else (math.inf, -math.inf)
    one, other = (-half - eye) / ray, (half - eye) / ray
    return min(one, other), max(one, other)


@kernel
def _enter_pole(eye: np.ndarray, ray: np.ndarray, size: np.ndarray, normal: np.ndarray) -> float:
    near, far = _enter_round(eye, ray, size[0])
    low, high = _enter_slab(eye[2], ray[2], size[2])
    depth = max(near, low)
    if not 0.0 < depth <= min(far, high):
        return math.inf
    if low > near:
        normal[:] = (0.0, 0.0, -1.0 if ray[2] > 0.0 else 1.0)
    else:
        x, y = eye[0] + depth * ray[0], eye[1] + depth * ray[1]
        normal[:] = (x / size[0], y / size[0], 0.0)
    return depth


@kernel
def _enter_box(eye: np.ndarray, ray: np.ndarray, size: np.ndarray, normal: np.ndarray) -> float:
    depth, end, axis = -math.inf, math.inf, 0
    for k in range(3):
        near, far = _enter_slab(eye[k], ray[k], size[k])
        if near > depth:
            depth, axis = near, k
        end = min(end, far)
    if not 0.0 < depth <= end:
        return math.inf
    normal[:] = 0.0
    normal[axis] = -1.0 if ray[axis] > 0.0 else 1.0
    return depth


@kernel
def _enter_ellipsoid(eye: np.ndarray, ray: np.ndarray, size: np.ndarray, normal: np.ndarray) -> float:
    """As a unit sphere, in coordinates divided by the half-axes."""
    a = b = c = 0.0
    for k in range(3):
        e, d = eye[k] / size[k], ray[k] / size[k]
        a, b, c = a + d * d, b + e * d, c + e * e
    # |e x d|^2 instead of b b - a c, which cancels far away.
    cross = 0.0
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        cross += ((eye[i] * ray[j] - eye[j] * ray[i]) / (size[i] * size[j])) ** 2
    if a < cross or c <= 1.0:
        return math.inf
    depth = (-b - math.sqrt(a - cross)) / a
    if depth <= 0.0:
        return math.inf
    length = 0.0
    for k in range(3):
        normal[k] = (eye[k] + depth * ray[k]) / (size[k] * size[k])
        length += normal[k] * normal[k]
    normal /= math.sqrt(length)
    return depth


@kernel
def _enter_cone(eye: np.ndarray, ray: np.ndarray, size: np.ndarray, normal: np.ndarray) -> float:
    """The side where x^2 + y^2 = k^2 (apex - z)^2 and the ray comes from outside; else the base."""
    k = size[0] / (2.0 * size[2])
    drop = size[2] - eye[2]  # from the apex down to the eye
    a = ray[0] * ray[0] + ray[1] * ray[1] - k * k * ray[2] * ray[2]
    b = eye[0] * ray[0] + eye[1] * ray[1] + k * k * drop * ray[2]
    c = eye[0] * eye[0] + eye[1] * eye[1] - k * k * drop * drop
    rest = b * b - a * c
    best = math.inf
    if rest >= 0.0:
        root = -b - math.copysign(math.sqrt(rest), b)
        for depth in (root / a, c / root):
            z = eye[2] + depth * ray[2]
            inwards = depth * a + b  # half the derivative of x^2 + y^2 - k^2 (apex - z)^2
            if 0.0 < depth < best and -size[2] <= z <= size[2] and inwards < 0.0:
                best = depth
                x, y = eye[0] + depth * ray[0], eye[1] + depth * ray[1]
                radial = math.hypot(x, y)
                tall = math.sqrt(1.0 + k * k)
                normal[:] = (x / radial / tall, y / radial / tall, k / tall)
    base = (-size[2] - eye[2]) / ray[2]
    x, y = eye[0] + base * ray[0], eye[1] + base * ray[1]
    if ray[2] > 0.0 and 0.0 < base < best and x * x + y * y <= size[0] * size[0]:
        best = base
        normal[:] = (0.0, 0.0, -1.0)
    return best


@kernel
def _enter(kind: int, eye: np.ndarray, ray: np.ndarray, size: np.ndarray, normal: np.ndarray) -> float:
    if kind == POLE:
        return _enter_pole(eye, ray, size, normal)
    if kind == CONE:
        return _enter_cone(eye, ray, size, normal)
    if kind == ELLIPSOID:
        return _enter_ellipsoid(eye, ray, size, normal)
    return _enter_box(eye, ray, size, normal)


@kernel
def _trace_flat(eye: np.ndarray, ray: np.ndarray, walls: Walls, normal: np.ndarray) -> tuple[float, int, int]:
    """Depth, surface and thing of the ground, a wall or the sky along a ray."""
    best, surface, thing = math.inf, SKY, 0
    if ray[2] < 0.0:
        best, surface = max(-eye[2] / ray[2], 1e-300), GROUND
        normal[:] = (0.0, 0.0, 1.0)
    for side in (-1.0, 1.0):
        depth = (side * walls.half - eye[0]) / ray[0]
        y, z = eye[1] + depth * ray[1], eye[2] + depth * ray[2]
        if 0.0 < depth < best and walls.near <= y <= walls.far and 0.0 <= z <= walls.height:
            best, surface, thing = depth, WALL, (0 if side < 0.0 else 1)
            normal[:] = (-1.0 if eye[0] < side * walls.half else 1.0, 0.0, 0.0)
    return best, surface, thing


@kernel
def _trace(kinds: np.ndarray, bodies: np.ndarray, walls: Walls, camera: Camera, hits: Hits) -> None:
    """Fill `hits` with what each pixel centre's ray hits.

    Args:
        kinds: (N,) of the bodies.
        bodies: (N, 6) float64 centre and half-axes [m].
        walls: Both.
        camera: The eye and its image.
        hits: Arrays of the shape of the image.
    """
    ray, normal, eye = np.empty(3), np.empty(3), np.array([camera.x, camera.y, camera.z])
    eyes, reach = eye - bodies[:, :3], 1.001 * (bodies[:, 3] ** 2 + bodies[:, 4] ** 2)
    for row in range(camera.height):
        ray[2] = (0.5 * camera.height - row - 0.5) / camera.focal
        for column in range(camera.width):
            u = (column + 0.5 - 0.5 * camera.width) / camera.focal
            ray[0], ray[1] = u * camera.cos - camera.sin, u * camera.sin + camera.cos
            best, surface, thing = _trace_flat(eye, ray, walls, hits.normal[row, column])
            square = ray[0] * ray[0] + ray[1] * ray[1]
            for i in range(len(kinds)):
                beside = eyes[i, 0] * ray[1] - eyes[i, 1] * ray[0]
                if beside * beside > reach[i] * square:
                    continue  # the ray passes beside a circle around the body: most do
                depth = _enter(kinds[i], eyes[i], ray, bodies[i, 3:], normal)
                if depth < best:
                    best, surface, thing = depth, BODY, i
                    hits.normal[row, column] = normal
            hits.surface[row, column], hits.thing[row, column], hits.depth[row, column] = surface, thing, best
            for k in range(3):
                hits.point[row, column, k] = eye[k] + best * ray[k]


def trace_scene(
    scene: Scene, pose: tuple[float, float, float, float], width: int, height: int, focal: float
) -> Hits:
    """What the ray through each pixel centre hits.

    Args:
        scene: What to look at; its mesh is left out.
        pose: x, y, z [m], yaw [rad].
        width: Columns of the image.
        height: Rows of the image.
        focal: Focal length [pixels].
    """
    x, y, z, yaw = map(float, pose)
    camera = Camera(x, y, z, math.cos(yaw), math.sin(yaw), width, height, focal)
    walls = Walls(0.5 * scene.width_m, float(scene.wall_height_m), *map(float, scene.walls_y_m))
    bodies = np.stack([scene.obstacles[key] for key in ("x", "y", "z", "rx", "ry", "rz")], axis=1)
    shape = (height, width)
    surface, thing, depth = np.empty(shape, np.int8), np.empty(shape, np.int64), np.empty(shape)
    hits = Hits(surface, thing, depth, np.zeros((*shape, 3)), np.empty((*shape, 3)))
    _trace(scene.obstacles["kind"].astype(np.int64), bodies, walls, camera, hits)
    return hits


def shade_hits(scene: Scene, hits: Hits, t_s: float) -> np.ndarray:
    """Linear luminance of what is hit, float64 of the shape of `hits.depth`."""
    albedo = np.full(hits.depth.shape, scene.ground_albedo)
    albedo[hits.surface == WALL] = scene.wall_albedo
    on_body = hits.surface == BODY
    albedo[on_body] = scene.obstacles["albedo"][hits.thing[on_body]]
    for surface, texture in (
        (GROUND, scene.ground_texture),
        (WALL, scene.wall_texture),
        (BODY, scene.obstacle_texture),
    ):
        where = hits.surface == surface
        if not texture.plain and where.any():
            s, q = _coordinates(scene, hits, where)
            albedo[where] *= 1.0 + texture.contrast * pattern_points(texture, s, q, t_s)
    luminance = scene.shade(albedo, hits.normal)
    luminance[hits.surface == SKY] = scene.sky_luminance
    return luminance


def _coordinates(scene: Scene, hits: Hits, where: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Surface coordinates (s, q) [m] of the points hit in the mask `where`."""
    (x, y, z), normal = hits.point[where].T, hits.normal[where]
    level, across = np.abs(normal[:, 2]) == 1.0, np.abs(normal[:, 0]) == 1.0
    s, q = np.where(level, x, np.where(across, y, x)), np.where(level, y, z)
    bodies = scene.obstacles[hits.thing[where]] if len(scene.obstacles) else scene.obstacles
    if len(bodies) and (hits.surface[where] == BODY).all():
        # The apex of an ellipsoid is level but is no level face.
        sides = np.isin(bodies["kind"], (POLE, CONE)) & ~level | (bodies["kind"] == ELLIPSOID)
        turns = np.array([around(scene.obstacle_texture, radius) for radius in scene.obstacles["rx"]])
        azimuth = np.arctan2(y - bodies["y"], x - bodies["x"])
        s = np.where(sides, bodies["x"] + turns[hits.thing[where]] * azimuth, s)
        q = np.where(sides, bodies["y"] + z, q)
    return s, q


def sample_luminance(
    scene: Scene,
    pose: tuple[float, float, float, float],
    width: int,
    height: int,
    fov_deg: float = 90.0,
    samples: int = 1,
    t_s: float = 0.0,
) -> np.ndarray:
    """Return the mean of samples x samples point samples per pixel, without anti-aliasing; 1: pixel centres.

    Arguments and result as for `RaycastRenderer.render`, with `pose` = (x, y, z [m], yaw [rad]). A rasteriser
    computes the same at the same points, and the exact image agrees in the limit of many samples.
    """
    focal = focal_length(width * samples, fov_deg)
    points = shade_hits(scene, trace_scene(scene, pose, width * samples, height * samples, focal), t_s)
    return points.reshape(height, samples, width, samples).mean(axis=(1, 3)).astype(np.float32)


def pattern_points(texture: Texture, s_m: np.ndarray, q_m: np.ndarray, t_s: float = 0.0) -> np.ndarray:
    """Return the pattern P at points of a surface, not filtered.

    Args:
        texture: What pattern, how long and how fast.
        s_m: Surface coordinates [m], any shape.
        q_m: The other surface coordinates [m], of the same shape.
        t_s: Time [s].

    Returns:
        float64 in [-1, 1], of the same shape. A checker is +1 in the cell of the origin; the
        noise is bilinear between the texels of `noise_tile`.
    """
    s = (np.asarray(s_m, np.float64) - texture.velocity_mps[0] * t_s) / texture.period_m
    q = (np.asarray(q_m, np.float64) - texture.velocity_mps[1] * t_s) / texture.period_m
    if texture.pattern == "noise":
        return _bilinear(noise_tile(texture.seed), s * (TILE / TILE_PERIODS), q * (TILE / TILE_PERIODS))
    along_s = 1.0 - 2.0 * (np.floor(2.0 * s) % 2.0)
    along_q = 1.0 - 2.0 * (np.floor(2.0 * q) % 2.0)
    signs = {"checker": along_s * along_q, "stripes": along_s, "rings": along_q}
    return signs.get(texture.pattern, np.zeros(np.broadcast(s, q).shape))


def _bilinear(tile: np.ndarray, column: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Interpolate `tile` at `column`, `row` [texels], bilinear and periodic."""
    left, top = np.floor(column), np.floor(row)
    across, down = column - left, row - top
    i, j = (left % TILE).astype(np.int64), (top % TILE).astype(np.int64)
    right, below = (i + 1) % TILE, (j + 1) % TILE
    upper = tile[j, i] * (1.0 - across) + tile[j, right] * across
    lower = tile[below, i] * (1.0 - across) + tile[below, right] * across
    return upper * (1.0 - down) + lower * down
