import dataclasses
import math

import numpy as np
import pytest

from envs.raycast import RaycastRenderer
from envs.raycast.bodies import see_bodies
from envs.raycast.silhouettes import (
    Stretch,
    Way,
    aim_along,
    find_looks,
    find_near,
    find_silhouettes,
    follow_bodies,
    make_looks,
)
from envs.scene import BOX, OBSTACLE, POLE, Scene, at_velocity, make_scene

WIDTH = 64
WAY = Way(0.3, 20.0, 0.1, 20.3, 2.0, 1000, 40_000)
WHOLE = (WAY.start_us, WAY.start_us + WAY.moving_us)


def places(scene, t_us):
    """Columns of the silhouettes of all poles, by angles: (N, 2) [pixels]."""
    part = (t_us - WAY.start_us) / WAY.moving_us
    x, y = WAY.start_x + (WAY.end_x - WAY.start_x) * part, WAY.start_y + (WAY.end_y - WAY.start_y) * part
    dx, dy = scene.obstacles["x"] - x, scene.obstacles["y"] - y
    middle = np.arctan2(dx, dy)
    half = np.arcsin(np.minimum(1.0, scene.obstacles["rx"] / np.hypot(dx, dy)))
    angles = np.clip(np.stack([middle - half, middle + half], axis=1), -1.5, 1.5)
    return 0.5 * WIDTH * (1.0 + np.tan(angles))


def ends_of(scene, renderer):
    """The bodies in view, and their silhouettes at the begin and at the end of the way, each (K, 2)."""
    renderer.room.frames[0] = renderer.frame[0]
    numbers = np.empty(len(renderer.bodies), np.int64)
    count = follow_bodies(renderer.bodies, WAY, renderer.frame[0].focal, WIDTH, math.inf, numbers)
    ends = [np.empty((count, 2)) for _ in WHOLE]
    for t_us, found in zip(WHOLE, ends, strict=True):
        aim_along(renderer.room.frames[0], WAY, t_us)
        find_silhouettes(renderer.bodies, numbers[:count], WIDTH, renderer.room, found)
    return numbers[:count], *ends


def looks_of(scene):
    """Times, and first and last columns, of the looks before the end of the way; bodies and their ends."""
    renderer = RaycastRenderer(scene, WIDTH, 48)
    looks, ends = make_looks(WIDTH), ends_of(scene, renderer)
    looks.every[:] = 1
    stretch = Stretch(1, *WHOLE, *ends)
    count = find_looks(renderer.bodies, renderer.frame[0].focal, WAY, stretch, looks) - 1
    assert (looks.t_us[count], looks.first[count], looks.last[count]) == (WHOLE[1], 0, WIDTH)
    return looks.t_us[:count], looks.first[:count], looks.last[:count], ends


@pytest.mark.parametrize("seed", range(5))
def test_columns_are_looked_at_when_a_silhouette_stands_between_them(seed):
    scene = make_scene("poles", np.random.default_rng(seed))
    times, first, last, _ = looks_of(scene)
    half_way = times == sum(WHOLE) // 2
    assert (~half_way).sum() > 5
    assert (np.diff(times) >= 0).all()
    for t_us, begin, end in zip(times[~half_way], first[~half_way], last[~half_way], strict=True):
        border = end - 1 if end < WIDTH or begin + 2 == end else end
        assert np.abs(places(scene, t_us) - border).min() < 1e-3


@pytest.mark.parametrize("seed", range(5))
def test_every_silhouette_that_passes_between_columns_has_its_look(seed):
    scene = make_scene("poles", np.random.default_rng(seed))
    times, first, last, ends = looks_of(scene)
    passed = 0
    followed, start, end = ends
    for k, side in np.ndindex(start.shape):
        body = followed[k]
        for border in range(1, WIDTH):
            if (start[k, side] - border) * (end[k, side] - border) >= 0.0:
                continue
            near = (first == border - 1) & (last == border + 1)
            at = [abs(places(scene, t_us)[body, side] - border) for t_us in times[near]]
            assert min(at, default=math.inf) < 1e-3
            passed += 1
    assert passed > 5


def test_silhouettes_are_where_angles_put_them():
    scene = make_scene("poles", np.random.default_rng(1))
    _, _, _, (followed, start, _) = looks_of(scene)
    inside = (start[:, 0] > 0) & (start[:, 1] < WIDTH)
    assert inside.sum() > 5
    np.testing.assert_allclose(start[inside], places(scene, WAY.start_us)[followed[inside]], atol=1e-9)
    assert (start >= -2.0).all()
    assert (start <= WIDTH + 2.0).all()


def test_bodies_in_view_at_one_end_of_a_way_alone_are_followed_to_the_side_that_they_leave_by():
    # Two that leave to the left and to the right, one that stays ahead, one behind.
    axes = (POLE, -1.3, 21.4), (BOX, 1.5, 21.5), (POLE, 0.0, 40.0), (POLE, 0.0, 15.0)
    scene = Scene("few", np.array([(*axis, 2.0, 0.3, 0.3, 2.0, 0.25) for axis in axes], OBSTACLE))
    renderer, numbers, way = (
        RaycastRenderer(scene, WIDTH, 48),
        np.empty(4, np.int64),
        WAY._replace(end_y=21.9),
    )
    renderer.room.frames[0] = renderer.frame[0]
    for one in (
        way,
        way._replace(start_x=way.end_x, start_y=way.end_y, end_x=way.start_x, end_y=way.start_y),
    ):
        count = follow_bodies(renderer.bodies, one, 32.0, WIDTH, math.inf, numbers)
        assert numbers[:count].tolist() == [0, 1, 2]
    aim_along(renderer.room.frames[0], way, WHOLE[1])
    found = np.empty((4, 2))
    find_silhouettes(renderer.bodies, np.arange(4), WIDTH, renderer.room, found)
    assert found[0].tolist() == [-2.0, -2.0]
    assert found[1].tolist() == [WIDTH + 2.0, WIDTH + 2.0]
    assert -2.0 < found[2, 0] < found[2, 1] < WIDTH + 2.0


def test_a_scene_without_bodies_takes_no_look():
    scene = make_scene("poles", np.random.default_rng(0), num_obstacles=0)
    assert looks_of(scene)[0].size == 0


@pytest.mark.parametrize("cull_m", [15.0, math.inf])
@pytest.mark.parametrize("name", ["spheres", "gates"])
def test_what_is_in_view_anywhere_on_a_way_was_found_near_it(name, cull_m):
    rng = np.random.default_rng(3)
    scene = make_scene(name, rng)
    moving = tuple(at_velocity(body, rng.uniform(-20.0, 20.0, 3)) for body in scene.obstacles[:30])
    renderer = RaycastRenderer(dataclasses.replace(scene, moving=moving), WIDTH, 48)
    renderer.move_bodies(moving, 0.0, 1.0)
    bodies, seen, found = renderer.bodies, np.zeros_like(renderer.bodies), np.zeros_like(renderer.bodies)
    focal, frame, few = renderer.frame[0].focal, renderer.room.frames, 0
    frame[0] = renderer.frame[0]
    for _ in range(10):
        way = Way(*rng.uniform((-5.0, 0.0, -5.0, 0.0), (5.0, 30.0, 5.0, 30.0)), 2.0, 10_000, 300_000)
        near = found["number"][: find_near(bodies, way, focal, WIDTH, cull_m, found)].copy()
        assert (np.diff(near) > 0).all()
        few += near.size < 0.8 * len(bodies)
        for t_us in np.linspace(way.start_us, way.start_us + way.moving_us, 9):
            aim_along(frame[0], way, t_us)
            count = see_bodies(bodies, frame[0], -32.0 / focal, 32.0 / focal, cull_m, seen)
            assert np.isin(seen["number"][:count], near).all()
    assert few or name == "gates"
