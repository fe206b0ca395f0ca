import dataclasses
import math

import numpy as np
import pytest

from envs.raycast import RaycastRenderer
from envs.scene import BOX, CONE, ELLIPSOID, OBSTACLE, POLE, Scene, Texture
from tests.support.point_samples import sample_luminance

PATTERNS = ("checker", "stripes", "rings", "noise")
POSES = ((0.3, 0.0, 2.0, 0.0), (-4.0, 14.0, 2.5, 0.4), (3.0, 40.0, 1.0, -2.2), (-13.0, 20.0, 5.0, 1.3))
# Largest mean error with 1 and with 4 samples; a tenth or less of what the pattern changes.
BOUNDS = {"ground": (1e-3, 8e-4), "walls": (6e-4, 4e-4), "obstacles": (7.5e-4, 4.2e-4)}


def bodies() -> np.ndarray:
    """Some of each kind, wide enough that their patterns show."""
    made = np.zeros(12, OBSTACLE)
    for k, one in enumerate(made):
        one["kind"] = (POLE, CONE, ELLIPSOID, BOX)[k % 4]
        one["x"], one["y"] = 4.0 * (k % 4) - 6.0 + k // 4, 8.0 + 9.0 * (k // 4)
        one["rx"] = one["ry"] = 1.2
        one["z"] = one["rz"] = 1.5
        one["albedo"] = 0.4
    return made


def world(*, ground: str = "plain", walls: str = "plain", obstacles: str = "plain", t: float = 0.0) -> Scene:
    speed = (1.0, -0.7) if t else (0.0, 0.0)
    return Scene(
        "hand",
        bodies(),
        ground_texture=Texture(ground, 3.0, 0.4, speed, 1),
        wall_texture=Texture(walls, 2.0, 0.2, speed, 2),
        obstacle_texture=Texture(obstacles, 0.9, 0.4, speed, 3),
    )


def errors(scene: Scene, t_s: float = 0.0) -> list[float]:
    """Mean differences from 24 x 24 point samples a pixel with 1 and with 4 samples."""
    truth = np.stack([sample_luminance(scene, pose, 24, 24, samples=24, t_s=t_s) for pose in POSES])
    renderers = [RaycastRenderer(scene, 24, 24, samples=samples) for samples in (1, 4)]
    images = [np.stack([renderer.render(*pose, t_s) for pose in POSES]) for renderer in renderers]
    return [float(np.abs(image - truth).mean()) for image in images]


@pytest.mark.parametrize("name", PATTERNS)
@pytest.mark.parametrize("surface", ["ground", "walls", "obstacles"])
def test_each_pattern_on_each_surface_looks_as_many_point_samples_of_it(surface, name):
    t_s = 1.3  # later than 0: the pattern has moved
    scene = world(**{surface: name}, t=t_s)
    images = [RaycastRenderer(one, 24, 24).render(*POSES[1], t_s) for one in (scene, world())]
    assert np.abs(images[0] - images[1]).mean() > 1e-3  # there is something to see
    one, four = errors(scene, t_s)
    assert one < BOUNDS[surface][0]
    assert four < BOUNDS[surface][1]


@pytest.mark.parametrize(("x", "radius"), [(-4.5, 0.5), (0.0, 0.8), (2.25, 1.2)])
def test_a_pole_straight_ahead_is_as_one_a_hair_beside_it(radius, x):
    # An edge of the pattern is then exactly where a strip begins.
    pole = bodies()[:1]
    pole["x"], pole["y"], pole["rx"], pole["ry"] = x, 8.0, radius, radius
    scene = Scene("hand", pole, obstacle_texture=Texture("stripes", 1.0, 0.5))
    renderer = RaycastRenderer(scene, 16, 16)
    np.testing.assert_allclose(renderer.render(x, 0.0, 2.0), renderer.render(x + 1e-7, 0.0, 2.0), atol=1e-4)


def test_a_wall_seen_at_right_angles_is_averaged_exactly():
    scene = Scene("hand", bodies()[:0], wall_texture=Texture("checker", 2.0, 0.2))
    # From x = 5 the left wall is 20 m away: a pixel shows a rectangle of its (y, z).
    image = RaycastRenderer(scene, 16, 16).render(5.0, 30.3, 2.0, math.pi / 2)
    edges = 20.0 * (np.arange(17) - 8.0) / 8.0

    def means(start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Mean of the square wave of period 2 over each interval, by 20,000 midpoints."""
        inside = start[:, None] + (end - start)[:, None] * (np.arange(20_000) + 0.5) / 20_000
        return (1.0 - 2.0 * (np.floor(inside) % 2.0)).mean(axis=1)

    along = means(30.3 + edges[:-1], 30.3 + edges[1:])  # looking along -x, y grows to the right
    top, bottom = 2.0 - edges[:-1], 2.0 - edges[1:]
    wall = (top <= 6.0) & (bottom >= 0.0)  # rows with nothing but wall
    base = float(scene.shade(scene.wall_albedo, (1.0, 0.0, 0.0)))
    expected = base * (1.0 + 0.2 * means(bottom, top)[:, None] * along[None, :])
    assert wall.sum() >= 1
    np.testing.assert_allclose(image[wall], expected[wall], atol=2e-5)
    # The row that the wall's top cuts: the part of the wall in it, and sky.
    row = int(np.flatnonzero((top > 6.0) & (bottom < 6.0))[0])
    part = (6.0 - bottom[row]) / (top[row] - bottom[row])
    upper = base * (1.0 + 0.2 * means(bottom[row : row + 1], np.array([6.0])) * along)
    np.testing.assert_allclose(image[row], part * upper + (1.0 - part) * scene.sky_luminance, atol=2e-5)


SURFACES = ("ground_texture", "wall_texture", "obstacle_texture")


def test_without_contrast_a_texture_changes_no_byte_and_much_finer_than_a_pixel_it_is_its_mean():
    scene = world()
    without = dict.fromkeys(SURFACES, Texture("noise", 1.0, 0.0))
    fine = [dict.fromkeys(SURFACES, Texture(name, 1e-3, 0.2)) for name in PATTERNS]
    for pose in POSES:
        plain, same, *textured = (
            RaycastRenderer(dataclasses.replace(scene, **looks), 24, 24).render(*pose)
            for looks in ({}, without, *fine)
        )
        assert np.array_equal(same, plain)
        for image in textured:
            assert np.abs(image - plain).max() < 0.01
