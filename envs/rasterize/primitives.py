"""A scene as vertices and triangles for the shaders of `envs.rasterize.shaders`.

Flat faces, the ground, the walls and a scene's own mesh are as in `envs.scene.triangles`. A round
body is a few rings of corners around its centre; the vertex shader turns them towards the camera.
"""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from envs.rasterize.shaders import DISC, FACE, GROUND, MESH, OUTLINE, RIM, RING, SIDE, WALL
from envs.scene import BOX, CONE, ELLIPSOID, POLE, Texture
from envs.scene.textures import TILE_PERIODS, around
from envs.scene.triangles import Part, box_mesh, ground_mesh, wall_meshes

if TYPE_CHECKING:
    from envs.scene import Scene

# The attributes of `shaders.VERTEX`, in the same order.
VERTEX = np.dtype(
    [
        ("position", "f4", 3),
        ("ring", "f4", 3),
        ("quadric", "f4", 4),
        ("origin", "f4", 2),
        ("body", "f4", 4),
    ]
)


class Piece(NamedTuple):
    """Triangles of one kind of surface, of obstacle number `body`; -1: of no obstacle."""

    surface: int
    body: int
    vertices: np.ndarray  # (V,) VERTEX
    faces: np.ndarray  # (F, 3)


class Batch(NamedTuple):
    """Consecutive faces of one kind of surface.

    Attributes:
        surface: Kind of surface, an index in `shaders.SURFACES`.
        bodies: (N,) the obstacles of the faces, in order; -1: no obstacle.
        first: (N + 1,) first face of each obstacle, and the first face after the batch.
    """

    surface: int
    bodies: np.ndarray
    first: np.ndarray


class Drawing(NamedTuple):
    """The triangles of a scene, counter-clockwise seen from outside.

    Attributes:
        vertices: (V,) VERTEX.
        faces: (F, 3) int64.
        batches: Batches in the order of drawing.
    """

    vertices: np.ndarray
    faces: np.ndarray
    batches: list[Batch]


def draw(scene: "Scene") -> Drawing:
    """Return the triangles of `scene`."""
    bodies = scene.obstacles
    pieces: list[Piece] = []
    standing = bodies["z"] <= bodies["rz"]  # their undersides are hidden
    for kind in (POLE, CONE, ELLIPSOID):
        for on_ground in (True, False):
            found = np.flatnonzero((bodies["kind"] == kind) & (standing == on_ground))
            pieces += _round(scene, kind, found, not on_ground)
    for i in np.flatnonzero(bodies["kind"] == BOX):
        pieces.append(_flat(FACE, box_mesh(scene, bodies[i]), int(i)))
        pieces[-1].vertices["body"][:, 3] = np.repeat(np.arange(3), 8)
    if scene.mesh is not None:
        pieces.append(_flat(MESH, scene.mesh))
    pieces += [_flat(WALL, wall) for wall in wall_meshes(scene)]
    pieces.append(_flat(GROUND, ground_mesh(scene)))
    return _join(sorted(pieces, key=lambda piece: piece.surface))


def _join(pieces: list[Piece]) -> Drawing:
    """Join pieces, sorted by surface, into one drawing."""
    offsets = np.cumsum([0] + [len(piece.vertices) for piece in pieces])
    first = np.cumsum([0] + [len(piece.faces) for piece in pieces])
    surfaces = np.array([piece.surface for piece in pieces])
    bodies = np.array([piece.body for piece in pieces])
    batches = []
    for surface in np.unique(surfaces).tolist():
        low, high = np.searchsorted(surfaces, [surface, surface + 1])
        batches.append(Batch(surface, bodies[low:high], first[low : high + 1]))
    faces = [piece.faces + offset for piece, offset in zip(pieces, offsets, strict=False)]
    return Drawing(np.concatenate([piece.vertices for piece in pieces]), np.concatenate(faces), batches)


def repeat_m(texture: Texture) -> float:
    """Return the distance after which `texture` repeats along each axis [m]."""
    return texture.period_m * (TILE_PERIODS if texture.pattern == "noise" else 1)


def _flat(surface: int, part: Part, body: int = -1) -> Piece:
    vertices = np.zeros(len(part[0]), VERTEX)
    vertices["position"], vertices["body"][:, 0] = part[0], part[2]
    return Piece(surface, body, vertices, part[1])


def _round(scene: "Scene", kind: int, found: np.ndarray, underside: bool) -> list[Piece]:
    """Return the surfaces of the obstacles `found` (B,), all of one `kind`."""
    pieces = []
    for surface, corners, faces in _templates(kind, underside):
        vertices = _vertices(scene, kind, scene.obstacles[found], corners)
        if surface == RIM:
            up, down = (scene.shade(scene.obstacles["albedo"][found], (0.0, 0.0, z)) for z in (1.0, -1.0))
            vertices["body"][..., 0] = np.where(corners[:, 2] > 0.0, up[:, None], down[:, None])
        pieces += [Piece(surface, int(i), part, faces) for i, part in zip(found, vertices, strict=True)]
    return pieces


def _vertices(scene: "Scene", kind: int, bodies: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return (B, V) VERTEX, the `corners` (V, 3) of each of `bodies`."""
    radius, half = bodies["rx"], bodies["rz"]
    zero, texture = np.zeros(len(bodies)), scene.obstacle_texture
    vertices = np.zeros((len(bodies), len(corners)), VERTEX)
    vertices["position"] = np.stack([bodies["x"], bodies["y"], bodies["z"]], axis=1)[:, None]
    vertices["ring"][..., 0] = corners[:, 0]
    vertices["ring"][..., 1] = corners[:, 1] * radius[:, None]
    vertices["ring"][..., 2] = corners[:, 2] * half[:, None]
    square = radius * radius
    terms = {
        POLE: (square, zero, zero),
        CONE: (0.25 * square, -0.5 * square / half, 0.25 * square / half**2),
        ELLIPSOID: (square, zero, -square / half**2),
    }[kind]
    along = np.array([around(texture, float(r)) for r in radius])
    vertices["quadric"] = np.stack([*terms, along], axis=1)[:, None]
    centre = np.stack([bodies["x"], bodies["y"] + bodies["z"]], axis=1)
    vertices["origin"] = np.mod(centre, repeat_m(texture))[:, None]
    for i, key in enumerate(("albedo", "rx", "rz")):
        vertices["body"][..., i] = bodies[key][:, None]
    return vertices


def _templates(kind: int, underside: bool) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """Return a body's surfaces: kind; corners (V, 3) as number, radius and height <= 1; faces (F, 3)."""
    if kind == ELLIPSOID:
        return [(DISC, _ring(np.arange(OUTLINE), 1.0, 0.0), _polygon(OUTLINE, up=True))]
    corner, i, j = np.arange(RING) - RING // 2, np.arange(RING), (np.arange(RING) + 1) % RING
    bottom, top = _ring(corner, 1.0, -1.0), _ring(corner, 1.0 if kind == POLE else 0.0, 1.0)
    side = [np.stack([i, j, RING + i], axis=1)]
    if kind == POLE:
        side.append(np.stack([j, RING + j, RING + i], axis=1))
    found = [(SIDE, np.concatenate([bottom, top]), np.concatenate(side))]
    if kind == POLE:
        found.append((RIM, top, _polygon(RING, up=True)))
    if underside:
        found.append((RIM, bottom, _polygon(RING, up=False)))
    return found


def _ring(corner: np.ndarray, radius: float, height: float) -> np.ndarray:
    return np.stack([corner, np.full(len(corner), radius), np.full(len(corner), height)], axis=1)


def _polygon(corners: int, up: bool) -> np.ndarray:
    """Return the triangles of a convex polygon whose corners are numbered counter-clockwise from above.

    It cuts off every second corner, then every second corner of the rest, and so on. This gives few thin
    triangles, which cost most.
    """
    left, faces = np.arange(corners), []
    while len(left) > 2:
        j = left[1::2]
        i, k = left[::2][: len(j)], np.append(left[2::2], left[0])[: len(j)]
        faces.append(np.stack([i, j, k] if up else [i, k, j], axis=1))
        left = left[::2]
    return np.concatenate(faces)
