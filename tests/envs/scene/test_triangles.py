import math

import numpy as np
import pytest
import trimesh

from envs.scene import BOX, CONE, ELLIPSOID, OBSTACLE, POLE, Scene
from envs.scene.obstacles import KINDS
from envs.scene.triangles import body_mesh, scene_mesh, to_trimesh

BODIES = np.array(
    [
        (POLE, 1.0, 20.0, 4.0, 0.5, 0.5, 4.0, 0.25),
        (CONE, -4.0, 30.0, 3.0, 0.8, 0.8, 2.0, 0.5),
        (ELLIPSOID, 5.0, 25.0, 3.0, 1.0, 1.0, 2.5, 0.4),
        (BOX, 0.0, 40.0, 5.0, 2.0, 0.25, 0.5, 0.3),
    ],
    OBSTACLE,
)
VOLUMES = {
    POLE: lambda b: math.pi * b["rx"] ** 2 * 2 * b["rz"],
    CONE: lambda b: math.pi * b["rx"] ** 2 * 2 * b["rz"] / 3,
    ELLIPSOID: lambda b: 4 / 3 * math.pi * b["rx"] ** 2 * b["rz"],
    BOX: lambda b: 8 * b["rx"] * b["ry"] * b["rz"],
}
SCENE = Scene(name="test", obstacles=BODIES)
each_body = pytest.mark.parametrize("body", BODIES, ids=KINDS)


def solid(body: np.void, sections: int) -> trimesh.Trimesh:
    """The body with its split vertices joined again."""
    vertices, faces, _ = body_mesh(SCENE, body, sections)
    return trimesh.Trimesh(vertices.round(9), faces, process=True)


@each_body
def test_a_body_is_closed_and_seen_from_outside(body):
    mesh = solid(body, 32)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    outwards = mesh.triangles_center - (body["x"], body["y"], body["z"])
    assert ((outwards * mesh.face_normals).sum(axis=1) > 0).all()


@each_body
def test_the_volume_of_a_body_converges_to_that_of_its_shape_with_the_square_of_the_sections(body):
    truth = VOLUMES[body["kind"]](body)
    coarse, fine = (abs(solid(body, n).volume / truth - 1) for n in (32, 64))
    if body["kind"] == BOX:
        assert max(coarse, fine) < 1e-9
    else:
        assert coarse < 1e-2
        assert coarse / fine == pytest.approx(4, rel=0.1)


def true_normals(body: np.void, points: np.ndarray) -> np.ndarray:
    """Normals of the sides of the true shape, at the azimuth (and latitude) of `points`."""
    x, y, z = points.T
    if body["kind"] == ELLIPSOID:
        normals = np.stack([x, y, z * (body["rx"] / body["rz"]) ** 2], axis=1)
    else:
        slope = 0.5 * body["rx"] / body["rz"] if body["kind"] == CONE else 0.0
        normals = np.stack([x, y, slope * np.hypot(x, y)], axis=1)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


@each_body
def test_the_luminance_of_a_vertex_is_lamberts_of_the_true_normal(body):
    vertices, faces, luminance = body_mesh(SCENE, body, 32)
    local = vertices - (body["x"], body["y"], body["z"])
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    flat = np.abs(mesh.face_normals).max(axis=1) > 1 - 1e-9
    for face, normal in zip(faces[flat], mesh.face_normals[flat], strict=True):
        if body["kind"] == BOX or abs(normal[2]) > 0.5:
            assert luminance[face] == pytest.approx(float(SCENE.shade(body["albedo"], normal)), abs=1e-9)
    if body["kind"] != BOX:
        round_faces = faces[np.abs(mesh.face_normals[:, 2]) < 1 - 1e-9]
        on_side = np.unique(round_faces)
        on_side = on_side[np.hypot(*local[on_side, :2].T) > 1e-6]
        truth = SCENE.shade(body["albedo"], true_normals(body, local[on_side]))
        np.testing.assert_allclose(luminance[on_side], truth, atol=1e-9)


def test_the_mesh_of_a_scene_holds_every_part_once_and_its_own_mesh_as_it_is():
    own = (np.array([[0.0, 50, 0], [1, 50, 0], [0, 50, 3]]), np.array([[0, 1, 2]]), np.array([0.1, 0.2, 0.3]))
    scene = Scene(name="test", obstacles=BODIES, mesh=own)
    vertices, faces, luminance = scene_mesh(scene, 16)
    np.testing.assert_array_equal(vertices[faces[-1]], own[0])
    np.testing.assert_array_equal(luminance[faces[-1]], own[2])
    assert len(faces) == sum(len(body_mesh(scene, body, 16)[1]) for body in BODIES) + 10 + 8 + 1
    sides = np.hypot(*(vertices[:16, :2] - (1.0, 20.0)).T)  # a prism, on average as wide as its pole
    np.testing.assert_allclose(sides, 0.5 * (np.pi / 16) / np.sin(np.pi / 16))
    mesh = to_trimesh(scene, 16).dump()[0]
    np.testing.assert_array_equal(mesh.vertex_attributes["luminance"], luminance.astype(np.float32))
    assert np.abs(mesh.visual.vertex_colors[:, 0] / 255.0 - luminance).max() < 0.5 / 255 + 1e-6
    assert len(scene_mesh(Scene(name="empty", obstacles=BODIES[:0]))[1]) == 18
