import dataclasses
import math

import numpy as np
import pytest

from envs.raycast.noise import WAVES, Footprint, mean_noise, waves_of
from envs.raycast.renderer import RaycastRenderer
from envs.scene import Texture, make_scene
from envs.scene.textures import noise_waves


@pytest.mark.parametrize("size", [0.0, 0.1, 30.0])
def test_the_mean_over_a_parallelogram_is_the_sum_of_the_means_of_its_waves(size):
    rng, (cycles, amplitudes) = np.random.default_rng(1), noise_waves(4)
    for _ in range(20):
        s, q = rng.uniform(-1e4, 1e4, 2)
        sides = size * rng.uniform(-1.0, 1.0, (2, 2))
        found = mean_noise(waves_of(4), np.zeros(WAVES, np.float32), s, q, Footprint(*sides.ravel().tolist()))
        weights = np.sinc(cycles @ sides[0]) * np.sinc(cycles @ sides[1])
        turns = np.exp(2j * np.pi * (cycles @ [s % 1.0, q % 1.0]))
        assert found == pytest.approx((turns * amplitudes * weights).real.sum(), abs=1e-5)


def test_sides_of_any_length_leave_a_finite_mean():
    for side in (1e6, 1e12, 1e300):
        mean = mean_noise(waves_of(4), np.zeros(WAVES, np.float32), 0.3, 0.2, Footprint(side, 0.0, 0.0, side))
        assert abs(mean) <= 1.0


@pytest.mark.parametrize(("period_m", "width", "height"), [(0.3, 64, 64), (1.0, 31, 33), (4.0, 64, 64)])
def test_the_tabulated_ground_shows_the_mean_of_a_much_finer_image(period_m, width, height):
    fine = 8
    scene = make_scene("poles", np.random.default_rng(0))
    texture = Texture("noise", period_m, 0.9, (3.0, -1.0), seed=2)
    scene = dataclasses.replace(scene, ground_texture=texture, obstacles=scene.obstacles[:0])
    known, alone = RaycastRenderer(scene, width, height), RaycastRenderer(scene, width, height)
    known.expect_height(2.0)
    for pose in ((1.3, 7.7, 2.0, 0.0, 0.3), (-4.0, 55.5, 2.0, 0.0, 9.0)):
        image = known.render(*pose)
        finer = RaycastRenderer(scene, width * fine, height * fine).render(*pose)
        mean = finer.reshape(height, fine, width, fine).mean(axis=(1, 3))
        ground = slice(height // 2 + 3, None)
        np.testing.assert_allclose(image[ground], mean[ground], atol=3e-2)
        np.testing.assert_allclose(image[ground], alone.render(*pose)[ground], atol=4e-2)
    for other in ((1.3, 7.7, 2.5, 0.0, 0.3), (1.3, 7.7, 2.0, 0.2, 0.3)):
        assert np.array_equal(known.render(*other), alone.render(*other))


@pytest.mark.parametrize("period_m", [0.5, 30.0])
def test_pixels_that_thin_poles_cut_show_the_mean_of_a_finer_image_too(period_m):
    scene, fine = make_scene("poles", np.random.default_rng(0), radius_min_m=0.05, radius_max_m=0.05), 8
    scene = dataclasses.replace(scene, ground_texture=Texture("noise", period_m, 0.9, seed=2))
    pose = (0.7, 5.0, 2.0, 0.0, 0.0)
    known = RaycastRenderer(scene, 64, 64)
    known.expect_height(2.0)
    finer = RaycastRenderer(scene, 64 * fine, 64 * fine).render(*pose).reshape(64, fine, 64, fine)
    error = np.abs(known.render(*pose) - finer.mean(axis=(1, 3)))
    assert error[33:].max() < 0.02


@pytest.mark.parametrize("eye_m", [-1.0, math.nan, math.inf])
def test_an_eye_that_is_nowhere_is_refused(eye_m):
    renderer = RaycastRenderer(make_scene("poles", np.random.default_rng(0)), 16, 16)
    with pytest.raises(ValueError, match="eye_m must be finite and >= 0"):
        renderer.expect_height(eye_m)


def test_the_type_of_a_height_compiles_nothing_again():
    renderer = RaycastRenderer(make_scene("texture_change", np.random.default_rng(0)), 16, 16)
    renderer.expect_height(2)
    assert isinstance(renderer.noise.height, float)
