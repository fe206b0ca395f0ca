"""Looks: when silhouettes pass between columns, and how finely time is divided where edges move."""

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
from envs.raycast.stretches import Shifts, divide_time, find_rows, make_outlines
from envs.scene import BOX, OBSTACLE, POLE, Scene, Texture, at_velocity, make_scene

WIDTH, HEIGHT = 64, 48
FOCAL = 32.0
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
    renderer = RaycastRenderer(scene, WIDTH, HEIGHT)
    looks, ends = make_looks(WIDTH), ends_of(scene, renderer)
    looks.every[:] = 1
    stretch = Stretch(1, *WHOLE, *ends)
    count = find_looks(renderer.bodies, renderer.frame[0].focal, WAY, stretch, looks) - 1
    assert (looks.t_us[count], looks.first[count], looks.last[count]) == (WHOLE[1], 0, WIDTH)
    return looks.t_us[:count], looks.first[:count], looks.last[:count], ends


@pytest.mark.parametrize("seed", range(2))
def test_columns_are_looked_at_when_and_only_when_a_silhouette_stands_between_them(seed):
    scene = make_scene("poles", np.random.default_rng(seed))
    times, first, last, (followed, start, end) = looks_of(scene)
    half_way = times == sum(WHOLE) // 2
    assert (~half_way).sum() > 5
    assert (np.diff(times) >= 0).all()
    for t_us, begin, stop in zip(times[~half_way], first[~half_way], last[~half_way], strict=True):
        border = stop - 1 if stop < WIDTH or begin + 2 == stop else stop
        assert np.abs(places(scene, t_us) - border).min() < 1e-3
    passed = 0
    for k, side, border in np.ndindex(*start.shape, WIDTH):
        if border and (start[k, side] - border) * (end[k, side] - border) < 0.0:
            near = (first == border - 1) & (last == border + 1)
            at = [abs(places(scene, t_us)[followed[k], side] - border) for t_us in times[near]]
            assert min(at, default=math.inf) < 1e-3
            passed += 1
    assert passed > 5


def test_bodies_in_view_at_one_end_of_a_way_alone_are_followed_to_the_side_that_they_leave_by():
    # Two that leave to the left and to the right, one that stays ahead, one behind.
    axes = (POLE, -1.3, 21.4), (BOX, 1.5, 21.5), (POLE, 0.0, 40.0), (POLE, 0.0, 15.0)
    scene = Scene("few", np.array([(*axis, 2.0, 0.3, 0.3, 2.0, 0.25) for axis in axes], OBSTACLE))
    renderer, numbers = RaycastRenderer(scene, WIDTH, HEIGHT), np.empty(4, np.int64)
    renderer.room.frames[0] = renderer.frame[0]
    way = WAY._replace(end_y=21.9)
    back = way._replace(start_x=way.end_x, start_y=way.end_y, end_x=way.start_x, end_y=way.start_y)
    for one in (way, back):
        count = follow_bodies(renderer.bodies, one, 32.0, WIDTH, math.inf, numbers)
        assert numbers[:count].tolist() == [0, 1, 2]
    aim_along(renderer.room.frames[0], way, WHOLE[1])
    found = np.empty((4, 2))
    find_silhouettes(renderer.bodies, np.arange(4), WIDTH, renderer.room, found)
    assert found[0].tolist() == [-2.0, -2.0]
    assert found[1].tolist() == [WIDTH + 2.0, WIDTH + 2.0]
    assert -2.0 < found[2, 0] < found[2, 1] < WIDTH + 2.0


@pytest.mark.parametrize(("name", "cull_m"), [("spheres", 15.0), ("gates", math.inf)])
def test_what_is_in_view_anywhere_on_a_way_was_found_near_it(name, cull_m):
    rng = np.random.default_rng(3)
    scene = make_scene(name, rng)
    moving = tuple(at_velocity(body, rng.uniform(-20.0, 20.0, 3)) for body in scene.obstacles[:30])
    renderer = RaycastRenderer(dataclasses.replace(scene, moving=moving), WIDTH, 48)
    renderer.move_bodies(moving, 0.0, 1.0)
    bodies, seen, found = renderer.bodies, np.zeros_like(renderer.bodies), np.zeros_like(renderer.bodies)
    bodies["albedo"] = np.arange(len(bodies))  # a number for each
    focal, frame, few = renderer.frame[0].focal, renderer.room.frames, 0
    frame[0] = renderer.frame[0]
    for _ in range(5):
        way = Way(*rng.uniform((-5.0, 0.0, -5.0, 0.0), (5.0, 30.0, 5.0, 30.0)), 2.0, 10_000, 300_000)
        near = found["albedo"][: find_near(bodies, way, focal, WIDTH, cull_m, found)].copy()
        assert (np.diff(near) > 0).all()
        few += near.size < 0.8 * len(bodies)
        for t_us in np.linspace(way.start_us, way.start_us + way.moving_us, 9):
            aim_along(frame[0], way, t_us)
            count = see_bodies(bodies, frame[0], -32.0 / focal, 32.0 / focal, cull_m, seen)
            assert np.isin(seen["albedo"][:count], near).all()
    assert few or name == "gates"


AHEAD = WAY._replace(start_x=0.0, end_x=0.0)


def divided(scene, way, shifts, limit=10**6):
    """The number of stretches, how many looks each column needs, and the outlines in view."""
    renderer, looks = RaycastRenderer(scene, WIDTH, HEIGHT), make_looks(WIDTH)
    room, bodies, outlines = renderer.room, renderer.bodies, make_outlines(len(renderer.bodies))
    room.frames[0] = renderer.frame[0]
    count = follow_bodies(bodies, way, FOCAL, WIDTH, math.inf, outlines.followed)
    for t_us, places, rows in (
        (way.start_us, outlines.before, outlines.rows_before),
        (way.start_us + way.moving_us, outlines.after, outlines.rows_after),
    ):
        aim_along(room.frames[0], way, t_us)
        find_silhouettes(bodies, outlines.followed[:count], WIDTH, room, places)
        find_rows(bodies, outlines.followed[:count], WIDTH, way, shifts, room, rows)
    stretches = divide_time(bodies, count, outlines, way, room.frames[0], shifts, limit, looks)
    assert stretches in (1, 2, 4, 8, 16)
    assert (stretches % looks.every == 0).all()
    used = (outlines.followed[:count], outlines.before[:count], outlines.after[:count])
    return stretches, stretches // looks.every, used


def needed(moved, shift):
    """Stretches of a motion [pixels], of which each may have `shift`: a power of two up to 16."""
    return 2 ** np.clip(np.ceil(np.log2(np.maximum(moved, 1e-9) / shift)), 0, 4)


def one(kind, y, radius, height, x=0.0, **fields):
    """A scene of one body on the ground, without walls."""
    row = (kind, x, y, 0.5 * height, radius, radius, 0.5 * height, 0.25)
    return Scene("one", np.array([row], OBSTACLE), **{"wall_height_m": 1e-9, **fields})


@pytest.mark.parametrize("name", ["poles", "gates", "shape_change"])
@pytest.mark.parametrize("shift", [0.02, 0.5])
def test_silhouettes_move_little_in_each_stretch_of_their_columns(name, shift):
    scene = make_scene(name, np.random.default_rng(2))
    _, looked, (_, start, end) = divided(scene, WAY, Shifts(shift, 10.0, shift))
    moved = np.abs(end - start).max(axis=1)
    if name == "gates":  # their posts are upright edges, their bars are level ones
        moved[:] = 0.0
    for k in np.argwhere(moved > 0.0)[:, 0]:
        low, high = min(start[k, 0], end[k, 0]), max(start[k, 1], end[k, 1])
        columns = slice(max(0, int(low)), max(0, int(high) + 1))
        assert (looked[columns] >= needed(moved[k], shift)).all()


@pytest.mark.parametrize(("kind", "radius", "top"), [(BOX, 0.4, 2.5), (POLE, 1.0, 1.0), (BOX, 5.0, 3.0)])
@pytest.mark.parametrize("ahead", [3.0, 20.0])
def test_level_edges_move_little_in_each_stretch(kind, radius, top, ahead):
    y = AHEAD.start_y + ahead + radius
    depths = y - radius - np.array([[20.0], [20.3]])
    rows = HEIGHT / 2 + FOCAL * (2.0 - np.array([0.0, top])) / depths
    rows = np.clip(rows, -2.0, HEIGHT + 2.0)  # of foot and top, where the front is nearest
    moved = np.abs(rows[1] - rows[0]).max()
    for shift in (0.02, 0.3):
        _, looked, _ = divided(one(kind, y, radius, top), AHEAD, Shifts(100.0, shift, 100.0))
        assert looked[WIDTH // 2] >= needed(moved, shift)
        # The far edge of a top that is seen from above, too, but not more than that.
        assert looked[WIDTH // 2] <= 2 * needed(moved, shift)


@pytest.mark.parametrize(("shift", "x"), [(0.05, 0.0), (0.3, -13.0), (1.0, 9.0)])
def test_the_lines_of_walls_move_little_in_each_stretch_of_a_turning_way(shift, x):
    empty = Scene("walls", np.empty(0, OBSTACLE))
    way = WAY._replace(start_x=x, end_x=x + 0.2, end_y=20.2)
    _, looked, _ = divided(empty, way, Shifts(0.1, shift, 0.1))
    u = (np.arange(WIDTH) + 0.5 - WIDTH / 2) / FOCAL
    away = np.where(u > 0.0, 15.0, -15.0) - np.array([[x], [x + 0.2]])
    depth = away / u
    moved = np.zeros(WIDTH)
    for drop in (2.0, 2.0 - empty.wall_height_m):
        rows = np.clip(HEIGHT / 2 + FOCAL * drop / depth, -2.0, HEIGHT + 2.0)
        moved = np.maximum(moved, np.abs(rows[1] - rows[0]))
    ends_before = 20.0 + depth[0] > empty.walls_y_m[1]
    np.testing.assert_array_equal(looked, needed(np.where(ends_before, 0.0, moved), shift))
    _, looked, _ = divided(empty, AHEAD, Shifts(0.1, shift, 0.1))
    assert (looked == 1).all()


def test_a_sharp_pattern_on_the_walls_moves_most_beside_the_vehicle():
    walls = Scene("w", np.empty(0, OBSTACLE), wall_texture=Texture("stripes", period_m=1.0, contrast=0.2))
    way = AHEAD._replace(end_y=20.5)
    _, looked, _ = divided(walls, way, Shifts(1.0, 0.1, 1.0))
    away = np.abs(np.arange(WIDTH) + 0.5 - WIDTH / 2)
    assert (np.diff(looked[np.argsort(away, kind="stable")]) >= 0).all()
    assert looked[0] == needed(FOCAL * (away[0] / FOCAL) ** 2 * 0.5 / 15.0, 0.1) > 1
    smooth = Scene("w", np.empty(0, OBSTACLE), wall_texture=Texture("noise", period_m=1.0, contrast=0.2))
    assert divided(smooth, way, Shifts(1.0, 0.1, 1.0))[0] == 1


def test_no_stretch_is_shorter_than_the_clock_and_slow_columns_wait_for_the_last():
    scene, shifts = make_scene("cones", np.random.default_rng(2)), Shifts(0.04, 0.02, 0.01)
    assert divided(scene, WAY, shifts, 3)[0] == 2
    stretches, needs, used = divided(scene, WAY, shifts)
    renderer, looks = RaycastRenderer(scene, WIDTH, HEIGHT), make_looks(WIDTH)
    looks.every[:] = stretches // needs
    looked = np.zeros(WIDTH, int)
    for number in range(1, stretches + 1):
        t_us = WAY.start_us + WAY.moving_us * number // stretches
        stretch = Stretch(number, t_us - 2, t_us, *used)
        count = find_looks(renderer.bodies, FOCAL, WAY, stretch, looks)
        for k in np.flatnonzero(looks.t_us[:count] == t_us):
            looked[looks.first[k] : looks.last[k]] += 1
    np.testing.assert_array_equal(looked, needs)
    assert stretches == looked.max() > looked.min()
