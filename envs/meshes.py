"""Triangles of a scene's parts with their baked luminance, counter-clockwise seen from outside."""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from envs.scene import Scene

Part = tuple[np.ndarray, np.ndarray, np.ndarray]  # vertices (V, 3) [m], faces (F, 3), luminance (V,)
NEAR_M, FAR_M = 300.0, 1e5  # half-widths of the fine and of the whole ground


def pole_mesh(scene: "Scene", pole: np.void, sections: int) -> Part:
    """Vertices (2n sides, n + 1 cap), faces seen from outside, luminance of one pole."""
    n = sections
    angle = np.arange(n) * (2.0 * np.pi / n)
    normals = np.stack([np.cos(angle), np.sin(angle), np.zeros(n)], axis=1)
    # A little wider than the circle, so that the mean half-width of the prism is the radius.
    wide = pole["rx"] * (np.pi / n) / np.sin(np.pi / n)
    top = (pole["x"], pole["y"], pole["z"] + pole["rz"])
    rim = normals * wide + top
    foot = rim * (1.0, 1.0, 0.0)
    side, cap = scene.shade(pole["albedo"], normals), float(scene.shade(pole["albedo"], (0.0, 0.0, 1.0)))
    i, j = np.arange(n), (np.arange(n) + 1) % n
    faces = [(i, j, n + j), (i, n + j, n + i), (2 * n + i, 2 * n + j, np.full(n, 3 * n))]
    return (
        np.concatenate([foot, rim, rim, [top]]),
        np.concatenate([np.stack(face, axis=1) for face in faces]),
        np.concatenate([side, side, np.full(n + 1, cap)]),
    )


def flat_meshes(scene: "Scene") -> list[Part]:
    """Ground and both walls, each wall once for each side, so that back faces can be culled."""
    quad = np.array([(0, 1, 2), (0, 2, 3)])
    near, far = scene.walls_y_m
    height, half = scene.wall_height_m, 0.5 * scene.width_m
    # Two squares around the origin: one triangle to the horizon would interpolate its depth in
    # float32 so coarsely that the ground hides the feet of the poles.
    corners = np.array([(-1.0, -1.0, 0.0), (1.0, -1.0, 0.0), (1.0, 1.0, 0.0), (-1.0, 1.0, 0.0)])
    i, j = np.arange(4), (np.arange(4) + 1) % 4
    ring = [np.stack(face, axis=1) for face in ((i, 4 + i, 4 + j), (i, 4 + j, j))]
    up = float(scene.shade(scene.ground_albedo, (0.0, 0.0, 1.0)))
    ground = np.concatenate([corners * NEAR_M, corners * FAR_M])
    meshes = [(ground, np.concatenate([quad, *ring]), np.full(8, up))]
    for x in (-half, half):
        wall = np.array([(x, near, 0.0), (x, far, 0.0), (x, far, height), (x, near, height)])
        for normal, faces in ((1.0, quad), (-1.0, quad[:, ::-1])):
            luminance = float(scene.shade(scene.wall_albedo, (normal, 0.0, 0.0)))
            meshes.append((wall, faces, np.full(4, luminance)))
    return meshes
