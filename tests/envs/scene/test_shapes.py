"""Each shape of `SHAPES` keeps the rules that renderers, collisions and layouts rely on."""

import numpy as np
import pytest

from envs.raycast import RaycastRenderer
from envs.scene import BOX, CONE, ELLIPSOID, OBSTACLE, POLE, Layout, Scene, make_scene
from envs.scene.layouts import draw_obstacles
from envs.scene.shapes import SHAPES, Shape

each_shape = pytest.mark.parametrize("shape", SHAPES)


def layout_of(shape: str, **fields) -> Layout:
    wide = {"num_obstacles": 12, "radius_min_m": 0.4, "radius_max_m": 1.2, "height_m": 5.0, "min_gap_m": 4.0}
    return Layout(shape, **{**wide, **fields})


def inside(body: np.void, points: np.ndarray) -> np.ndarray:
    """Whether points (N, 3) are within a body by more than rounding."""
    x, y, z = (points - (body["x"], body["y"], body["z"])).T
    across, up = np.hypot(x, y) / body["rx"], z / body["rz"]
    shares = {
        POLE: np.maximum(across, abs(up)),
        CONE: np.maximum(across + 0.5 * (up + 1.0), -up),
        ELLIPSOID: np.hypot(across, up),
        BOX: np.maximum(np.maximum(abs(x) / body["rx"], abs(y) / body["ry"]), abs(up)),
    }
    return shares[int(body["kind"])] < 1.0 - 1e-9


@each_shape
def test_the_bodies_of_a_shape_do_not_overlap(shape):
    rng = np.random.default_rng(0)
    bodies = draw_obstacles(layout_of(shape, num_obstacles=3), rng)
    for k, body in enumerate(bodies):
        half = np.array([body["rx"], body["ry"], body["rz"]])
        points = (body["x"], body["y"], body["z"]) + half * rng.uniform(-1, 1, (4000, 3))
        own = points[inside(body, points)]
        assert len(own) > 1000
        assert not any(inside(other, own).any() for i, other in enumerate(bodies) if i != k)


@each_shape
def test_a_shape_stands_on_the_ground_within_the_sizes_that_a_layout_reserves(shape):
    row, radius, height = SHAPES[shape], 0.8, 5.0
    place = (row.kind, 3.0, 20.0, height / 2, radius, radius, height / 2, 0.3)
    bodies = row.compose(np.array([place], OBSTACLE))
    assert (bodies["z"] - bodies["rz"]).min() == pytest.approx(0.0)
    assert (bodies["z"] + bodies["rz"]).max() == pytest.approx(height)
    assert (abs(bodies["x"] - 3.0) + bodies["rx"]).max() == pytest.approx(radius + row.bar_m)
    assert (abs(bodies["y"] - 20.0) + bodies["ry"]).max() <= max(radius, row.half_y_m(radius)) + 1e-9


def test_a_tree_is_hit_at_its_trunk_and_wider_at_its_crown():
    scene = Scene("tree", SHAPES["tree"].compose(np.array([(2, 0, 10, 4, 1, 1, 4, 0.3)], OBSTACLE)))
    low, crown = (scene.first_contact((0, 0), (0, 20), 0.0, height) * 20.0 for height in (1.0, 5.0))
    assert (low, crown) == pytest.approx((10.0 - 0.25, 9.0))


def test_a_row_is_all_that_a_new_shape_needs(monkeypatch):
    def stacked(places):
        both = np.repeat(places, 2)
        both["rz"] *= 0.5
        both["z"] = np.tile([0.5, 1.5], len(places)) * np.repeat(places["rz"], 2)
        return both

    monkeypatch.setitem(SHAPES, "stack", Shape(BOX, stacked, half_y_m=lambda radius_m: radius_m))
    scene = make_scene("poles", np.random.default_rng(0), shape="stack", min_gap_m=2.5)
    assert len(scene.obstacles) == 80
    picture = RaycastRenderer(scene, 32, 32).render(0.0, 0.0, 2.0)
    whole = make_scene("poles", np.random.default_rng(0), shape="box", min_gap_m=2.5)
    assert picture == pytest.approx(RaycastRenderer(whole, 32, 32).render(0.0, 0.0, 2.0), abs=1e-6)
