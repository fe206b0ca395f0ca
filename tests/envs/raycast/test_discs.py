"""Laws of `renderer=spheres`: what is drawn pixel by pixel comes to what the strips show exactly."""

import dataclasses

import numpy as np
import pytest

from envs.config import EnvConfig, FidelityConfig
from envs.event_error import error_between
from envs.fidelity import choose_renderer
from envs.raycast import RaycastRenderer
from envs.scene import ELLIPSOID, OBSTACLE, POLE, Scene
from tests.support.point_samples import sample_luminance

NO_WALL = {"wall_height_m": 1e-6}


def world(count=120, seed=0, closest=1.02):
    """Spheres above the ground whose middles are so many sums of their radii apart, or more."""
    rng, kept = np.random.default_rng(seed), []
    while len(kept) < count:
        place, radius = rng.uniform((-10.0, 3.0, 1.6), (10.0, 40.0, 10.0)), rng.uniform(0.05, 1.5)
        if all(np.linalg.norm(place - other) > closest * (radius + own) for other, own in kept):
            kept.append((place, radius))
    rows = [(ELLIPSOID, *place, *[radius] * 3, 0.25) for place, radius in kept]
    return Scene("spheres", np.array(rows, OBSTACLE), **NO_WALL)


def pictures(scene, poses, **fields):
    return RaycastRenderer(scene, 64, 64, **fields).render_way(np.array(poses)).copy()


def some_poses(count=6):
    rng = np.random.default_rng(1)
    return [
        (*rng.uniform((-4.0, 0.0, 1.0), (4.0, 30.0, 8.0)), rng.uniform(-0.3, 0.3), 0.0) for _ in range(count)
    ]


def test_with_more_samples_discs_become_what_strips_show():
    scene, poses = world(), some_poses()
    exact = pictures(scene, poses, samples=6)
    found = [pictures(scene, poses, samples=samples, discs=True) for samples in (1, 2, 4)]
    errors = [np.abs(picture / exact - 1.0).mean() for picture in found]
    assert errors[0] < 0.01
    assert errors[1] < 0.4 * errors[0]
    assert errors[2] < 0.4 * errors[1]


def test_spheres_that_overlap_are_drawn_closer_to_the_truth_than_by_strips():
    scene, pose = world(closest=0.6), some_poses(1)[0]
    truth = sample_luminance(scene, pose[:4], 256, 256).reshape(64, 4, 64, 4).mean(axis=(1, 3))
    by_discs, by_strips = (
        np.abs(pictures(scene, [pose], samples=2, discs=discs)[0] / truth - 1.0).mean()
        for discs in (True, False)
    )
    assert by_discs < 0.03
    assert by_discs < by_strips


@pytest.mark.parametrize("radius", [0.02, 0.3, 0.6])
def test_a_small_sphere_hides_its_area_wherever_it_lies_in_a_pixel(radius):
    hidden = []
    for x in np.linspace(0.0, 0.3, 7):
        body = np.array([(ELLIPSOID, x, 10.0, 7.0 + 0.7 * x, *[radius] * 3, 0.0)], OBSTACLE)
        picture = pictures(Scene("one", body, **NO_WALL), [(0.0, 0.0, 5.0, 0.0, 0.0)], discs=True)[0]
        hidden.append((1.0 - picture[:32] / picture[0, 0]).sum())
    area = np.pi * (3.2 * radius) ** 2  # [pixels], straight ahead
    assert np.mean(hidden) == pytest.approx(area * 1.02, rel=0.06)
    assert np.ptp(hidden) < 0.05 * area + 0.01


def test_events_come_to_those_of_the_ray_caster(tmp_path):
    rows = world().obstacles
    lines = [f"s, {q['y']}, {-q['x']}, {q['z']}, 1, 0, 0, 0" + f", {2.0 * q['rx']}" * 3 for q in rows]
    (tmp_path / "world.csv").write_text("\n".join(lines) + "\n")
    vehicle = {"speed_mps": 10.0, "control_hz": 100.0, "vehicle_radius_m": 0.0}
    layout = {"passable": False, "wall_height_m": 1e-6}
    config, errors = EnvConfig(scene=str(tmp_path / "world.csv"), layout=layout, **vehicle), []
    for samples in (1, 4):
        other = dataclasses.replace(config, renderer="spheres", fidelity=FidelityConfig(samples=samples))
        errors.append(error_between(config, other, flights=2, steps=3))
    assert errors[0] < 0.35
    assert errors[1] < 0.3 * errors[0]


def test_only_plain_spheres_can_be_asked_for():
    assert choose_renderer("spheres", world(3)) == "spheres"
    pole = np.array([(POLE, 0.0, 9.0, 2.0, 0.2, 0.2, 2.0, 0.2)], OBSTACLE)
    for scene in (Scene("one", pole, **NO_WALL), dataclasses.replace(world(3), wall_height_m=6.0)):
        with pytest.raises(ValueError, match=r"renderer='spheres' draws plain spheres .*use 'auto'"):
            choose_renderer("spheres", scene)
