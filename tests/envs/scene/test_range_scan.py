import math

import numpy as np
import pytest

from envs.scene import OBSTACLE, POLE, Scene, make_scene, range_scan
from envs.scene.range_scan import MAX_RANGE_M, NEAR_M, proximity, sector_bearings, sector_proximity
from tests.support.point_samples import BODY, trace_scene


def pole(x, y, radius=0.5):
    return Scene("one", np.array([(POLE, x, y, 3.0, radius, radius, 3.0, 0.5)], OBSTACLE))


def marched(sections, eye, heading):
    """Distance to the first section by sphere tracing of its distance function [m], or inf."""
    x, y, ux, uy, hx, hy, r = sections.T
    travelled = 0.0
    while travelled < MAX_RANGE_M:
        px, py = eye[0] + travelled * math.sin(heading), eye[1] + travelled * math.cos(heading)
        along, across = (px - x) * ux + (py - y) * uy, (py - y) * ux - (px - x) * uy
        gaps = np.hypot(np.maximum(abs(along) - hx, 0), np.maximum(abs(across) - hy, 0)) - r
        if gaps.min() < 1e-7:
            return travelled
        travelled += gaps.min()
    return math.inf


def test_what_is_far_or_below_counts_nothing_and_inside_an_obstacle_all_is_near():
    for y, distance, height, expected in (
        (10.2, 10, 2, [1, 1]),
        (0, MAX_RANGE_M + 1, 2, [0, 0]),
        (0, 10, 7, [0, 0]),
    ):
        assert proximity(pole(0, distance), (0, y, height, 0), [0.0, 1.0]).tolist() == expected


@pytest.mark.parametrize("name", ["poles", "cones", "gates", "shape_change"])  # each kind of body
def test_it_agrees_with_marching_on_a_distance_function_and_with_rays_through_the_bodies(name):
    scene = make_scene(name, np.random.default_rng(1))
    rng, pixels, focal = np.random.default_rng(2), 51, 25.0
    bearings = np.arctan((np.arange(pixels) + 0.5 - 0.5 * pixels) / focal)
    hits = 0
    for _ in range(4):
        pose = (rng.uniform(-10, 10), rng.uniform(0, 90), 2.0, rng.uniform(-0.3, 0.3))
        near = proximity(scene, pose, bearings)
        if near.max() == 1.0:
            continue  # within an obstacle
        marches = [marched(scene.sections(2.0), pose, bearing - pose[3]) for bearing in bearings]
        np.testing.assert_allclose(near, np.exp(-np.array(marches) / NEAR_M), atol=1e-6)
        seen = trace_scene(scene, pose, pixels, 1, focal)
        body = seen.surface[0] == BODY
        hits += body.sum()
        distance = np.where(body, seen.depth[0] / np.cos(bearings), np.inf)
        distance[distance > MAX_RANGE_M] = np.inf
        np.testing.assert_allclose(near, np.exp(-distance / NEAR_M), atol=1e-12)
    assert hits > 20


def test_sectors_share_the_field_of_view_evenly():
    bearings = np.degrees(sector_bearings(90, 24, 8))
    assert bearings.shape == (24, 8)
    assert bearings.ravel()[0] == pytest.approx(-45 + 90 / 384)
    np.testing.assert_allclose(np.diff(bearings.ravel()), 90 / 192)
    np.testing.assert_allclose(bearings.mean(1), np.degrees(sector_bearings(90, 24)[:, 0]))


@pytest.mark.parametrize(("y", "bearing"), [(np.nan, 0.0), (0.0, np.inf)])
def test_numbers_that_are_not_finite_are_refused(y, bearing):
    with pytest.raises(ValueError, match="must be finite, got"):
        proximity(pole(0, 10), (0, y, 2, 0), [bearing])


def test_a_sector_is_as_near_as_the_nearest_of_its_rays(monkeypatch):
    scene = pole(2, 10)
    each = proximity(scene, (0, 0, 2, 0), sector_bearings(90.0, 24, 8).ravel()).reshape(24, 8)
    assert np.array_equal(sector_proximity(scene, (0, 0, 2, 0), 90.0, 24), each.max(axis=1))
    monkeypatch.setattr(range_scan, "proximity", lambda scene, pose, rays: np.arange(len(rays)) / len(rays))
    assert np.allclose(sector_proximity(scene, (0, 0, 2, 0), 90.0, 24), (8 * np.arange(1, 25) - 1) / 192)
