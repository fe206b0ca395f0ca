"""The rasteriser against the ray caster's point samples: two ways to the same picture."""

import dataclasses

import numpy as np
import pytest
import trimesh

from envs.rasterize import PyrenderRenderer
from envs.scene import BOX, CONE, ELLIPSOID, OBSTACLE, POLE, Scene, Texture, make_scene
from envs.scene.obstacles import KINDS
from envs.scene.textures import PATTERNS
from tests.support.point_samples import sample_luminance

EMPTY = np.zeros(0, OBSTACLE)
PLACES = [(x, y) for y in range(8, 90, 9) for x in (-10, -3, 4, 11)]


def bodies(kinds: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Twenty bodies that do not overlap, of all sizes; half of them float."""
    found = np.zeros(20, OBSTACLE)
    places = rng.permutation(PLACES)[:20] + rng.uniform(-1.5, 1.5, (20, 2))
    found["kind"] = rng.choice(kinds, 20)
    found["x"], found["y"] = places.T
    found["rx"], found["ry"], found["rz"] = rng.uniform((0.2, 0.2, 0.5), (1.4, 1.4, 3.0), (20, 3)).T
    found["ry"] = np.where(found["kind"] == BOX, found["ry"], found["rx"])
    found["z"] = found["rz"] + rng.uniform(0, 3, 20) * (rng.random(20) < 0.5)
    found["albedo"] = rng.uniform(0.2, 0.6, 20)
    return found


def poses(rng: np.random.Generator, count: int) -> list[tuple[float, ...]]:
    """On the lane, ahead or anywhere; low, at flight height and above all bodies."""
    x, y = rng.uniform((-12, 0), (12, 85), (count, 2)).T
    turned = np.where(rng.random(count) < 0.7, 0.8, 3.1) * rng.uniform(-1, 1, count)
    return list(zip(x, y, rng.choice([0.3, 2, 2, 5, 12], count), turned, strict=True))


@pytest.fixture(scope="module")
def renderer():
    try:
        made = PyrenderRenderer(Scene(name="test", obstacles=EMPTY), 64, 64, samples=1)
    except RuntimeError as error:
        pytest.skip(str(error))
    yield made
    made.close()


def differences(renderer: PyrenderRenderer, scene: Scene, pose: tuple[float, ...], t_s: float) -> np.ndarray:
    renderer.set_scene(scene)
    truth = sample_luminance(scene, pose, 64, 64, t_s=t_s)
    return np.abs(renderer.render(*pose, t_s) - truth)


def mean_differences(renderer: PyrenderRenderer, kinds: tuple[int, ...], seeds: int, **looks) -> np.ndarray:
    means = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        scene = Scene(name="test", obstacles=bodies(kinds, rng), **looks)
        for pose in poses(rng, 5):
            means.append(differences(renderer, scene, pose, rng.uniform(0, 5)).mean())
    return np.array(means)


# What is left are single samples at edges, and at the rims of poles and the outlines of
# ellipsoids, which are polygons.
@pytest.mark.parametrize("kind", [POLE, CONE, ELLIPSOID, BOX], ids=KINDS)
def test_every_kind_of_body_is_the_same_picture_at_equal_sample_points(renderer, kind):
    found = mean_differences(renderer, (kind,), 8)
    assert found.mean() < 1e-4
    assert np.median(found) < 2e-5
    assert found.max() < 6e-4


@pytest.mark.parametrize("pattern", PATTERNS[1:])
def test_every_texture_is_the_same_picture_at_equal_sample_points(renderer, pattern):
    looks = {
        "ground_texture": Texture(pattern, 2.0, 0.5, (1.3, -0.7), 3),
        "wall_texture": Texture(pattern, 1.5, 0.25, (-0.7, 1.3), 1),
        "obstacle_texture": Texture(pattern, 0.8, 0.5, (1.3, -0.7), 2),
    }
    found = mean_differences(renderer, (POLE, CONE, ELLIPSOID, BOX), 3, **looks)
    assert found.mean() < 1.5e-4
    assert np.median(found) < 1e-4
    assert found.max() < 1e-3


def test_surfaces_may_have_different_textures_or_none(renderer):
    looks = {
        "ground_texture": Texture("noise", 2.0, 0.5, (0.5, 0.0), 3),
        "obstacle_texture": Texture("checker", 1.0, 0.5, (0.0, 2.0), 4),
    }
    for some in (looks, {}):
        assert mean_differences(renderer, (POLE, CONE, ELLIPSOID, BOX), 2, **some).mean() < 1.5e-4


def test_textures_are_as_sharp_far_away_and_late(renderer):
    ground = Texture("checker", 3.0, 0.5, (0.7, -0.3))
    scene = Scene(name="test", obstacles=EMPTY, ground_texture=ground)
    for pose in ((2e5, -3e5, 2.0, 0.3), (-7e5, 4e5, 50.0, 2.0)):
        assert differences(renderer, scene, pose, 1e5).mean() < 1e-3
    assert differences(renderer, scene, (0.3, 10.0, 2.0, 0.1), 1e6).mean() < 1e-4


@pytest.mark.parametrize("kind", [POLE, CONE, ELLIPSOID, BOX], ids=KINDS)
def test_both_renderers_agree_from_places_that_no_flight_would_choose(renderer, kind):
    body = np.array([(kind, 1.0, 20.0, 3.0, 1.2, 1.2, 2.0, 0.4)], OBSTACLE)
    scene = Scene(name="test", obstacles=body)
    for pose in (
        *[(1.1, 20.1, 2.6, 0.3), (1.0, 20.0, 2.0, 0.1)],  # inside and at its axis
        *[(1.2, 19.0, 9.0, 0.1), (1.0, 20.0, 7.0, 0.4), (1.3, 17.5, 0.2, 0.1)],  # above, over its axis, below
        *[(1.3, 12.0, 5.0, 0.05), (1.3, 12.0, 1.0, 0.05)],  # level with its top and its bottom
        *[(0.2, 15.0, 0.0, 0.1), (0.2, 15.0, 1e-3, 0.1), (1.0, 18.799, 3.0, 0.2)],  # at the ground, at it
        *[(3.0, -40.0, 300.0, 0.1), (1e6, 1e6, 1e6, 0.3)],  # high and far
        *[(-25.0, 15.0, 9.0, -1.2), (15.0, 5.0, 2.0, 0.3)],  # behind a wall and in its plane
    ):
        assert differences(renderer, scene, pose, 0.0).mean() < 1e-3, pose


@pytest.mark.parametrize("kind", [POLE, CONE, ELLIPSOID], ids=KINDS[:3])
def test_corners_that_fall_together_far_away_move_no_edge(renderer, kind):
    found = []
    for away in np.geomspace(2.0, 200.0, 40):
        body = np.array([(kind, 0.3, away, 3.0, 1.0, 1.0, 2.0, 0.3)], OBSTACLE)
        scene = Scene(name="test", obstacles=body)
        found += [differences(renderer, scene, (0.0, 0.0, z, 0.1), 0.0).mean() for z in (0.5, 3.0, 9.0)]
    assert np.mean(found) < 4e-5


# glTF is y-up: its (x, y, z) is (x, -z, y) in the lane.
@pytest.mark.parametrize("suffix", [".glb", ".ply"])
def test_a_mesh_file_is_drawn_as_the_bodies_it_holds(renderer, suffix, tmp_path):
    rows = [(BOX, 2.0, 20.0, 3.0, 1.0, 2.0, 1.5, 0.25), (ELLIPSOID, -4.0, 25.0, 4.0, 1.5, 1.5, 1.5, 0.25)]
    alike = Scene(name="test", obstacles=np.array(rows, OBSTACLE))
    box = trimesh.creation.box(extents=(2.0, 4.0, 3.0)).apply_translation((2.0, 20.0, 3.0))
    ball = trimesh.creation.icosphere(subdivisions=5, radius=1.5).apply_translation((-4.0, 25.0, 4.0))
    both = trimesh.util.concatenate([box, ball])
    if suffix == ".glb":
        both.apply_transform(np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]]))
        material = trimesh.visual.material.PBRMaterial(baseColorFactor=[0.25, 0.25, 0.25, 1.0])
        both.visual = trimesh.visual.TextureVisuals(material=material)
    else:
        both = trimesh.Trimesh(both.vertices, both.faces, process=False)
    both.export(tmp_path / f"bodies{suffix}")
    scene = make_scene(str(tmp_path / f"bodies{suffix}"), np.random.default_rng(0))
    renderer.set_scene(scene)
    for pose in ((0.0, 5.0, 2.0, 0.05), (1.0, 12.0, 9.0, 0.1), (-9.0, 15.0, 1.0, -0.9)):
        truth = sample_luminance(alike, pose, 64, 64)
        assert np.abs(renderer.render(*pose) - truth).mean() < 6e-4


@pytest.mark.parametrize(("width", "height", "fov_deg"), [(96, 40, 60.0), (33, 31, 120.0)])
def test_images_of_any_shape_and_lens_agree(renderer, width, height, fov_deg):
    rng = np.random.default_rng(2)
    looks = {"ground_texture": Texture("noise", 2.0, 0.5), "obstacle_texture": Texture("rings", 1.0, 0.5)}
    scene = Scene(name="test", obstacles=bodies((POLE, CONE, ELLIPSOID, BOX), rng), **looks)
    drawn = PyrenderRenderer(scene, width, height, fov_deg, samples=1)
    for pose in poses(rng, 3):
        truth = sample_luminance(scene, pose, width, height, fov_deg)
        assert np.abs(drawn.render(*pose) - truth).mean() < 8e-4
    drawn.close()


def test_more_samples_come_closer_to_the_mean_over_the_pixel():
    rng = np.random.default_rng(3)
    looks = {"ground_texture": Texture("noise", 3.0, 0.5), "obstacle_texture": Texture("stripes", 1.0, 0.5)}
    scene = Scene(name="test", obstacles=bodies((POLE, CONE, ELLIPSOID, BOX), rng), **looks)
    views, errors = poses(rng, 4), []
    truth = np.stack([sample_luminance(scene, pose, 64, 64, samples=12) for pose in views])
    for samples in (1, 2, 4):
        drawn = PyrenderRenderer(scene, 64, 64, samples=samples)
        errors.append(np.abs([drawn.render(*pose) for pose in views] - truth).mean())
        drawn.close()
    assert errors[1] < 0.5 * errors[0]
    assert errors[2] < 0.6 * errors[1]


def distances(found: np.ndarray, eye: tuple[float, float, float]) -> np.ndarray:
    """From the eye to the nearest point of each body's upright cylinder or box."""
    dx, dy, dz = (np.abs(found[key] - at) for key, at in zip("xyz", eye, strict=True))
    square = np.hypot(np.maximum(dx - found["rx"], 0), np.maximum(dy - found["ry"], 0))
    beside = np.where(found["kind"] == BOX, square, np.maximum(np.hypot(dx, dy) - found["rx"], 0))
    return np.hypot(beside, np.maximum(np.abs(dz) - found["rz"], 0))


def test_culling_drops_the_far_bodies_and_nothing_else(renderer):
    culled = PyrenderRenderer(Scene(name="test", obstacles=EMPTY), 64, 64, samples=1, cull_m=30.0)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        scene = Scene(name="test", obstacles=bodies((POLE, CONE, ELLIPSOID, BOX, BOX), rng))
        culled.set_scene(scene)
        for pose in poses(rng, 5):
            away = distances(scene.obstacles, pose[:3])
            culled.cull_m = float(np.median(away)) * (1 + 1e-9)
            renderer.set_scene(dataclasses.replace(scene, obstacles=scene.obstacles[away <= culled.cull_m]))
            np.testing.assert_array_equal(culled.render(*pose), renderer.render(*pose))
    culled.close()
    with pytest.raises(ValueError, match="cull_m must be > 0"):
        PyrenderRenderer(scene, 8, 8, cull_m=np.nan)
