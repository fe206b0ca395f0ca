import math

import numpy as np
import pytest

from envs.raycast import RaycastRenderer
from envs.raycast.silhouettes import Stretch, Way, aim_along, find_looks, find_silhouettes, make_looks
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


def looks_of(scene):
    """Times, and first and last columns, of the looks along the whole way."""
    renderer = RaycastRenderer(scene, WIDTH, 48)
    room, looks = renderer.room, make_looks(WIDTH)
    room.frames[0] = renderer.frame[0]
    ends = []
    for t_us in WHOLE:
        aim_along(room.frames[0], WAY, t_us)
        ends.append(np.empty((len(renderer.bodies), 2)))
        find_silhouettes(renderer.bodies, WIDTH, math.inf, room, ends[-1])
    count = find_looks(renderer.bodies, WAY, Stretch(*WHOLE, *ends), room, looks)
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
    for body, side in np.argwhere(np.isfinite(ends[0] + ends[1])):
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
    np.testing.assert_allclose(start[inside], places(scene, WAY.start_us)[inside], atol=1e-9)
    assert (start[seen] >= -2.0).all()
    assert (start[seen] <= WIDTH + 2.0).all()


def test_a_scene_without_bodies_takes_no_look():
    scene = make_scene("poles", np.random.default_rng(0), num_obstacles=0)
    assert looks_of(scene)[0].size == 0
