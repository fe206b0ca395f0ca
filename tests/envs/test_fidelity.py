import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from envs.config import CameraConfig, EnvConfig, FidelityConfig
from envs.fidelity import choose_renderer, make_renderer, plan_renders, sub_renders
from envs.raycast import RaycastRenderer
from envs.scene import Scene, make_scene

SCENE = make_scene("poles", np.random.default_rng(0))
TRIANGLE = (
    np.array([[0.0, 50.0, 0.0], [1.0, 50.0, 0.0], [0.0, 50.0, 3.0]]),
    np.array([[0, 1, 2]]),
    np.full(3, 0.5),
)
MESH = dataclasses.replace(SCENE, mesh=TRIANGLE)


def renders(config, scene=SCENE):
    return sub_renders(config.speed_mps / config.control_hz, plan_renders(config, scene).max_step_m)


def test_auto_takes_the_ray_caster_for_what_it_can_draw_and_pyrender_for_the_rest():
    assert choose_renderer("auto", SCENE) == "raycast"
    assert choose_renderer("auto", MESH) == "pyrender"
    assert choose_renderer("raycast", SCENE) == "raycast"
    assert choose_renderer("pyrender", SCENE) == "pyrender"
    with pytest.raises(ValueError, match=r"cannot draw the mesh.*'auto'"):
        choose_renderer("raycast", MESH)


def test_a_stricter_tolerance_never_takes_less():
    tolerances = [1.0, 0.3, 0.1, 0.05, 0.02, 0.01, 1e-3]
    plans = [plan_renders(EnvConfig(fidelity=FidelityConfig(tolerance)), SCENE) for tolerance in tolerances]
    ways, samples = [p.max_step_m for p in plans], [p.samples for p in plans]
    assert ways == sorted(ways, reverse=True)
    assert samples == sorted(samples)
    assert ways[0] > 2 * ways[-1]
    shifts = [p.max_shifts_px for p in plans]
    assert shifts == sorted(shifts, reverse=True)
    assert samples[0] < samples[-1]


def test_longer_steps_and_textures_take_more_renders():
    textured = make_scene("texture_change", np.random.default_rng(0))
    slow, fast = EnvConfig(control_hz=45.0), EnvConfig(control_hz=200.0)
    assert renders(slow, textured) > renders(fast, textured) > renders(fast)
    assert renders(slow) == renders(fast) == 1  # of plain scenes only columns in which something moves


def test_outlines_may_move_less_where_a_small_error_shows_more():
    usual = plan_renders(EnvConfig(), SCENE).max_shifts_px
    assert usual.upright > usual.level > usual.bent > 0.0
    sharp = EnvConfig(camera=CameraConfig(width=256, height=256))
    strict = EnvConfig(fidelity=FidelityConfig(0.01))
    blind = EnvConfig(camera=CameraConfig(contrast_threshold=0.5))
    for config in (sharp, strict, blind):
        assert all(np.array(plan_renders(config, SCENE).max_shifts_px) < usual)
    shorter = plan_renders(EnvConfig(control_hz=400.0), SCENE).max_shifts_px
    assert shorter.bent < usual.bent
    assert shorter[:2] == usual[:2]


def test_a_step_of_more_than_two_time_constants_of_a_slow_pixel_takes_two_renders():
    for cutoff_hz, least in ((0.0, 1), (30.0, 1), (300.0, 2)):
        assert renders(EnvConfig(camera=CameraConfig(cutoff_hz=cutoff_hz))) == least


def test_a_short_lane_is_drawn_whole_and_a_long_one_as_far_as_the_tolerance_asks():
    lane = make_scene("poles", np.random.default_rng(0), last_y_m=400.0, num_obstacles=150)
    empty = dataclasses.replace(SCENE, obstacles=SCENE.obstacles[:0])
    assert [plan_renders(EnvConfig(), scene).cull_m for scene in (SCENE, empty)] == [math.inf, math.inf]
    usual = plan_renders(EnvConfig(), lane).cull_m
    assert 100.0 < usual < 200.0
    for scene in (lane, SCENE):
        assert plan_renders(EnvConfig(fidelity=FidelityConfig(0.2)), scene).cull_m == pytest.approx(
            0.5 * usual
        )


def test_round_bodies_and_patterns_take_more_samples_and_both_together_the_most():
    def samples(name, **fields):
        return plan_renders(EnvConfig(**fields), make_scene(name, np.random.default_rng(0))).samples

    plain, gates, patterns, cones, ellipsoids, both = (
        samples(name) for name in ("poles", "gates", "texture_change", "cones", "shape_change", "dynamic")
    )
    assert plain == gates < min(patterns, cones, ellipsoids)
    assert max(patterns, cones, ellipsoids) < both
    assert cones == ellipsoids
    # pyrender samples points: what edges need does not depend on what the ray caster's do.
    assert samples("poles", renderer="pyrender") == samples("dynamic", renderer="pyrender") > plain


@given(st.floats(0.0, 1e3), st.floats(1e-3, 1e3))
def test_parts_are_short_enough_and_as_few_as_that_allows(step_m, max_step_m):
    parts = sub_renders(step_m, max_step_m)
    assert parts >= 1
    assert step_m / parts <= max_step_m * (1 + 2e-9)
    assert parts == 1 or step_m / (parts - 1) > max_step_m


def test_rounding_alone_adds_no_render():
    assert sub_renders(0.1 * 3, 0.1) == 3
    assert sub_renders(0.1 + 1e-17, 0.1) == 1
    assert sub_renders(5.0, math.inf) == 1


def test_a_plan_makes_a_renderer_that_sees_nothing_beyond_the_culling_distance():
    plan = plan_renders(EnvConfig(fidelity=FidelityConfig(cull_m=20.0, samples=3)), SCENE)
    kept = SCENE.obstacles[np.hypot(SCENE.obstacles["x"], SCENE.obstacles["y"]) - 0.5 <= 20.0]
    assert 0 < len(kept) < len(SCENE.obstacles)
    near, only = (
        make_renderer(plan, SCENE, 64, 48, 90.0),
        RaycastRenderer(Scene("near", kept), 64, 48, samples=3),
    )
    np.testing.assert_array_equal(near.render(0.0, 0.0, 2.0), only.render(0.0, 0.0, 2.0))
