import math

import numpy as np
import pytest

from envs.config import EnvConfig
from envs.corridor import CorridorEnv
from envs.scene.obstacles import OBSTACLE
from research.sight import fly, in_sight, rows_of

ROW = "rpg_box02,{},{},{},1,0,0,0,{},{},{}"


def spheres(*places, radius=0.5):
    """OBSTACLE spheres about these places."""
    found = np.zeros(len(places), OBSTACLE)
    found["x"], found["y"], found["z"] = np.array(places, float).T
    found["rx"] = found["ry"] = found["rz"] = radius
    return found


@pytest.mark.parametrize(
    ("place", "radius", "sight_m", "view_deg", "seen"),
    [
        ((0, 4, 2), 0.5, 3.5, 90, True),
        ((0, 4, 2), 0.5, 3.4, 90, False),
        ((0, -4, 2), 0.5, math.inf, 180, False),
        ((4, 0, 2), 0.5, math.inf, 180, True),
        ((4, 0, 2), 0.5, math.inf, 150, False),
        ((0, 0, 5), 0.6, 2.5, 90, True),  # above, and all around
        ((3, 3, 2), 0.5, math.inf, 90, True),
        ((4, 3, 2), 0.5, math.inf, 90, False),
    ],
)
def test_a_sphere_is_in_sight_where_a_part_of_it_is_near_and_in_view(place, radius, sight_m, view_deg, seen):
    assert in_sight(spheres(place, radius=radius), (0, 0, 2), sight_m, view_deg).tolist() == [seen]


def test_who_sees_farther_or_wider_sees_no_sphere_less():
    rng = np.random.default_rng(0)
    every = spheres(*rng.uniform(-9, 9, (2000, 3)))
    for view_deg in (60, 120, 180):
        for sight_m in (2.0, 5.0, math.inf):
            seen = in_sight(every, (0, 0, 0), sight_m, view_deg)
            assert in_sight(every, (0, 0, 0), 2 * sight_m, view_deg)[seen].all()
            assert in_sight(every, (0, 0, 0), sight_m, 1.5 * view_deg)[seen].all()
            assert 0 < seen.sum() < 2000


def test_a_wall_of_spheres_that_is_seen_late_is_hit_and_seen_early_is_flown_around(tmp_path):
    world = tmp_path / "world.csv"
    rows = [ROW.format(20, 0.4 * across, 2, 1, 1, 1) for across in range(-8, 9)]
    world.write_text("\n".join(rows) + "\n")
    config = EnvConfig(scene=str(world), layout={"passable": False}, speed_mps=10.0, control_hz=50.0,
                       vehicle_radius_m=0.0, observation="none")  # fmt: skip
    env = CorridorEnv(config)
    assert [fly(env, 0, sight_m, 180.0) for sight_m in (1.0, 15.0)] == [False, True]
    assert len(rows_of(world, 0.0, 1)) == 12
