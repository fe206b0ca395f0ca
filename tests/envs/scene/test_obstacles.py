import math

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.scene import BOX, CONE, ELLIPSOID, OBSTACLE, POLE, obstacles
from envs.scene.obstacles import body_sections, checked_mesh, checked_obstacles, mesh_sections


def body(kind, x=1.0, y=2.0, z=3.0, rx=0.5, ry=0.5, rz=2.0, albedo=0.25):
    return np.array([(kind, x, y, z, rx, ry, rz, albedo)], OBSTACLE)


def solid(kind, record):
    """The same body from trimesh's own primitives."""
    x, y, z, rx, ry, rz = (float(record[0][key]) for key in ("x", "y", "z", "rx", "ry", "rz"))
    if kind == BOX:
        mesh = trimesh.creation.box((2 * rx, 2 * ry, 2 * rz))
    elif kind == POLE:
        mesh = trimesh.creation.cylinder(rx, 2 * rz, sections=180)
    elif kind == CONE:
        mesh = trimesh.creation.cone(rx, 2 * rz, sections=180)
        mesh.apply_translation((0.0, 0.0, -rz))
    else:
        mesh = trimesh.creation.icosphere(4)
        mesh.apply_scale((rx, ry, rz))
    mesh.apply_translation((x, y, z))
    return mesh


def area(section):
    hx, hy, r = section[4:]
    return 4 * hx * hy + 4 * (hx + hy) * r + math.pi * r * r


@pytest.mark.parametrize("kind", [POLE, CONE, ELLIPSOID, BOX])
@settings(max_examples=8)
@given(height=st.floats(1.05, 4.95), ry=st.floats(0.1, 2.0))
def test_a_section_has_the_area_that_a_plane_cuts_from_a_mesh_of_the_body(kind, height, ry):
    record = body(kind, ry=ry if kind == BOX else 0.5)
    (section,) = body_sections(record, height)
    ends = trimesh.intersections.mesh_plane(solid(kind, record), (0, 0, 1), (0, 0, height))[:, :, :2] - (1, 2)
    cut = 0.5 * np.abs(ends[:, 0, 0] * ends[:, 1, 1] - ends[:, 0, 1] * ends[:, 1, 0]).sum()
    assert area(section) == pytest.approx(cut, rel=0.01, abs=2e-3)
    assert tuple(section[:4]) == (1.0, 2.0, 1.0, 0.0)


@settings(max_examples=60)
@given(z=st.floats(-1e3, 1e3), rz=st.floats(1e-6, 1e3), share=st.floats(-1.0, 1.0))
def test_rounding_never_makes_a_section_wider_than_its_body(z, rz, share):
    for kind in (CONE, ELLIPSOID):
        sections = body_sections(body(kind, z=z, rz=rz), z + share * rz)
        assert (sections[:, 6] <= 0.5).all()
        assert np.isfinite(sections).all()


@settings(max_examples=15)
@given(height=st.floats(-1.2, 1.2), seed=st.integers(0, 1000))
def test_a_mesh_is_cut_as_trimesh_cuts_it(height, seed):
    mesh = trimesh.creation.icosphere(2)
    mesh.vertices += 0.05 * np.random.default_rng(seed).standard_normal(mesh.vertices.shape)
    ours = mesh_sections(mesh.vertices, mesh.faces, height)
    theirs = trimesh.intersections.mesh_plane(mesh, (0, 0, 1), (0, 0, height))
    assert len(ours) == len(theirs)
    assert 2 * ours[:, 4].sum() == pytest.approx(
        np.linalg.norm(theirs[:, 0] - theirs[:, 1], axis=1).sum(), abs=1e-9
    )
    if len(theirs):
        middles = theirs[:, :, :2].mean(axis=1)
        apart = np.hypot(*(ours[:, None, :2] - middles[None]).transpose(2, 0, 1)).min(axis=1)
        assert apart.max() < 1e-9


@pytest.mark.parametrize(
    ("lifts", "lengths"),
    [
        ((0, 0, 0), [3.0, 4.0, 5.0]),
        ((0, 0, 4), [4.0]),
        ((0, 1, 5), [0.0]),
        ((0, 1, -1), [2.5]),
        ((1, 1, 1), []),
    ],
    ids=["lies in it", "has an edge in it", "has a corner in it", "is cut through a corner", "is above it"],
)
def test_faces_that_only_touch_the_plane_count(lifts, lengths):
    triangle = np.array([(0.0, 0.0, 1.0), (4.0, 0.0, 1.0), (0.0, 3.0, 1.0)])
    triangle[:, 2] += lifts
    found = mesh_sections(triangle, np.array([[0, 1, 2]]), 1.0)
    assert found.shape == (len(lengths), 7)
    assert sorted(2 * found[:, 4]) == pytest.approx(lengths)
    if lengths == [0.0]:
        assert found.tolist() == [[0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0]], "an edge without length is a point"
    assert mesh_sections(triangle, np.empty((0, 3), np.int64), 1.0).shape == (0, 7)


def test_neighbouring_faces_give_the_same_point_on_their_common_edge_bit_for_bit(monkeypatch):
    monkeypatch.setattr(obstacles, "edge_sections", lambda a_m, b_m: np.concatenate([a_m, b_m]))
    rng = np.random.default_rng(0)
    for _ in range(50):
        vertices = rng.normal(size=(4, 3))
        vertices[:2, 2] = (-0.3, 0.7)
        ends = [mesh_sections(vertices, np.array([face]), 0.0) for face in ((0, 1, 2), (1, 0, 3))]
        assert set(map(tuple, ends[0])) & set(map(tuple, ends[1]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": 4}, "kind must be below 4"),
        ({"x": math.nan}, "finite"),
        ({"rx": 0.0}, "must be > 0"),
        ({"ry": 0.6}, "rx must equal ry"),
        ({"albedo": -0.1}, "albedo"),
        ({"albedo": 0.84}, "albedo.*contrast"),
    ],
)
def test_a_record_that_cannot_be_is_named(changes, message):
    records = np.concatenate([body(POLE), body(BOX, ry=0.6), body(POLE)])
    for key, value in changes.items():
        records[key][2] = value
    with pytest.raises(ValueError, match=f"(?s){message}.*record 2"):
        checked_obstacles(records, contrast=0.2)
    assert len(checked_obstacles(body(POLE, albedo=0.8), contrast=0.25)) == 1, "it may just reach one"


def test_a_mesh_that_cannot_be_is_refused_and_a_good_one_is_kept_unchangeable():
    vertices, faces, luminance = np.eye(3), np.array([[0, 1, 2]]), np.full(3, 0.5)
    kept = checked_mesh(vertices, faces, luminance)
    vertices[0, 0] = 9.0
    assert kept[0][0, 0] == 1.0
    assert not any(array.flags.writeable for array in kept)
    for bad in (
        (np.eye(2), faces, luminance),
        (np.eye(3), faces, luminance[:2]),
        (np.eye(3), faces + 1, luminance),
        (np.eye(3), -faces, luminance),
        (np.eye(3), faces * 1.0, luminance),
        (np.eye(3) * math.nan, faces, luminance),
        (np.eye(3), faces, luminance + 1.0),
        (np.eye(3), faces, luminance * math.nan),
    ):
        with pytest.raises(ValueError, match="mesh"):
            checked_mesh(*bad)
