import dataclasses
import itertools
import math

import numpy as np
import pytest

from envs.raycast import RaycastRenderer
from envs.scene import BOX, CONE, ELLIPSOID, OBSTACLE, POLE, Scene, Texture, make_scene
from tests.support.point_samples import sample_luminance

KINDS = (POLE, CONE, ELLIPSOID, BOX)
AHEAD = ((0.3, 0.0, 2.0, 0.0), (-4.0, 30.0, 2.0, 0.2), (6.0, 55.0, 1.0, -0.5), (0.0, 60.0, 2.0, 3.0))
ABOVE = ((0.0, 20.0, 9.0, 0.3), (3.0, 40.0, 5.0, -0.7), (2.0, 30.0, 40.0, 1.0))


def body(kind: int, x: float, y: float, z: float, rx: float, rz: float, **more: float) -> np.ndarray:
    """One obstacle around (x, y, z), as a record."""
    made = np.zeros(1, OBSTACLE)
    values = {"kind": kind, "x": x, "y": y, "z": z, "rx": rx, "ry": rx, "rz": rz, "albedo": 0.4, **more}
    for key, value in values.items():
        made[key] = value
    return made


def forest(kinds: tuple[int, ...], rng: np.random.Generator, count: int = 40, **scene: object) -> Scene:
    """Bodies of the kinds in turn, apart from each other: a third floats, a sixth is sunk."""
    made = []
    for k in range(count):
        x, y = rng.uniform(-1.0, 1.0) + 3.5 * (k % 8 - 3.5), 10.0 + 3.0 * (k // 8) * 40 / count * 2
        rx, rz = rng.uniform(0.4, 1.0), rng.uniform(0.5, 3.0)
        lift = rng.choice([0.0, 0.0, 0.0, 0.5, 1.5, -0.5 * rz])
        shape = {"ry": rng.uniform(0.4, 1.0)} if kinds[k % len(kinds)] == BOX else {}
        made.append(
            body(kinds[k % len(kinds)], x, y, rz + lift, rx, rz, albedo=rng.uniform(0.1, 0.6), **shape)
        )
    return Scene("forest", np.concatenate(made), **scene)


def errors(scene: Scene, pose: tuple, *samples: int) -> np.ndarray:
    """(len(samples), 20, 24) differences from 24 x 24 point samples a pixel."""
    truth = sample_luminance(scene, pose, 24, 20, samples=24)
    exact = [RaycastRenderer(scene, 24, 20, samples=n).render(*pose) for n in samples]
    return np.abs(np.stack(exact) - truth)


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_looks_as_many_point_samples_of_it(kind):
    scene = forest((kind,), np.random.default_rng(0))
    found = np.stack([errors(scene, pose, 1, 6) for pose in AHEAD + ABOVE])
    found, finer = found[:, 0], found[:, 1]
    assert found.mean() < 2e-3
    assert np.quantile(found, 0.99) < 0.05
    # What is left at 24 x 24 points is their own error at upright edges, 1 / 48 pixel.
    assert finer.mean() < 6e-4
    assert finer.max() < 0.03


def test_all_kinds_together_and_gates_hide_each_other_rightly():
    rng = np.random.default_rng(5)
    for scene in (forest(KINDS, rng, 60), make_scene("gates", rng)):
        found = np.stack([errors(scene, pose, 4) for pose in AHEAD + ABOVE])
        assert found.mean() < 7e-4
        assert found.max() < 0.05


@pytest.mark.parametrize("kind", KINDS)
def test_of_bodies_above_each_other_the_one_nearer_in_height_hides_the_other(kind):
    tower = [body(kind, 0.3, 8.0, 0.5, 2.5, 0.5), body(kind, 0.0, 8.2, 3.5, 1.5, 0.5, albedo=0.6)]
    scene, turned = (Scene("tower", np.concatenate(order)) for order in (tower, tower[::-1]))
    for pose in itertools.product((0.0,), (0.0, 6.0), (0.0, 2.0, 5.0, 9.0), (0.1,)):
        assert errors(scene, pose, 8).mean() < 1.5e-3, pose
        images = [RaycastRenderer(one, 24, 20, samples=8).render(*pose) for one in (scene, turned)]
        assert np.abs(images[0] - images[1]).max() < 1e-6, pose


@pytest.mark.parametrize("kind", KINDS)
def test_a_body_is_seen_from_close_above_and_below_and_beside_its_slope(kind):
    scene = Scene("one", body(kind, 0.2, 5.0, 4.0, 1.5, 1.0))
    poses = [(0.0, y, z, 0.4) for z in (0.0, 2.9, 5.1, 7.0) for y in (3.0, 4.2, 5.0)]
    for pose in [
        *poses,
        (0.0, 4.0, 4.6, 0.1),
    ]:  # the last: within the circle of a cone's base, above its side
        assert errors(scene, pose, 8).mean() < 2e-3, pose


def test_a_cone_ends_at_its_outline_or_at_the_far_edge_of_its_base():
    scene = Scene("one", body(CONE, 0.0, 5.0, 2.0, 2.0, 2.0))
    for pose in ((0.0, 2.0, 8.0, 0.0), (0.0, 2.5, 6.0, 0.1), (0.5, 2.8, 5.0, 0.0), (0.0, -3.0, 3.0, 0.0)):
        image = RaycastRenderer(scene, 24, 24, 160.0, samples=6).render(*pose)
        assert np.abs(image - sample_luminance(scene, pose, 24, 24, 160.0, samples=32)).max() < 0.01


@pytest.mark.parametrize("kind", KINDS)
def test_a_body_is_invisible_from_its_inside(kind):
    scene = Scene("one", body(kind, 0.2, 5.0, 4.0, 1.5, 1.0))
    empty = dataclasses.replace(scene, obstacles=scene.obstacles[:0])
    for pose, same in (((0.2, 5.1, 3.9, 0.3), True), ((0.2, 0.0, 3.9, 0.0), False)):
        images = [RaycastRenderer(one, 16, 16).render(*pose) for one in (scene, empty)]
        assert np.array_equal(*images) == same


def covered(scene: Scene, samples: int, yaw: float) -> float:
    """Area of the image [pixels] that black bodies cover before a plain sky and ground."""
    image = RaycastRenderer(scene, 64, 64, samples=samples).render(0.0, 0.0, 50.0, yaw).astype(np.float64)
    empty = dataclasses.replace(scene, obstacles=scene.obstacles[:0])
    behind = RaycastRenderer(empty, 64, 64).render(0.0, 0.0, 50.0, yaw)
    return float((1.0 - image / behind).sum())


@pytest.mark.parametrize(("x", "radius"), [(0.0, 3.0), (-6.3, 0.4), (2.2, 5.0)])
def test_slanting_outlines_cover_the_area_that_geometry_says(x, radius):
    yaw, away = 0.1, math.hypot(x, 12.0)
    theta, alpha = abs(math.atan2(x, 12.0) + yaw), math.asin(radius / away)
    # A sphere shows as the ellipse that its tangents cut from the image's plane.
    ellipse = math.sin(alpha) ** 2 * math.cos(alpha) / (math.cos(theta) ** 2 - math.sin(alpha) ** 2) ** 1.5
    # Level with its base, a cone is a triangle.
    left, right = math.tan(theta - alpha), math.tan(theta + alpha)
    triangle = 0.5 * (right - left) * 4.0 / (away * math.cos(theta))
    sphere = Scene("one", body(ELLIPSOID, x, 12.0, 50.0, radius, radius, albedo=0.0), wall_height_m=1e-9)
    cone = Scene("one", body(CONE, x, 12.0, 52.0, radius, 2.0, albedo=0.0), wall_height_m=1e-9)
    for samples in (1, 4):
        assert covered(cone, samples, yaw) == pytest.approx(1024.0 * triangle, rel=2e-5)
        assert covered(sphere, samples, yaw) == pytest.approx(1024.0 * math.pi * ellipse, rel=2e-5)


@pytest.mark.parametrize(("kinds", "most"), [((CONE, BOX), (2e-5, 1e-5)), ((ELLIPSOID,), (4e-4, 1e-4))])
def test_straight_outlines_are_exact_also_where_they_cross_and_arcs_converge(kinds, most):
    scene = forest(kinds, np.random.default_rng(0), ambient=1.0, diffuse=0.0)
    for pose in AHEAD[:3]:
        best = RaycastRenderer(scene, 64, 64, samples=16).render(*pose)
        for samples, bound in zip((1, 3), most, strict=True):
            image = RaycastRenderer(scene, 64, 64, samples=samples).render(*pose)
            assert np.abs(image - best).mean() < bound, (pose, samples)


def test_a_world_that_is_enlarged_or_mirrored_or_moved_looks_so():
    scene = forest(KINDS, np.random.default_rng(2), ground_texture=Texture("rings", 2.0, 0.3))
    large, turned, moved = (scene.obstacles.copy() for _ in range(3))
    for key in ("x", "y", "z", "rx", "ry", "rz"):
        large[key] *= 2.0
    turned["x"] *= -1.0
    moved["y"] += 8.0
    lengths = {"width_m": 60.0, "wall_height_m": 12.0, "walls_y_m": (-40.0, 300.0)}
    worlds = [
        {"obstacles": large, "ground_texture": Texture("rings", 4.0, 0.3), **lengths},
        {"obstacles": turned, "sun": (-scene.sun[0], *scene.sun[1:])},
        {"obstacles": moved, "walls_y_m": (-12.0, 158.0)},
    ]
    for x, y, z, yaw in AHEAD + ABOVE:
        image = RaycastRenderer(scene, 32, 32).render(x, y, z, yaw)
        poses = (2 * x, 2 * y, 2 * z, yaw), (-x, y, z, -yaw), (x, y + 8.0, z, yaw)
        same, mirrored, along = (
            RaycastRenderer(dataclasses.replace(scene, **world), 32, 32).render(*pose)
            for world, pose in zip(worlds, poses, strict=True)
        )
        np.testing.assert_allclose(same, image, atol=1e-6)
        np.testing.assert_allclose(mirrored, image[:, ::-1], atol=2e-5)
        np.testing.assert_allclose(along, image, atol=1e-6)


@pytest.mark.parametrize("kind", [CONE, ELLIPSOID])
@pytest.mark.parametrize("texture", [Texture(), Texture("noise", 1.0, 0.8)])
def test_a_body_that_a_bent_one_hides_changes_no_byte_and_one_that_shows_does(kind, texture):
    near = body(kind, 0.0, 6.0, 2.5, 1.8, 2.5)

    def image(*behind):
        scene = Scene("hand", np.concatenate([near, *behind]), obstacle_texture=texture)
        return RaycastRenderer(scene, 64, 64).render(0.0, 0.0, 2.0, 0.0)

    alone = image()
    hidden = [
        body(other, x, 30.0, 1.0, 0.5, 1.0) for other, x in zip(KINDS, (-3.0, -1.0, 1.0, 3.0), strict=True)
    ]
    assert np.array_equal(image(*hidden), alone)
    for x, z in ((0.0, 9.0), (9.0, 1.0), (-9.0, 1.0)):  # above it, and beside it on both sides
        assert not np.array_equal(image(body(POLE, x, 30.0, z, 0.5, z)), alone)


def test_bodies_beyond_the_culling_distance_are_left_out_and_no_others():
    scene = forest(KINDS, np.random.default_rng(4))
    o = scene.obstacles
    away = np.hypot(o["x"] - 1.0, o["y"] - 5.0)
    nearest = np.sort(away)
    limit = 0.5 * (nearest[12] + nearest[13])
    # Shrunk to poles of a millimetre, a body's nearest point is where it stands.
    thin = o.copy()
    thin["kind"], thin["rx"], thin["ry"], thin["z"], thin["rz"] = POLE, 1e-3, 1e-3, 3.0, 3.0
    kept = dataclasses.replace(scene, obstacles=thin[away < limit])
    image = RaycastRenderer(dataclasses.replace(scene, obstacles=thin), 64, 64, cull_m=limit).render(1, 5, 2)
    assert np.array_equal(image, RaycastRenderer(kept, 64, 64).render(1, 5, 2))
    plain = RaycastRenderer(scene, 64, 64).render(1, 5, 2)
    assert np.array_equal(RaycastRenderer(scene, 64, 64, cull_m=1e5).render(1, 5, 2), plain)
    # Height counts: 6 m ahead and 7 m below is 9.2 m away.
    below = Scene("one", body(POLE, 0.0, 12.0, 1.0, 1.0, 1.0))
    none = RaycastRenderer(Scene("none", below.obstacles[:0]), 16, 16, 150.0).render(0.0, 5.0, 9.0)
    for limit, drawn in ((9.1, False), (9.3, True)):
        seen = RaycastRenderer(below, 16, 16, 150.0, cull_m=limit).render(0.0, 5.0, 9.0)
        assert np.array_equal(seen, none) != drawn


MOVING = {
    "ground_texture": Texture("noise", 2.0, 0.5, (1.0, -2.0), 3),
    "wall_texture": Texture("checker", 1.0, 0.2, (0.5, 0.0)),
    "obstacle_texture": Texture("checker", 0.7, 0.5, (0.3, 1.0)),
}


@pytest.mark.parametrize("textured", [False, True])
def test_every_pose_gives_finite_luminance_between_the_scenes_least_and_most(textured):
    rng = np.random.default_rng(6)
    scene = forest(KINDS, rng, **(MOVING if textured else {}))
    least, most = 0.1 * 0.35 * (0.5 if textured else 1.0), 0.85
    most = max(most, 0.8 * 1.2 if textured else 0.8)
    renderer = RaycastRenderer(scene, 17, 13)
    o = scene.obstacles
    for _ in range(150):
        near = o[rng.integers(len(o))]
        angle, reach = rng.uniform(-np.pi, np.pi), near["rx"] * rng.choice([0, 0.5, 1, 1 + 1e-9, 1 + 1e-6, 3])
        x, y = near["x"] + reach * np.cos(angle), near["y"] + reach * np.sin(angle)
        x = rng.choice([x, x, near["x"] + near["rx"], 15.0, -15.0, 15.0 + 1e-6, 1e6])
        y = rng.choice([y, y, near["y"] - near["ry"], -1e6])
        z = rng.choice([0.0, 1e-9, 2.0, 6.0, near["z"], near["z"] + near["rz"], near["z"] - near["rz"], 1e6])
        yaw = rng.choice([0.0, np.pi / 2, -np.pi / 2, np.pi, 0.3, -2.0, 1e5, rng.uniform(-3, 3)])
        pose = (float(x), float(y), max(0.0, float(z)), float(yaw), float(rng.choice([0.0, 3.7, 1e6])))
        image = renderer.render(*pose)
        assert np.isfinite(image).all(), pose
        # What edges leave of a row adds up to one: only rounding is left.
        assert least - 1e-6 <= image.min() <= image.max() <= most + 1e-6, pose


@pytest.mark.parametrize("shape", [(1, 1, 90.0), (1280, 720, 90.0), (64, 3, 1.0), (31, 64, 170.0)])
def test_images_of_any_shape_and_field_of_view_show_the_same_world(shape):
    width, height, fov = shape
    scene, pose = forest(KINDS, np.random.default_rng(7)), (0.3, 12.0, 2.0, 0.1)
    image = RaycastRenderer(scene, width, height, fov).render(*pose)
    points = sample_luminance(scene, pose, width, height, fov, samples=1 if width > 100 else 32)
    assert image.shape == (height, width)
    assert np.abs(image - points).mean() < (1e-2 if width == 1 else 5e-3)


def test_ten_thousand_bodies_or_none_are_a_picture():
    made, number = np.tile(body(POLE, 0.0, 0.0, 1.0, 0.1, 1.0), 10_000), np.arange(10_000)
    made["kind"], made["albedo"] = number % 4, np.random.default_rng(8).uniform(0.1, 0.6, 10_000)
    made["x"], made["y"] = 0.3 * (number % 100 - 49.5), 5.0 + 0.3 * (number // 100)
    for obstacles in (made, made[:0]):
        scene = Scene("crowd", obstacles)
        image = RaycastRenderer(scene, 12, 12, samples=8).render(0, 0, 3)
        assert np.abs(image - sample_luminance(scene, (0, 0, 3, 0), 12, 12, samples=16)).mean() < 3e-3


def pole(x, y, radius, height):
    return body(POLE, x, y, 0.5 * height, radius, 0.5 * height, albedo=0.25)


def test_a_pole_is_where_and_as_wide_and_as_high_as_its_geometry_says():
    scene = Scene("hand", pole(0.0, 10.0, 0.5, 8.0), wall_height_m=1e-9)
    image = RaycastRenderer(scene, 64, 64, samples=32).render(0.0, 0.0, 2.0)
    # Just above the horizon there is sky but for the pole, 2 r / sqrt(d^2 - r^2) wide.
    share = (0.85 - image[31]) / (0.85 - image[31].min())
    assert share.sum() == pytest.approx(32.0 * 2.0 * 0.5 / math.sqrt(100.0 - 0.25), rel=0.12)
    rows = (0.85 - image[:32, 31]) / (0.85 - image[31, 31])
    assert rows.sum() == pytest.approx(32.0 * 6.0 / 9.5, abs=0.3)
    turned_left = RaycastRenderer(scene, 64, 64).render(0.0, 0.0, 2.0, 0.3)
    assert turned_left[25].argmin() == pytest.approx(32 + 32 * math.tan(0.3), abs=2)


def test_a_pole_over_a_wall_is_seen_and_one_behind_a_wall_is_not():
    outside = np.concatenate([pole(-20.0, 30.0, 0.5, 8.0), pole(-20.0, 40.0, 0.5, 2.0)])
    pose = (0.0, 30.0, 2.0, math.pi / 2)
    empty, full = (
        RaycastRenderer(Scene("hand", some), 64, 64).render(*pose) for some in (outside[:0], outside)
    )
    rows, columns = np.nonzero(np.abs(full - empty) > 1e-6)
    # The tall pole, straight ahead, between the wall's top (4 / 15) and its own (6 / 19.5).
    assert set(columns) <= {31, 32}
    assert (rows.min(), rows.max()) == (int(32 - 32 * 6 / 19.5), int(32 - 32 * 4 / 15))


def test_each_render_is_a_fresh_array_and_set_scene_changes_the_scene():
    renderer = RaycastRenderer(make_scene("poles", np.random.default_rng(1)), 32, 32)
    first = renderer.render(0, 0, 2)
    copy = first.copy()
    renderer.set_scene(make_scene("poles", np.random.default_rng(2)))
    second = renderer.render(0, 0, 2)
    assert np.array_equal(first, copy)
    assert not np.array_equal(first, second)


TRIANGLE = np.array([[0.0, 5.0, 0.0], [1.0, 5.0, 0.0], [0.0, 5.0, 1.0]]), np.array([[0, 1, 2]]), np.ones(3)


@pytest.mark.parametrize(
    ("scene", "image", "pose", "word"),
    [
        ({"mesh": TRIANGLE}, {}, (0, 0, 2), "pyrender"),
        ({}, {"cull_m": math.nan}, (0, 0, 2), "cull_m"),
        ({}, {"fov_deg": 180.0}, (0, 0, 2), "fov_deg"),
        ({}, {}, (math.nan, 0, 2), "pose"),
        ({}, {}, (0, math.inf, 2), "pose"),
        ({}, {}, (0, 0, -1e-9), "pose"),
        ({}, {}, (0, 0, 2, math.nan), "pose"),
        ({}, {}, (0, 0, 2, 0, math.inf), "t_s"),
    ],
)
def test_a_scene_an_image_or_a_pose_that_cannot_be_is_refused(scene, image, pose, word):
    with pytest.raises(ValueError, match=word):
        RaycastRenderer(Scene("hand", np.zeros(0, OBSTACLE), **scene), 8, 8, **image).render(*pose)
