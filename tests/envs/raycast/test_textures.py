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
    plain = dataclasses.replace(
        scene, ground_texture=Texture(), wall_texture=Texture(), obstacle_texture=Texture()
    )
    images = [RaycastRenderer(one, 24, 24).render(*POSES[1], t_s) for one in (scene, plain)]
    assert np.abs(images[0] - images[1]).mean() > 1e-3  # there is something to see
    one, four = errors(scene, t_s)
    assert one < BOUNDS[surface][0]
    assert four < BOUNDS[surface][1]


def test_more_samples_come_closer_to_a_checkered_world():
    scene = world(ground="checker", walls="checker", obstacles="checker")
    one, four = errors(scene)
    assert four < one < 0.0015


@pytest.mark.parametrize("radius", [0.5, 0.8, 1.2])
@pytest.mark.parametrize("x", [-4.5, -1.0, 0.0, 2.25])
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


@pytest.mark.parametrize("name", PATTERNS)
def test_a_ground_that_moves_is_a_camera_that_moves_back(name):
    moving = Texture(name, 3.0, 0.4, (1.5, -2.0), 1)
    scene = Scene("hand", bodies()[:0], wall_height_m=1e-9, width_m=1e5, ground_texture=moving)
    renderer = RaycastRenderer(scene, 32, 32)
    np.testing.assert_allclose(
        renderer.render(4.0, 10.0, 2.0, 0.3, 2.0), renderer.render(1.0, 14.0, 2.0, 0.3, 0.0), atol=1e-6
    )
    assert (
        np.abs(renderer.render(4.0, 10.0, 2.0, 0.3, 0.3) - renderer.render(4.0, 10.0, 2.0, 0.3)).max() > 0.02
    )


def test_after_a_whole_period_a_moving_world_looks_the_same():
    scene = world(ground="checker", walls="stripes", obstacles="rings")
    speeds = {"ground_texture": (3.0, 6.0), "wall_texture": (-2.0, 0.0), "obstacle_texture": (0.0, 0.9)}
    moving = {key: dataclasses.replace(getattr(scene, key), velocity_mps=v) for key, v in speeds.items()}
    renderer = RaycastRenderer(dataclasses.replace(scene, **moving), 32, 32)
    still = RaycastRenderer(scene, 32, 32)
    for pose in POSES:
        np.testing.assert_allclose(renderer.render(*pose, 7.0), still.render(*pose), atol=2e-5)
        assert np.abs(renderer.render(*pose, 7.3) - still.render(*pose)).max() > 0.01


def test_without_contrast_a_texture_changes_no_byte():
    faint = {
        key: Texture("noise", 1.0, 0.0) for key in ("ground_texture", "wall_texture", "obstacle_texture")
    }
    scene = world()
    for pose in POSES:
        plain = RaycastRenderer(scene, 32, 32).render(*pose)
        assert np.array_equal(
            RaycastRenderer(dataclasses.replace(scene, **faint), 32, 32).render(*pose), plain
        )


@pytest.mark.parametrize("name", PATTERNS)
def test_a_pattern_much_finer_than_a_pixel_is_its_mean(name):
    fine = {key: Texture(name, 1e-3, 0.2) for key in ("ground_texture", "wall_texture", "obstacle_texture")}
    scene = world()
    for pose in POSES:
        plain = RaycastRenderer(scene, 24, 24).render(*pose)
        textured = RaycastRenderer(dataclasses.replace(scene, **fine), 24, 24).render(*pose)
        assert np.abs(textured - plain).max() < 0.01


def test_all_that_is_textured_stays_within_the_contrast():
    scene = world(ground="checker", walls="noise", obstacles="rings")
    plain = world()
    black = {"ground_albedo": 0.0, "wall_albedo": 0.0, "sky_luminance": 0.0}
    for pose in POSES:
        full = RaycastRenderer(scene, 32, 32).render(*pose)
        bare = RaycastRenderer(plain, 32, 32).render(*pose)
        assert (full <= 1.4 * bare + 1e-6).all()
        assert (full >= 0.6 * bare - 1e-6).all()
        dark = RaycastRenderer(dataclasses.replace(scene, **black), 32, 32).render(*pose)
        assert dark.min() >= -1e-9
