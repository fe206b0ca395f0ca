"""What the shaders read of a scene: one record per vertex, and triangles between them.

Flat faces, the ground, the walls and a scene's own mesh are as in `envs.meshes`. A round body
is a few rings of corners around its centre, which `envs.shaders` turns towards the camera.
"""

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from envs.meshes import Part, box_mesh, ground_mesh, mean_radius, wall_meshes
from envs.obstacles import BOX, CONE, ELLIPSOID, POLE
from envs.shaders import (
    DISC,
    FACE_X,
    GROUND,
    MESH,
    NONE,
    ON_GROUND,
    ON_OBSTACLES,
    ON_WALLS,
    RIM,
    SIDE,
)
from envs.textures import TILE_PERIODS, Texture, around

if TYPE_CHECKING:
    from envs.scene import Scene

# The attributes of `shaders.VERTEX`, in their order.
VERTEX = np.dtype(
    [
        ("position", "f4", 3),
        ("ring", "f4", 3),
        ("quadric", "f4", 4),
        ("surface", "f4", 2),
        ("origin", "f4", 2),
        ("body", "f4", 4),
    ]
)
# Corners of a ring and corners of an ellipsoid's outline. Sides and outlines of poles and cones
# are exact with any number; the rims of poles and the outlines of ellipsoids are polygons.
RING, OUTLINE = 16, 40

Triangles = tuple[np.ndarray, np.ndarray]  # (V,) VERTEX, (F, 3) faces


class Drawing(NamedTuple):
    """All that can be seen of a scene, counter-clockwise seen from outside.

    Attributes:
        vertices: (V,) VERTEX.
        faces: (F, 3) int64.
        order: (N,) the obstacles in the order in which their faces follow each other.
        first: (N + 1,) first face of each, and the first of the faces that are of no obstacle.
    """

    vertices: np.ndarray
    faces: np.ndarray
    order: np.ndarray
    first: np.ndarray


def draw(scene: "Scene") -> Drawing:
    """The triangles of `scene`, what hides most first, so that less is shaded twice."""
    bodies = scene.obstacles
    parts, order = [], [np.zeros(0, np.int64)]
    standing = bodies["z"] <= bodies["rz"]  # their undersides cannot be seen
    for kind in (POLE, CONE, ELLIPSOID):
        for on_ground in (True, False):
            order.append(np.flatnonzero((bodies["kind"] == kind) & (standing == on_ground)))
            parts += _round(scene, kind, bodies[order[-1]], not on_ground)
    order.append(np.flatnonzero(bodies["kind"] == BOX))
    for body in bodies[order[-1]]:
        parts.append(_flat(box_mesh(scene, body), np.repeat(np.arange(3), 8), ON_OBSTACLES))
    if scene.mesh is not None:
        parts.append(_flat(scene.mesh, MESH, NONE))
    parts += [_flat(wall, FACE_X, ON_WALLS) for wall in wall_meshes(scene)]
    parts.append(_flat(ground_mesh(scene), GROUND, ON_GROUND))
    offsets = np.cumsum([0] + [len(part[0]) for part in parts[:-1]])
    faces = [part[1] + offset for part, offset in zip(parts, offsets, strict=True)]
    first = np.cumsum([0] + [len(part[1]) for part in parts])[: len(bodies) + 1]
    return Drawing(
        np.concatenate([part[0] for part in parts]), np.concatenate(faces), np.concatenate(order), first
    )


def repeat_m(texture: Texture) -> float:
    """After how many metres along either axis `texture` repeats."""
    return texture.period_m * (TILE_PERIODS if texture.pattern == "noise" else 1)


def _flat(part: Part, shape: int | np.ndarray, texture: int) -> Triangles:
    vertices = np.zeros(len(part[0]), VERTEX)
    vertices["position"] = part[0]
    vertices["surface"][:, 0], vertices["surface"][:, 1] = shape, texture
    vertices["body"][:, 0] = part[2]
    return vertices, part[1]


def _round(scene: "Scene", kind: int, bodies: np.ndarray, underside: bool) -> list[Triangles]:
    """The same corners for each of `bodies` (B,), which are all of one `kind`."""
    corners, faces = _template(kind, underside)
    count, size = len(bodies), len(corners)
    radius, half = bodies["rx"], bodies["rz"]
    zero, texture = np.zeros(count), scene.obstacle_texture
    vertices = np.zeros((count, size), VERTEX)
    vertices["position"] = np.stack([bodies["x"], bodies["y"], bodies["z"]], axis=1)[:, None]
    vertices["ring"][..., 0] = corners[:, 0]
    vertices["ring"][..., 1] = corners[:, 1] * (1.0 if kind == ELLIPSOID else radius[:, None])
    vertices["ring"][..., 2] = corners[:, 2] * half[:, None]
    square = radius * radius
    terms = {
        POLE: (square, zero, zero),
        CONE: (0.25 * square, -0.5 * square / half, 0.25 * square / half**2),
        ELLIPSOID: (square, zero, -square / half**2),
    }[kind]
    along = np.array([around(texture, float(r)) for r in radius])
    vertices["quadric"] = np.stack([*terms, along], axis=1)[:, None]
    vertices["surface"][..., 0], vertices["surface"][..., 1] = corners[:, 3], ON_OBSTACLES
    centre = np.stack([bodies["x"], bodies["y"] + bodies["z"]], axis=1)
    vertices["origin"] = np.mod(centre, repeat_m(texture))[:, None]
    up, down = (scene.shade(bodies["albedo"], (0.0, 0.0, z)) for z in (1.0, -1.0))
    level = np.where(corners[:, 2] > 0.0, up[:, None], down[:, None])
    vertices["body"][..., 0] = np.where(corners[:, 3] == RIM, level, bodies["albedo"][:, None])
    vertices["body"][..., 1], vertices["body"][..., 2] = radius[:, None], half[:, None]
    vertices["body"][..., 3] = RING // 4
    return [(part, faces) for part in vertices]


def _template(kind: int, underside: bool) -> Triangles:
    """Corners (V, 4) as angle, radius, height (1: the largest, the half height), shape; and faces (F, 3)."""
    if kind == ELLIPSOID:
        angle = np.arange(OUTLINE) * (2.0 * math.pi / OUTLINE)
        return _ring(angle, mean_radius(OUTLINE), 0.0, DISC), _polygon(OUTLINE, 0, up=True)
    angle = (np.arange(RING) - RING // 2) * (2.0 * math.pi / RING)
    i, j = np.arange(RING), (np.arange(RING) + 1) % RING
    rings = [_ring(angle, 1.0, -1.0, SIDE), _ring(angle, 1.0 if kind == POLE else 0.0, 1.0, SIDE)]
    faces = [np.stack([i, j, RING + i], axis=1)]
    if kind == POLE:
        faces.append(np.stack([j, RING + j, RING + i], axis=1))
        faces.append(_polygon(RING, len(rings) * RING, up=True))
        rings.append(_ring(angle, 1.0, 1.0, RIM))
    if underside:
        faces.append(_polygon(RING, len(rings) * RING, up=False))
        rings.append(_ring(angle, 1.0, -1.0, RIM))
    return np.concatenate(rings), np.concatenate(faces)


def _ring(angle: np.ndarray, radius: float, height: float, shape: int) -> np.ndarray:
    return np.stack([angle, *(np.full_like(angle, value) for value in (radius, height, shape))], axis=1)


def _polygon(corners: int, first: int, up: bool) -> np.ndarray:
    """Triangles of a convex polygon whose corners are numbered counter-clockwise from above.

    Every second corner is cut off, then every second one of what is left: few thin triangles,
    which cost most.
    """
    left, faces = np.arange(corners), []
    while len(left) > 2:
        j = left[1::2]
        i, k = left[::2][: len(j)], np.append(left[2::2], left[0])[: len(j)]
        faces.append(np.stack([i, j, k] if up else [i, k, j], axis=1))
        left = left[::2]
    return first + np.concatenate(faces)
