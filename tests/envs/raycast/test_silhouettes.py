import math

import numpy as np
import pytest

from envs.raycast import RaycastRenderer
from envs.raycast.silhouettes import (
    Shifts,
    Stretch,
    Way,
    aim_along,
    divide_time,
    find_looks,
    find_silhouettes,
    make_looks,
)
from envs.scene import make_scene

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
    """`find_silhouettes` at the begin and at the end of the way, each (N, 4)."""
    renderer.room.frames[0] = renderer.frame[0]
    ends = [np.empty((len(renderer.bodies), 4)) for _ in WHOLE]
    for t_us, found in zip(WHOLE, ends, strict=True):
        aim_along(renderer.room.frames[0], WAY, t_us)
        find_silhouettes(renderer.bodies, WIDTH, math.inf, renderer.room, found)
    return ends


def looks_of(scene):
    """Times, and first and last columns, of the looks before the end of the way, and the outlines' ends."""
    renderer = RaycastRenderer(scene, WIDTH, 48)
    looks, ends = make_looks(WIDTH), ends_of(scene, renderer)
    looks.every[:] = 1
    count = find_looks(renderer.bodies, WAY, Stretch(1, *WHOLE, *ends), renderer.room, looks) - 1
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
    for body, side in np.argwhere(np.isfinite(ends[0] + ends[1])[:, :2]):
        for border in range(1, WIDTH):
            if (ends[0][body, side] - border) * (ends[1][body, side] - border) >= 0.0:
                continue
            near = (first == border - 1) & (last == border + 1)
            at = [abs(places(scene, t_us)[body, side] - border) for t_us in times[near]]
            assert min(at, default=math.inf) < 1e-3
            passed += 1
    assert passed > 5


def test_silhouettes_are_where_angles_put_them():
    scene = make_scene("poles", np.random.default_rng(1))
    _, _, _, (start, _) = looks_of(scene)
    seen = np.isfinite(start[:, 0])
    inside = seen & (start[:, 0] > 0) & (start[:, 1] < WIDTH)
    assert inside.sum() > 5
    np.testing.assert_allclose(start[inside, :2], places(scene, WAY.start_us)[inside], atol=1e-9)
    assert (start[seen] >= -2.0).all()
    assert (start[seen] <= WIDTH + 2.0).all()


def test_a_scene_without_bodies_takes_no_look():
    scene = make_scene("poles", np.random.default_rng(0), num_obstacles=0)
    assert looks_of(scene)[0].size == 0


@pytest.mark.parametrize("name", ["poles", "gates", "cones", "shape_change"])
@pytest.mark.parametrize("shift", [0.02, 0.1, 0.5])
def test_outlines_move_little_in_each_stretch_of_their_columns(name, shift):
    scene = make_scene(name, np.random.default_rng(2))
    renderer, looks = RaycastRenderer(scene, WIDTH, 48), make_looks(WIDTH)
    start, end = ends_of(scene, renderer)
    shifts = Shifts(4.0 * shift, 2.0 * shift, shift)
    stretches = divide_time(renderer.bodies, start, end, shifts, 10**6, looks)
    assert stretches in (1, 2, 4, 8, 16)
    assert (stretches % looks.every == 0).all()
    allowed = {"poles": 4.0, "gates": 2.0}.get(name, 1.0) * shift  # posts of a gate may move farther
    moved = np.nan_to_num(np.abs(end - start)).max(axis=1)
    needed = np.ones(WIDTH)
    for body in np.argwhere(moved > allowed)[:, 0]:
        low, high = min(start[body, 0], end[body, 0]), max(start[body, 1], end[body, 1])
        columns = slice(max(0, int(low)), max(0, int(high) + 1))
        needed[columns] = np.maximum(needed[columns], np.ceil(moved[body] / allowed))
        if name != "gates" and moved[body] / allowed <= 16.0:
            assert (stretches / looks.every[columns] * allowed >= moved[body]).all()
    # Twice as often as needed at most, and never where nothing moves much.
    assert (stretches / looks.every <= np.maximum(1.0, 2.0 * needed)).all()


def test_no_stretch_is_shorter_than_the_clock_and_slow_columns_wait_for_the_last():
    scene = make_scene("cones", np.random.default_rng(2))
    renderer, looks = RaycastRenderer(scene, WIDTH, 48), make_looks(WIDTH)
    ends, shifts = ends_of(scene, renderer), Shifts(0.04, 0.02, 0.01)
    assert divide_time(renderer.bodies, *ends, shifts, 3, looks) == 2
    stretches = divide_time(renderer.bodies, *ends, shifts, 10**6, looks)
    looked = np.zeros(WIDTH, int)
    for number in range(1, stretches + 1):
        t_us = WHOLE[0] + (WHOLE[1] - WHOLE[0]) * number // stretches
        count = find_looks(renderer.bodies, WAY, Stretch(number, t_us - 2, t_us, *ends), renderer.room, looks)
        for k in np.flatnonzero(looks.t_us[:count] == t_us):
            looked[looks.first[k] : looks.last[k]] += 1
    np.testing.assert_array_equal(looked, stretches // looks.every)
    assert stretches == looked.max() > looked.min()
