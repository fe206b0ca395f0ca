import math

import numpy as np
import pytest

from envs.raycast import RaycastRenderer
from envs.raycast.silhouettes import (
    Stretch,
    Way,
    aim_along,
    find_looks,
    find_silhouettes,
    follow_bodies,
    make_looks,
)
from envs.raycast.stretches import Shifts, divide_time, find_rows, make_outlines
from envs.scene import BOX, CONE, ELLIPSOID, OBSTACLE, POLE, Scene, Texture, make_scene

WIDTH, HEIGHT = 64, 48
FOCAL = 32.0
WAY = Way(0.3, 20.0, 0.1, 20.3, 2.0, 1000, 40_000)
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


@pytest.mark.parametrize("name", ["poles", "gates", "cones", "shape_change"])
@pytest.mark.parametrize("shift", [0.02, 0.1, 0.5])
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


@pytest.mark.parametrize(
    ("kind", "radius", "top"), [(BOX, 2.0, 1.5), (BOX, 0.4, 2.5), (POLE, 1.0, 1.0), (BOX, 5.0, 3.0)]
)
@pytest.mark.parametrize("ahead", [3.0, 6.0, 20.0])
def test_level_edges_move_little_in_each_stretch(kind, radius, top, ahead):
    y = AHEAD.start_y + ahead + radius
    rows = [
        HEIGHT / 2 + FOCAL * (2.0 - np.array([0.0, top])) / (y - radius - place) for place in (20.0, 20.3)
    ]
    rows = np.clip(rows, -2.0, HEIGHT + 2.0)  # of foot and top, where the front is nearest
    moved = np.abs(rows[1] - rows[0]).max()
    for shift in (0.02, 0.1, 0.3):
        _, looked, _ = divided(one(kind, y, radius, top), AHEAD, Shifts(100.0, shift, 100.0))
        assert looked[WIDTH // 2] >= needed(moved, shift)
        # The far edge of a top that is seen from above, too, but not more than that.
        assert looked[WIDTH // 2] <= 2 * needed(moved, shift)


@pytest.mark.parametrize("shift", [0.05, 0.3, 1.0])
@pytest.mark.parametrize("x", [-13.0, 0.0, 9.0])
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


def test_a_body_that_leaves_the_view_within_a_way_is_looked_at_until_it_has_left():
    way = AHEAD._replace(end_y=22.0)
    _, looked, (followed, before, after) = divided(
        one(POLE, 22.2, 0.3, 8.0, x=1.2), way, Shifts(0.5, 0.5, 0.5)
    )
    assert followed.tolist() == [0]
    assert before[0, 0] < WIDTH < after[0, 0]
    assert (looked[int(before[0, 0]) :] == 16).all()
    assert (looked[: int(before[0, 0])] == 1).all()


@pytest.mark.parametrize("kind", [POLE, CONE, ELLIPSOID, BOX])
def test_sharp_patterns_take_more_stretches_than_plain_bodies_and_moving_ones_more_still(kind):
    shifts, counts = Shifts(10.0, 0.05, 10.0), []
    for pattern, velocity in (("plain", 0.0), ("noise", 30.0), ("rings", 0.0), ("rings", 30.0)):
        texture = Texture(pattern, period_m=1.0, contrast=0.5, velocity_mps=(velocity, 0.0))
        scene = one(kind, 35.0, 1.0, 1.9, obstacle_texture=texture)
        counts.append(divided(scene, AHEAD, shifts)[0])
    assert counts[0] == counts[1] <= counts[2] < counts[3]


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
