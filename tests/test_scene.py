import dataclasses
import math
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.scene import LAYOUTS, OBSTACLE, Scene, make_scene

metres = st.floats(-20.0, 20.0)


def scene_of(*discs: tuple[float, float, float], width_m: float = 30.0) -> Scene:
    poles = np.zeros(len(discs), OBSTACLE)
    for pole, (x, y, radius) in zip(poles, discs, strict=True):
        pole["x"], pole["y"], pole["rx"], pole["ry"], pole["z"], pole["rz"] = x, y, radius, radius, 4.0, 4.0
        pole["albedo"] = 0.25
    return Scene("hand", poles, width_m=width_m)


def clearance(scene: Scene, points: np.ndarray) -> np.ndarray:
    """Distance from each point (N, 2) to the nearest surface, negative inside."""
    obstacles = scene.obstacles
    apart = np.hypot(points[:, :1] - obstacles["x"], points[:, 1:] - obstacles["y"]) - obstacles["rx"]
    return np.minimum(apart.min(axis=1, initial=np.inf), scene.width_m / 2 - np.abs(points[:, 0]))


@pytest.mark.parametrize("name", LAYOUTS)
def test_the_same_seed_gives_the_same_bytes(name):
    one, same, other = (make_scene(name, np.random.default_rng(seed)) for seed in (5, 5, 6))
    assert one.obstacles.tobytes() == same.obstacles.tobytes()
    assert one.obstacles.tobytes() != other.obstacles.tobytes()


@pytest.mark.parametrize("name", LAYOUTS)
def test_poles_keep_their_gap_and_stay_in_the_lane(name):
    for seed in range(20):
        scene = make_scene(name, np.random.default_rng(seed))
        poles, layout = scene.obstacles, LAYOUTS[name]
        gaps = np.hypot(poles["x"][:, None] - poles["x"], poles["y"][:, None] - poles["y"])
        assert len(poles) == layout.num_poles
        assert (gaps[~np.eye(len(poles), dtype=bool)] >= layout.min_gap_m).all()
        assert (np.abs(poles["x"]) + poles["rx"] <= scene.width_m / 2).all()
        assert ((poles["y"] >= 10.0) & (poles["y"] <= 100.0)).all()
        assert (poles["z"] == poles["rz"]).all()


@pytest.mark.parametrize("name", LAYOUTS)
def test_flying_straight_usually_fails(name):
    rng = np.random.default_rng(0)
    scenes = [make_scene(name, rng) for _ in range(200)]
    starts = rng.uniform(-10.0, 10.0, 200)
    hits = [scene.collides((x, 0.0), (x, 100.0), 0.3) for scene, x in zip(scenes, starts, strict=True)]
    assert 0.7 < np.mean(hits) < 1.0


@pytest.mark.parametrize(
    ("name", "overrides", "message"),
    [
        ("caves", {}, "poles_eval"),
        ("poles", {"pole_count": 3}, "num_poles"),
        ("poles", {"num_poles": 2000}, "cannot be placed"),
        ("poles", {"num_poles": 2.5}, "whole number"),
        ("poles", {"num_poles": True}, "must be a number"),
        ("poles", {"height_m": math.nan}, "must be a number"),
        ("poles", {"min_gap_m": 0.9}, "min_gap_m"),
        ("poles", {"radius_min_m": 0.0}, "radius_min_m"),
        ("poles", {"width_m": 10}, "width_m"),
    ],
)
def test_a_layout_that_cannot_be_is_refused_by_name(name, overrides, message):
    with pytest.raises(ValueError, match=message):
        make_scene(name, np.random.default_rng(0), **overrides)


def test_overrides_replace_values_of_the_layout():
    scene = make_scene("poles", np.random.default_rng(0), num_poles=3.0, radius_max_m=0.9, width_m=40)
    assert len(scene.obstacles) == 3
    assert scene.width_m == 40.0
    assert scene.obstacles["rx"].min() < scene.obstacles["rx"].max() <= 0.9


def test_a_scene_cannot_be_changed_and_survives_pickling():
    scene = scene_of((0.0, 10.0, 0.5))
    with pytest.raises(ValueError, match="read-only"):
        scene.obstacles["x"] = 1.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        scene.width_m = 1.0
    again = pickle.loads(pickle.dumps(scene))
    assert again.first_contact((0.0, 0.0), (0.0, 20.0), 0.5) == scene.first_contact(
        (0.0, 0.0), (0.0, 20.0), 0.5
    )
    with pytest.raises(ValueError, match="OBSTACLE"):
        Scene("hand", np.zeros(3))


@settings(max_examples=300, deadline=None)
@given(
    discs=st.lists(st.tuples(metres, metres, st.floats(0.01, 3.0)), max_size=4),
    a=st.tuples(metres, metres),
    b=st.tuples(metres, metres),
    radius=st.floats(0.0, 2.0),
)
def test_first_contact_agrees_with_dense_samples_of_the_segment(discs, a, b, radius):
    scene = scene_of(*discs)
    contact = scene.first_contact(a, b, radius)
    fractions = np.linspace(0.0, 1.0, 2001)
    points = np.asarray(a) + fractions[:, None] * (np.asarray(b) - np.asarray(a))
    room = clearance(scene, points) - radius
    assert scene.collides(a, b, radius) == (contact <= 1.0)
    assert contact == math.inf or 0.0 <= contact <= 1.0
    assert (room[fractions < contact] > -1e-9).all()
    if contact <= 1.0:
        at = np.asarray([a]) + contact * (np.asarray([b]) - np.asarray(a))
        assert clearance(scene, at)[0] <= radius + 1e-9


@settings(max_examples=200, deadline=None)
@given(
    angle=st.floats(-math.pi, math.pi),
    length=st.floats(-9.0, 6.0).map(lambda exponent: 10.0**exponent),
    before=st.floats(0.0, 1.0),
)
def test_contact_is_exact_from_a_nanometre_to_a_thousand_kilometres(angle, length, before):
    # Head-on, from outside: contact is the gap that is left, as a fraction of the way.
    scene = scene_of((0.0, 0.0, 0.5), width_m=1e9)
    gap = length * before
    ahead = np.array([math.cos(angle), math.sin(angle)])
    a = -(0.8 + gap) * ahead
    contact = scene.first_contact(a, a + length * ahead, 0.3)
    # Coordinates near 1 m, or near the length, carry rounding of that size themselves.
    assert contact == pytest.approx(before, abs=1e-15 * max(1.0, length) * 8 / length, rel=1e-9) or (
        contact == math.inf and before > 1.0 - 1e-14 * max(1.0, length) / length
    )


def test_touching_counts_and_a_miss_by_little_does_not():
    scene = scene_of((0.0, 10.0, 0.5))
    assert scene.first_contact((1.0, 0.0), (1.0, 20.0), 0.5) == pytest.approx(0.5)
    assert scene.first_contact((1.0 + 1e-12, 0.0), (1.0 + 1e-12, 20.0), 0.5) == math.inf
    assert scene.first_contact((0.0, 9.0), (0.0, 8.0), 0.5) == 0.0
    assert scene.first_contact((0.0, 10.0), (0.0, 10.0), 0.0) == 0.0
    assert scene.first_contact((0.0, 0.0), (14.5, 0.0), 0.5) == 1.0
    assert scene.first_contact((0.0, 0.0), (14.5 - 1e-12, 0.0), 0.5) == math.inf
    assert scene.first_contact((0.0, 0.0), (-29.0, 0.0), 0.5) == pytest.approx(0.5)
    assert scene.first_contact((5.0, 0.0), (5.0, 0.0), 0.5) == math.inf


def test_a_step_without_contact_never_ends_where_the_next_begins_in_contact():
    scene = make_scene("poles", np.random.default_rng(1))
    rng = np.random.default_rng(2)
    for _ in range(2000):
        pole = scene.obstacles[rng.integers(len(scene.obstacles))]
        angle, start = rng.uniform(0, 2 * np.pi), rng.uniform((-14, 36), (14, 64))
        end = (pole["x"] + 0.8 * np.cos(angle), pole["y"] + 0.8 * np.sin(angle))
        if scene.first_contact(end, end, 0.3) == 0.0:
            assert scene.collides(start, end, 0.3)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_flight_to_nowhere_is_refused(bad):
    scene = scene_of()
    for a, b, radius in (((0, bad), (0, 1), 0.3), ((0, 0), (bad, 1), 0.3), ((0, 0), (0, 1), bad)):
        with pytest.raises(ValueError, match="finite"):
            scene.first_contact(a, b, radius)
    with pytest.raises(ValueError, match="radius"):
        scene.first_contact((0, 0), (0, 1), -0.1)


def test_the_mesh_is_one_part_whose_normals_point_out_of_the_poles():
    scene = make_scene("poles", np.random.default_rng(0), num_poles=7)
    parts = scene.to_trimesh(sections=16).dump()
    assert len(parts) == 1
    mesh = parts[0]
    pole = scene.obstacles[0]
    centres = mesh.triangles_center[:32] - (pole["x"], pole["y"], 0.0)
    assert ((centres * mesh.face_normals[:32])[:, :2].sum(axis=1) > 0).all()
    assert (mesh.face_normals[32:48, 2] > 0.99).all()
    luminance = mesh.vertex_attributes["luminance"]
    assert luminance.dtype == np.float32
    assert np.abs(mesh.visual.vertex_colors[:, 0] / 255.0 - luminance).max() < 0.5 / 255 + 1e-6
    # The prism is as wide as the circle on average, so area errors have no sign.
    sides = np.hypot(*(mesh.vertices[:16, :2] - (pole["x"], pole["y"])).T)
    assert sides == pytest.approx(pole["rx"] * (np.pi / 16) / np.sin(np.pi / 16))


def test_surfaces_follow_the_law_of_lambert():
    scene = scene_of()
    assert scene.shade(0.5, scene.sun) == pytest.approx(0.5)
    assert scene.shade(0.5, [-s for s in scene.sun]) == pytest.approx(0.5 * scene.ambient)
    assert np.linalg.norm(scene.sun) == pytest.approx(1.0)
