import dataclasses
import math

import numpy as np
import pytest

from envs.raycast import RaycastRenderer
from envs.scene import OBSTACLE, Scene, make_scene
from tests.support.point_samples import sample_luminance


def poles(*rows: tuple[float, float, float, float]) -> np.ndarray:
    """(x, y, radius, height) of each pole."""
    made = np.zeros(len(rows), OBSTACLE)
    for pole, (x, y, radius, height) in zip(made, rows, strict=True):
        pole["x"], pole["y"], pole["rx"], pole["ry"] = x, y, radius, radius
        pole["z"] = pole["rz"] = height / 2
        pole["albedo"] = 0.25
    return made


def luminances(scene: Scene) -> tuple[float, float]:
    """Least and most that any surface of the scene can show."""
    albedos = [scene.ground_albedo, scene.wall_albedo, *scene.obstacles["albedo"].tolist()]
    least = min(albedos) * scene.ambient
    return min(least, scene.sky_luminance), max(scene.sky_luminance, max(albedos))


def hard_poses(scene: Scene, rng: np.random.Generator, count: int) -> np.ndarray:
    """(N, 4) poses on walls, on the ground, in, on and over poles, outside, along the axes."""
    pole = scene.obstacles[rng.integers(len(scene.obstacles), size=count)]
    angle = rng.uniform(-np.pi, np.pi, count)
    reach = pole["rx"] * rng.choice([0.0, 0.5, 1.0, 1.0 + 1e-9, 1.0 + 1e-6, 3.0, 40.0], count)
    x = pole["x"] + reach * np.cos(angle)
    y = pole["y"] + reach * np.sin(angle)
    walls = rng.random(count) < 0.2
    x[walls] = rng.choice([-0.5, 0.5, 0.5 + 1e-12, 0.7], walls.sum()) * scene.width_m
    z = rng.choice([0.0, 1e-9, 2.0, 6.0, 8.0, 8.0 + 1e-9, 12.0, 1e4], count)
    yaw = rng.choice([0.0, np.pi, -np.pi, np.pi / 2, -np.pi / 2, 0.3, -2.0], count)
    return np.stack([x, y, z, yaw], axis=1)


def test_every_pose_gives_a_finite_picture_within_the_scenes_luminances():
    rng = np.random.default_rng(0)
    for name in ("poles", "poles_eval"):
        scene = make_scene(name, rng)
        least, most = luminances(scene)
        renderer = RaycastRenderer(scene, 33, 21)
        for pose in hard_poses(scene, rng, 300):
            image = renderer.render(*pose)
            assert image.shape == (21, 33)
            assert image.dtype == np.float32
            assert np.isfinite(image).all(), pose
            assert image.min() >= least - 1e-6, pose
            assert image.max() <= most + 1e-6, pose


@pytest.mark.parametrize(
    "pose", [(0, 0, 2, 0), (5, 20, 2, 0.4), (-8, 40, 3, -0.7), (0, 50, 12, 0.2), (30, 40, 9, 1.4)]
)
def test_the_exact_picture_is_the_mean_of_many_point_samples(pose):
    scene = make_scene("poles", np.random.default_rng(3))
    few, many = (sample_luminance(scene, pose, 16, 16, samples=n) for n in (8, 96))
    two, eight = (RaycastRenderer(scene, 16, 16, samples=n).render(*pose) for n in (2, 8))
    # What is left at 96 x 96 points is their own error at upright edges, 1 / 192 pixel.
    assert np.abs(two - many).mean() < 1.2e-3
    assert np.abs(eight - many).mean() < 1e-3
    assert np.abs(eight - many).max() < 0.015
    assert np.abs(eight - many).mean() < 0.25 * np.abs(few - many).mean()


def test_more_sub_columns_converge():
    scene = make_scene("poles", np.random.default_rng(3))
    one, two, best = (RaycastRenderer(scene, 64, 64, samples=n).render(1, 5, 2, 0.1) for n in (1, 2, 32))
    assert np.abs(two - best).mean() < 0.7 * np.abs(one - best).mean() < 1e-3


def test_the_mirrored_scene_is_the_mirrored_picture():
    rng = np.random.default_rng(4)
    scene = make_scene("poles", rng)
    turned = scene.obstacles.copy()
    turned["x"] *= -1
    mirrored = dataclasses.replace(scene, obstacles=turned, sun=(-scene.sun[0], *scene.sun[1:]))
    for x, y, z, yaw in hard_poses(scene, rng, 50):
        if abs(abs(x) - 15.0) > 1e-6:
            image = RaycastRenderer(scene, 32, 32).render(x, y, z, yaw)
            other = RaycastRenderer(mirrored, 32, 32).render(-x, y, z, -yaw)
            np.testing.assert_allclose(other, image[:, ::-1], atol=2e-5)


def test_a_pole_is_as_wide_and_as_high_as_its_geometry_says():
    scene = Scene("hand", poles((0.0, 10.0, 0.5, 8.0)), wall_height_m=1e-9)
    image = RaycastRenderer(scene, 64, 64, samples=32).render(0.0, 0.0, 2.0)
    dark = image[31] < 0.3
    # Just above the horizon there is sky but for the pole, 2 r / sqrt(d^2 - r^2) wide.
    width = 32.0 * 2.0 * 0.5 / math.sqrt(100.0 - 0.25)
    share = (0.85 - image[31]) / (0.85 - image[31].min())
    assert dark.sum() in (2, 3, 4)
    assert share.sum() == pytest.approx(width, rel=0.12)
    top = 32.0 - 32.0 * 6.0 / 9.5
    rows = (0.85 - image[:32, 31]) / (0.85 - image[31, 31])
    assert rows.sum() == pytest.approx(32.0 - top, abs=0.3)


def test_a_tall_pole_shows_above_a_short_one_and_a_short_one_hides_behind():
    width = {"wall_height_m": 1e-9}
    near = Scene("hand", poles((0.0, 5.0, 0.5, 3.0)), **width)
    both = Scene("hand", poles((0.0, 5.0, 0.5, 3.0), (0.0, 20.0, 0.5, 12.0)), **width)
    hidden = Scene("hand", poles((0.0, 5.0, 0.5, 3.0), (0.0, 20.0, 0.5, 3.0)), **width)
    pictures = [RaycastRenderer(scene, 64, 64).render(0.0, 0.0, 2.0)[:, 32] for scene in (near, both, hidden)]
    # Hidden silhouettes move the points where the shading is taken, by less than 1e-3.
    changed = np.flatnonzero(np.abs(pictures[0] - pictures[1]) > 1e-3)
    # Rows of the far pole: from (12 - 2) / 19.5 above the horizon to the near pole's top.
    assert changed.min() == int(32 - 32 * 10 / 19.5)
    assert changed.max() == int(32 - 32 * 1 / 4.5)
    assert (pictures[1] <= pictures[0] + 1e-3).all()
    np.testing.assert_allclose(pictures[2], pictures[0], atol=1e-3)


def test_a_pole_over_a_wall_is_seen_and_one_behind_a_wall_is_not():
    outside = poles((-20.0, 30.0, 0.5, 8.0), (-20.0, 40.0, 0.5, 2.0))
    empty, full = Scene("hand", outside[:0]), Scene("hand", outside)
    pose = (0.0, 30.0, 2.0, math.pi / 2)
    change = RaycastRenderer(full, 64, 64).render(*pose) - RaycastRenderer(empty, 64, 64).render(*pose)
    rows, columns = np.nonzero(np.abs(change) > 1e-6)
    # The tall pole, straight ahead, between the wall's top (4 / 15) and its own (6 / 19.5).
    assert set(columns) <= {31, 32}
    assert (rows.min(), rows.max()) == (int(32 - 32 * 6 / 19.5), int(32 - 32 * 4 / 15))


def test_from_above_a_pole_shows_its_cap():
    scene = Scene("hand", poles((0.0, 10.0, 2.0, 4.0)))
    cap = float(scene.shade(np.float32(0.25), (0.0, 0.0, 1.0)))
    for pose, row in (((0.0, 0.0, 8.0, 0.0), slice(43, 47)), ((0.0, 10.0, 4.5, 0.0), slice(45, 64))):
        image = RaycastRenderer(scene, 64, 64).render(*pose)
        np.testing.assert_allclose(image[row, 31:33], cap, atol=1e-6)


def test_what_is_seen_from_behind_is_invisible():
    empty = Scene("hand", poles())
    inside = Scene("hand", poles((1.0, 10.0, 0.5, 8.0)))
    pose = (1.1, 10.1, 2.0, 0.3)
    expected = RaycastRenderer(empty, 32, 32).render(*pose)
    assert np.array_equal(RaycastRenderer(inside, 32, 32).render(*pose), expected)


def test_a_whole_turn_changes_nothing():
    renderer = RaycastRenderer(make_scene("poles", np.random.default_rng(1)), 32, 32)
    np.testing.assert_allclose(renderer.render(0, 50, 2, np.pi), renderer.render(0, 50, 2, -np.pi), atol=1e-6)


def test_turning_left_moves_the_picture_right():
    scene = Scene("hand", poles((0.0, 10.0, 0.5, 8.0)), wall_height_m=1e-9)
    image = RaycastRenderer(scene, 64, 64).render(0.0, 0.0, 2.0, 0.3)
    assert image[25].argmin() == pytest.approx(32 + 32 * math.tan(0.3), abs=2)


def test_each_render_is_a_fresh_array_and_set_scene_changes_the_scene():
    renderer = RaycastRenderer(make_scene("poles", np.random.default_rng(1)), 32, 32)
    first = renderer.render(0, 0, 2)
    kept = first.copy()
    renderer.set_scene(make_scene("poles", np.random.default_rng(2)))
    second = renderer.render(0, 0, 2)
    assert np.array_equal(first, kept)
    assert not np.array_equal(first, second)


@pytest.mark.parametrize(
    "pose", [(math.nan, 0, 2, 0), (0, math.inf, 2, 0), (0, 0, -1e-9, 0), (0, 0, 2, math.nan)]
)
def test_a_pose_that_cannot_be_is_refused(pose):
    renderer = RaycastRenderer(Scene("hand", poles()), 8, 8)
    with pytest.raises(ValueError, match="pose"):
        renderer.render(*pose)


def test_a_scene_or_an_image_that_cannot_be_drawn_is_refused():
    triangle = (
        np.array([[0.0, 5.0, 0.0], [1.0, 5.0, 0.0], [0.0, 5.0, 1.0]]),
        np.array([[0, 1, 2]]),
        np.ones(3),
    )
    with pytest.raises(ValueError, match="pyrender"):
        RaycastRenderer(Scene("hand", poles(), mesh=triangle), 8, 8)
    with pytest.raises(ValueError, match="cull_m"):
        RaycastRenderer(Scene("hand", poles()), 8, 8, cull_m=math.nan)
    with pytest.raises(ValueError, match="t_s"):
        RaycastRenderer(Scene("hand", poles()), 8, 8).render(0, 0, 2, t_s=math.inf)
    with pytest.raises(ValueError, match="fov_deg"):
        RaycastRenderer(Scene("hand", poles()), 8, 8, fov_deg=180.0)


def test_pixels_of_one_row_and_one_column_are_possible():
    scene = make_scene("poles", np.random.default_rng(1))
    whole = RaycastRenderer(scene, 2, 2, samples=16).render(0, 0, 2)
    one = RaycastRenderer(scene, 1, 1, samples=32).render(0, 0, 2)
    assert one[0, 0] == pytest.approx(whole.mean(), abs=1e-4)


@pytest.mark.benchmark
def test_a_frame_takes_tens_of_microseconds(benchmark):
    renderer = RaycastRenderer(make_scene("poles", np.random.default_rng(0)), 64, 64)
    benchmark(renderer.render, 0.3, 20.0, 2.0)
