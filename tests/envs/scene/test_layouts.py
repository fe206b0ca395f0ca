import dataclasses
import math

import numpy as np
import pytest

from envs.scene import BOX, LAYOUTS, Layout, Texture
from envs.scene.layouts import MeshLayout, draw_obstacles, with_overrides
from envs.scene.obstacles import body_sections
from envs.scene.shapes.gate import BAR_M

LANES = {name: layout for name, layout in LAYOUTS.items() if isinstance(layout, Layout)}
ROUND = [name for name, layout in LANES.items() if layout.shape != "gate"]


def draw(name, seed=0, **overrides):
    layout = with_overrides(LAYOUTS[name], overrides)
    return draw_obstacles(layout, np.random.default_rng(seed))


def test_the_scenes_of_the_appendix_are_there():
    assert {"poles", "cones", "gates", "poles_dense", "poles_eval"} < set(LAYOUTS)
    assert {"shape_change", "texture_change", "dynamic"} < set(LAYOUTS)
    assert LAYOUTS["poles"].width_m == 30.0
    assert LAYOUTS["poles_eval"].width_m > 30.0
    assert LAYOUTS["poles_dense"].num_obstacles > LAYOUTS["poles"].num_obstacles


@pytest.mark.parametrize("name", ROUND)
def test_obstacles_keep_their_gap_and_stay_in_the_lane(name):
    for seed in range(20):
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
    assert (bodies["kind"] == BOX).all()
    assert len(bodies) == 4 * layout.num_obstacles
    left, right, lintel, sill = bodies.reshape(-1, 4).T
    inside = right["x"] - right["rx"] - (left["x"] + left["rx"])
    assert inside == pytest.approx(2 * lintel["rx"])
    assert ((inside >= 2 * layout.radius_min_m) & (inside <= 2 * layout.radius_max_m)).all()
    assert left["x"] + left["rx"] == pytest.approx(lintel["x"] - lintel["rx"])
    assert lintel["z"] + lintel["rz"] == pytest.approx(layout.height_m)
    for post in (left, right):
        assert post["z"] - post["rz"] == pytest.approx(0.0)
        assert post["z"] + post["rz"] == pytest.approx(layout.height_m)
    assert sill["z"] - sill["rz"] == pytest.approx(0.0)
    assert (lintel["z"] - lintel["rz"] > sill["z"] + sill["rz"]).all()
    assert (bodies["ry"] == BAR_M / 2).all()
    assert (bodies["albedo"].reshape(-1, 4) == left["albedo"][:, None]).all()
    assert (np.abs(bodies["x"]) + bodies["rx"] <= layout.width_m / 2).all()


def test_bodies_of_gates_never_overlap():
    for seed in range(10):
        bodies = draw("gates", seed)
        apart = [
            np.abs(bodies[k][:, None] - bodies[k]) >= bodies[r][:, None] + bodies[r] - 1e-9
            for k, r in (("x", "rx"), ("y", "ry"), ("z", "rz"))
        ]
        assert (apart[0] | apart[1] | apart[2])[~np.eye(len(bodies), dtype=bool)].all()


def test_a_gate_is_open_at_the_height_of_the_camera():
    sections = body_sections(draw("gates"), 2.0)
    assert len(sections) == 2 * LAYOUTS["gates"].num_obstacles


@pytest.mark.parametrize("name", ["shape_change", "texture_change"])
def test_a_change_of_looks_leaves_the_places_that_can_be_flown_through(name):
    ours, poles = body_sections(draw(name, 7), 2.0), body_sections(draw("poles_eval", 7), 2.0)
    assert ours == pytest.approx(poles, abs=1e-12)


@pytest.mark.parametrize("name", ["cones", "dynamic"])
def test_cones_are_as_wide_as_poles_where_the_camera_flies(name):
    assert body_sections(draw(name), 2.0)[:, 6] == pytest.approx(0.5)


def test_only_texture_change_and_dynamic_are_not_plain():
    def plain(layout):
        return layout.ground_texture.plain and layout.wall_texture.plain and layout.obstacle_texture.plain

    assert {name for name, layout in LANES.items() if not plain(layout)} == {"texture_change", "dynamic"}
    changed = LAYOUTS["texture_change"]
    textures = (changed.ground_texture, changed.wall_texture, changed.obstacle_texture)
    assert [texture.plain for texture in textures] == [False] * 3
    assert LAYOUTS["dynamic"].obstacle_texture.velocity_mps != (0.0, 0.0)
    assert LAYOUTS["dynamic"].shape != "pole"


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
        ({"shape": 3}, "shape must be a str"),
        ({"num_obstacles": 2.5}, "num_obstacles must be a whole number, got num_obstacles=2.5"),
        ({"num_obstacles": -1}, "num_obstacles must be a number in"),
        ({"height_m": math.inf}, "height_m must be a number in"),
        ({"height_m": 0.0}, "height_m"),
        ({"wall_height_m": 0}, "wall_height_m"),
        ({"min_gap_m": 0.9}, "min_gap_m must be >= 1,.*min_gap_m=0.9"),
        ({"radius_min_m": 0.0}, "radius_min_m"),
        ({"radius_min_m": 0.6}, "radius_min_m=0.6, radius_max_m=0.5"),
        ({"width_m": 20}, "width_m"),
        (
            {"width_m": 30, "radius_min_m": 15.0, "radius_max_m": 15.0, "min_gap_m": 30},
            "width_m must be .* 30",
        ),
        ({"first_y_m": 101.0}, "first_y_m"),
        ({"albedo_min": 0.5}, "albedo_min"),
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


def test_an_unknown_key_is_refused_with_those_that_are_known():
    with pytest.raises(ValueError, match=r"has no 'heigth_m'; it has .* height_m"):
        with_overrides(LAYOUTS["poles"], {"heigth_m": 3.0})
    with pytest.raises(ValueError, match="has no 'shape'; it has scale, "):
        with_overrides(MeshLayout(), {"shape": "pole"})


@pytest.mark.parametrize(
    "overrides",
    [
        {"num_obstacles": 2000},
        {"num_obstacles": 100_000},
        {"min_gap_m": 15},
        {"first_y_m": 50, "last_y_m": 50, "min_gap_m": 3},
    ],
)
def test_more_than_fits_is_refused_quickly(overrides):
    with pytest.raises(ValueError, match=r"cannot be placed .* lower num_obstacles or min_gap_m, or widen"):
        draw("poles", **overrides)


def test_no_obstacles_are_possible():
    assert draw("poles", num_obstacles=0).shape == draw("gates", num_obstacles=0).shape == (0,)


def test_layouts_are_values():
    assert dataclasses.replace(LAYOUTS["poles"], num_obstacles=80) == LAYOUTS["poles_dense"]
    assert (
        with_overrides(LAYOUTS["poles"], {"obstacle_texture": Texture("rings", contrast=0.2)})
        != LAYOUTS["poles"]
    )
