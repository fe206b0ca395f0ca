import math

import numpy as np
import pytest

from envs.scene import LAYOUTS, Layout
from envs.scene.layouts import draw_obstacles, with_overrides
from envs.scene.obstacles import body_sections


def draw(name, seed=0, **overrides):
    layout = with_overrides(LAYOUTS[name], overrides)
    return draw_obstacles(layout, np.random.default_rng(seed))


@pytest.mark.parametrize("name", ["poles_dense", "shape_change", "dynamic"])
def test_obstacles_keep_their_gap_and_stay_in_the_lane(name):
    for seed in range(8):
        bodies, layout = draw(name, seed), LAYOUTS[name]
        gaps = np.hypot(bodies["x"][:, None] - bodies["x"], bodies["y"][:, None] - bodies["y"])
        assert len(bodies) == layout.num_obstacles
        assert (gaps[~np.eye(len(bodies), dtype=bool)] >= layout.min_gap_m).all()
        assert (np.abs(bodies["x"]) + bodies["rx"] <= layout.width_m / 2).all()
        assert ((bodies["y"] >= 10.0) & (bodies["y"] <= 100.0)).all()
        assert (bodies["z"] == bodies["rz"]).all()
        assert (2 * bodies["rz"] == layout.height_m).all()


def test_a_gate_is_a_frame_around_an_opening():
    bodies, layout = draw("gates"), LAYOUTS["gates"]
    left, right, lintel, sill = bodies.reshape(-1, 4).T
    inside = right["x"] - right["rx"] - (left["x"] + left["rx"])
    assert inside == pytest.approx(2 * lintel["rx"])
    assert ((inside >= 2 * layout.radius_min_m) & (inside <= 2 * layout.radius_max_m)).all()
    assert left["x"] + left["rx"] == pytest.approx(lintel["x"] - lintel["rx"])
    assert lintel["z"] + lintel["rz"] == pytest.approx(layout.height_m)
    for post in (left, right):
        assert post["z"] - post["rz"] == pytest.approx(sill["z"] - sill["rz"])
        assert post["z"] + post["rz"] == pytest.approx(layout.height_m)
    assert (np.abs(bodies["x"]) + bodies["rx"] <= layout.width_m / 2).all()
    assert len(body_sections(bodies, 2.0)) == 2 * layout.num_obstacles, "open where the camera flies"


@pytest.mark.parametrize("name", ["shape_change", "texture_change"])
def test_a_change_of_looks_leaves_the_places_that_can_be_flown_through(name):
    ours, poles = body_sections(draw(name, 7), 2.0), body_sections(draw("poles_eval", 7), 2.0)
    assert ours == pytest.approx(poles, abs=1e-12)


@pytest.mark.parametrize("name", ["cones", "dynamic"])
def test_cones_are_as_wide_as_poles_where_the_camera_flies(name):
    assert body_sections(draw(name), 2.0)[:, 6] == pytest.approx(0.5)


def test_radii_and_albedos_fill_their_ranges():
    bodies = draw("poles", radius_min_m=0.2, radius_max_m=0.8, albedo_min=0.1, albedo_max=0.9)
    for values, low, high in ((bodies["rx"], 0.2, 0.8), (bodies["albedo"], 0.1, 0.9)):
        assert low <= values.min() < low + 0.2 * (high - low)
        assert high - 0.2 * (high - low) < values.max() <= high
    assert (bodies["rx"] == bodies["ry"]).all()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"shape": "torus"}, r"shape must be one of .*'pole'.*got shape='torus'"),
        ({"num_obstacles": 2.5}, "num_obstacles must be a whole number, got num_obstacles=2.5"),
        ({"num_obstacles": -1}, "num_obstacles must be a number in"),
        ({"num_obstacles": True}, "num_obstacles must be a number in"),
        ({"height_m": math.inf}, "height_m must be a number in"),
        ({"wall_height_m": 0}, "wall_height_m"),
        ({"min_gap_m": 0.9}, "min_gap_m must be >= 1,.*min_gap_m=0.9"),
        ({"radius_min_m": 0.6}, "radius_min_m=0.6, radius_max_m=0.5"),
        ({"width_m": 20}, "width_m"),
        ({"width_m": 30, "radius_max_m": 15.0, "min_gap_m": 30}, "width_m must be .* 30"),
        ({"first_y_m": 101.0}, "first_y_m"),
        ({"albedo_max": 1.1}, "albedo_max"),
        ({"passable": 1.0}, "passable must be true or false"),
        ({"wall_texture": "checker"}, "wall_texture must be a Texture"),
        ({"shape": "gate", "height_m": 0.8}, "height_m of a gate"),
        ({"shape": "gate", "radius_max_m": 1.0}, "min_gap_m must be >= 2.8"),
    ],
)
def test_a_layout_that_cannot_be_is_refused_with_its_rule_and_its_values(fields, message):
    with pytest.raises(ValueError, match=message) as refusal:
        Layout(**fields)
    assert len(str(refusal.value).splitlines()) == 1
    with pytest.raises(ValueError, match=message):
        with_overrides(LAYOUTS["poles"], fields)


def test_more_than_fits_is_refused_quickly_and_none_is_possible():
    for overrides in ({"num_obstacles": 100_000}, {"first_y_m": 50, "last_y_m": 50, "min_gap_m": 3}):
        with pytest.raises(
            ValueError, match=r"cannot be placed .* lower num_obstacles or min_gap_m, or widen"
        ):
            draw("poles", **overrides)
    assert draw("poles", num_obstacles=0).shape == draw("gates", num_obstacles=0).shape == (0,)
