"""Triangles of a scene with baked luminance, counter-clockwise seen from outside.

Vertices are split at the edges of a surface, so that flat faces are flat and round sides
smooth. Textures are not baked: the triangles show every surface in its mean luminance.
"""

import math
from typing import TYPE_CHECKING

import numpy as np

from envs.scene.obstacles import BOX, CONE, ELLIPSOID, POLE
from envs.scene.scene import Scene

if TYPE_CHECKING:
    import trimesh

Part = tuple[np.ndarray, np.ndarray, np.ndarray]  # vertices (V, 3) [m], faces (F, 3), luminance (V,)
NEAR_M, FAR_M = 300.0, 1e5  # half-widths of the fine and of the whole ground
QUAD = np.array([(0, 1, 2), (0, 2, 3)])


def to_trimesh(scene: Scene, sections: int = 32) -> "trimesh.Scene":
    """Return the scene as one merged mesh; a level section of a round body has `sections` corners.

    Vertices carry their baked luminance twice: as grey `vertex_colors` (8 bits) and exactly, as float32,
    in `vertex_attributes["luminance"]`. Textures are not baked: a surface has its mean luminance. The ground
    ends 100 km away.
    """
    import trimesh  # slow to load; only this function needs it

    vertices, faces, luminance = scene_mesh(scene, sections)
    grey = np.clip(np.rint(luminance * 255.0), 0, 255).astype(np.uint8)
    colors = np.stack([grey, grey, grey, np.full_like(grey, 255)], axis=1)
    mesh = trimesh.Trimesh(vertices, faces, vertex_colors=colors, process=False)
    mesh.vertex_attributes["luminance"] = luminance.astype(np.float32)
    return trimesh.Scene([mesh])


def scene_mesh(scene: Scene, sections: int = 32) -> Part:
    """Return `scene` as one mesh: obstacles, ground, both sides of the walls, its own mesh.

    Args:
        scene: The scene to triangulate.
        sections: Corners of a horizontal section of a round body, at least 3. The section's mean radius is
            the body's radius; with 32 corners its silhouette is off by up to 0.3 % of the radius.

    Returns:
        Vertices (V, 3) float64 [m], faces (F, 3) int64, luminance (V,) float64. The ground is a
        square that ends 100 km away.
    """
    parts = [body_mesh(scene, body, sections) for body in scene.obstacles]
    parts += [ground_mesh(scene), *wall_meshes(scene)]
    if scene.mesh is not None:
        parts.append(scene.mesh)
    return join(parts)


def join(parts: list[Part]) -> Part:
    """Join meshes; an empty list gives an empty mesh."""
    parts = [(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros(0)), *parts]
    offsets = np.cumsum([0] + [len(part[0]) for part in parts[:-1]])
    return (
        np.concatenate([part[0] for part in parts]),
        np.concatenate([part[1] + offset for part, offset in zip(parts, offsets, strict=True)]),
        np.concatenate([part[2] for part in parts]),
    )


def body_mesh(scene: Scene, body: np.void, sections: int) -> Part:
    """Return one obstacle, closed from all sides; see `envs.scene.obstacles` for the kinds."""
    if body["kind"] == BOX:
        return box_mesh(scene, body)
    height = float(body["rz"])
    if body["kind"] == ELLIPSOID:
        latitude = np.linspace(-0.5 * math.pi, 0.5 * math.pi, sections // 2 + 1)
        grow = mean_radius(2 * (sections // 2))
        return _lathe(scene, body, np.cos(latitude) * grow, np.sin(latitude) * grow, sections)
    if body["kind"] == CONE:
        # Rings lie closer near the apex, because the luminance changes around the axis, not along it.
        radii = np.array([1.0, 0.5, 0.25, 0.125, 0.0])
        side = _lathe(scene, body, radii, 1.0 - 2.0 * radii, sections)
        return join([side, _disc(scene, body, -height, sections)])
    assert body["kind"] == POLE  # noqa: S101  a kind that this module lacks
    side = _lathe(scene, body, np.ones(2), np.array([-1.0, 1.0]), sections)
    return join([side, _disc(scene, body, height, sections), _disc(scene, body, -height, sections)])


def box_mesh(scene: Scene, box: np.void) -> Part:
    """Return the six faces of a box, each with its own four corners, in the order x-, x+, y-, y+, z-, z+."""
    centre = np.array([box["x"], box["y"], box["z"]])
    half = np.array([box["rx"], box["ry"], box["rz"]])
    parts = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            normal, one, other = np.zeros(3), np.zeros(3), np.zeros(3)
            normal[axis] = side
            one[(axis + 1) % 3], other[(axis + 2) % 3] = side, 1.0  # one x other = normal
            signs = normal + np.array([-one - other, one - other, one + other, other - one])
            light = float(scene.shade(box["albedo"], normal))
            parts.append((centre + half * signs, QUAD, np.full(4, light)))
    return join(parts)


def ground_mesh(scene: Scene) -> Part:
    """Return the ground, z = 0, as two squares around the origin.

    One triangle to the horizon would interpolate its depth in float32 so coarsely that the
    ground hides the feet of the obstacles.
    """
    corners = np.array([(-1.0, -1.0, 0.0), (1.0, -1.0, 0.0), (1.0, 1.0, 0.0), (-1.0, 1.0, 0.0)])
    i, j = np.arange(4), (np.arange(4) + 1) % 4
    ring = [np.stack(face, axis=1) for face in ((i, 4 + i, 4 + j), (i, 4 + j, j))]
    up = float(scene.shade(scene.ground_albedo, (0.0, 0.0, 1.0)))
    return np.concatenate([corners * NEAR_M, corners * FAR_M]), np.concatenate([QUAD, *ring]), np.full(8, up)


def wall_meshes(scene: Scene) -> list[Part]:
    """Return each wall twice, once for each side, so that back faces can be culled."""
    near, far = scene.walls_y_m
    height, half = scene.wall_height_m, 0.5 * scene.width_m
    meshes = []
    for x in (-half, half):
        wall = np.array([(x, near, 0.0), (x, far, 0.0), (x, far, height), (x, near, height)])
        for normal, faces in ((1.0, QUAD), (-1.0, QUAD[:, ::-1])):
            luminance = float(scene.shade(scene.wall_albedo, (normal, 0.0, 0.0)))
            meshes.append((wall, faces, np.full(4, luminance)))
    return meshes


def mean_radius(corners: int) -> float:
    """Return how much wider than its circle a regular polygon must be for their mean radii to agree."""
    return (math.pi / corners) / math.sin(math.pi / corners)


def _lathe(scene: Scene, body: np.void, radii: np.ndarray, heights: np.ndarray, sections: int) -> Part:
    """Return the round side of `body` through rings (M,) of `radii` at `heights`, -1 (bottom) to 1."""
    n, m = sections, len(radii)
    centre = np.array([body["x"], body["y"], body["z"]])
    half = np.array([body["rx"], body["rx"], body["rz"]])
    # The corners of a ring of radius 0 are turned by half a step, to the middle of their triangles.
    angle = (np.arange(n) + 0.5 * (radii[:, None] < 1e-9)) * (2.0 * math.pi / n)
    across = np.stack([np.cos(angle), np.sin(angle)], axis=2)  # (M, n, 2)
    level = np.broadcast_to(heights[:, None, None], (m, n, 1))
    unit = np.concatenate([across * (radii * mean_radius(n))[:, None, None], level], axis=2)
    if body["kind"] == ELLIPSOID:
        normals = unit / half
    else:
        slope = (radii[0] - radii[-1]) / (heights[-1] - heights[0]) * half[0] / half[2]
        normals = np.concatenate([across, np.full((m, n, 1), slope)], axis=2)
    normals = normals / np.linalg.norm(normals, axis=2, keepdims=True)
    i, j = np.arange(n), (np.arange(n) + 1) % n
    faces = []
    for k in range(m - 1):
        low, high = k * n, (k + 1) * n
        if radii[k] >= 1e-9:
            faces.append(np.stack([low + i, low + j, high + i], axis=1))
        if radii[k + 1] >= 1e-9:
            faces.append(np.stack([low + (j if radii[k] >= 1e-9 else i), high + j, high + i], axis=1))
    light = scene.shade(body["albedo"], normals).ravel()
    return (unit * half + centre).reshape(-1, 3), np.concatenate(faces), light


def _disc(scene: Scene, body: np.void, height_m: float, sections: int) -> Part:
    """Return the level face of `body` at `height_m` above its centre; a negative height faces down."""
    n = sections
    angle = np.arange(n) * (2.0 * math.pi / n)
    rim = np.stack([np.cos(angle), np.sin(angle), np.zeros(n)], axis=1) * body["rx"] * mean_radius(n)
    i, j = np.arange(n), (np.arange(n) + 1) % n
    up = height_m > 0.0
    faces = np.stack([i, j, np.full(n, n)] if up else [j, i, np.full(n, n)], axis=1)
    light = float(scene.shade(body["albedo"], (0.0, 0.0, 1.0 if up else -1.0)))
    centre = np.array([body["x"], body["y"], body["z"] + height_m])
    return np.concatenate([rim, np.zeros((1, 3))]) + centre, faces, np.full(n + 1, light)
