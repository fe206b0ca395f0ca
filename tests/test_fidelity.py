import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from envs.fidelity import choose_renderer, sub_renders
from envs.raycast import RaycastRenderer
from envs.scene import Scene, make_scene


def test_auto_takes_the_ray_caster_for_what_it_can_draw_and_pyrender_for_the_rest():
    from envs.rasterize import PyrenderRenderer

    scene = make_scene("poles", np.random.default_rng(0))
    strange = scene.obstacles.copy()
    strange["kind"][0] = 9
    other = Scene("hand", strange)
    assert choose_renderer("auto", scene) is RaycastRenderer
    assert choose_renderer("raycast", scene) is RaycastRenderer
    assert choose_renderer("pyrender", scene) is PyrenderRenderer
    assert choose_renderer("auto", other) is PyrenderRenderer
    with pytest.raises(ValueError, match="auto"):
        choose_renderer("raycast", other)
    with pytest.raises(ValueError, match="'blender'"):
        choose_renderer("blender", scene)


@given(st.floats(0.0, 1e3), st.floats(1e-3, 1e3))
def test_parts_are_short_enough_and_as_few_as_that_allows(step_m, max_step_m):
    parts = sub_renders(step_m, max_step_m)
    assert parts >= 1
    assert step_m / parts <= max_step_m * (1 + 2e-9)
    assert parts == 1 or step_m / (parts - 1) > max_step_m


@pytest.mark.parametrize(("hertz", "parts"), [(400, 1), (200, 1), (100, 2), (45, 5)])
def test_the_papers_control_rates_at_twenty_metres_a_second(hertz, parts):
    assert sub_renders(20.0 / hertz, 0.1) == parts


def test_rounding_alone_adds_no_render():
    assert sub_renders(0.1 * 3, 0.1) == 3
    assert sub_renders(0.1 + 1e-17, 0.1) == 1


@pytest.mark.parametrize(
    ("step_m", "max_step_m"), [(-0.1, 0.1), (math.nan, 0.1), (0.1, 0.0), (math.inf, 0.1)]
)
def test_a_step_that_cannot_be_is_refused(step_m, max_step_m):
    with pytest.raises(ValueError, match="max_step_m"):
        sub_renders(step_m, max_step_m)
