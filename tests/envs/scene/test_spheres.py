"""Worlds of spheres: files of the DodgeDrone challenge, and its generator."""

import os
from pathlib import Path

import numpy as np
import pytest

from envs.config import EnvConfig
from envs.corridor import CorridorEnv
from envs.scene import make_scene
from envs.scene.layouts import SphereLayout
from envs.scene.spheres import REGIONS, about, drawn_spheres, read_moving, read_spheres

FOREIGN = Path(os.environ.get("EVADE_DATA", "../shared/data"), "dodgedrone")
NO_FOREIGN = f"foreign worlds are not in {FOREIGN}: set EVADE_DATA"
ROW = "rpg_box01, 12.5, -3.0, 2.25, 0.8, 0.3, -0.4, -0.1, 1.5, 1.5, 1.5\n"


def written(tmp_path, text):
    file = tmp_path / "world.csv"
    file.write_text(text)
    return str(file)


def test_their_x_is_our_y_their_left_is_our_minus_x_and_half_the_scale_is_the_radius(tmp_path):
    (sphere,) = read_spheres(written(tmp_path, ROW), (0, 0))
    assert (sphere["x"], sphere["y"], sphere["z"]) == (3.0, 12.5, 2.25)
    assert sphere["rx"] == sphere["ry"] == sphere["rz"] == 0.75


def test_removed_spheres_and_a_heading_are_left_out(tmp_path):
    head = "prefab,x,y,z,qw,qx,qy,qz,sx,sy,sz\n"
    removed = "rpg_box01, 1000, 1000, 1000, 1, 0, 0, 0, 2, 2, 2\n"
    scene = make_scene(written(tmp_path, head + removed + ROW + "\n" + ROW), np.random.default_rng(0))
    assert len(scene.obstacles) == 2
    again = make_scene(written(tmp_path, ROW), np.random.default_rng(0))
    assert len(again.obstacles) == 1, "a world is read anew when its file changes"


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        (ROW + ROW.replace("1.5, 1.5\n", "1.5, 1.6\n"), "line 2: sx, sy and sz must be equal"),
        (ROW.replace("12.5", "nan"), "line 1: numbers must be finite"),
        (ROW.replace("12.5", "1e6"), "within 100000"),
        (ROW.replace("12.5", "far"), "must have numbers"),
        (ROW.replace(", 1.5\n", "\n"), "must have the 11 values prefab, x, y"),
        (ROW.replace("1.5", "0.0"), "above 0"),
    ],
)
def test_a_row_that_cannot_be_drawn_is_refused_by_its_line(tmp_path, text, rule):
    with pytest.raises(ValueError, match=rule):
        make_scene(written(tmp_path, text), np.random.default_rng(0))


def test_a_file_that_is_not_there_and_spheres_that_move_are_refused(tmp_path):
    with pytest.raises(ValueError, match="no such file"):
        make_scene("nowhere.csv", np.random.default_rng(0))
    with pytest.raises(ValueError, match="moving: must be false without dynamic"):
        make_scene(written(tmp_path, ROW), np.random.default_rng(0), moving=True)


def test_the_generator_draws_the_challenge_s_densities_and_leaves_its_zones_free():
    counts = []
    for seed in range(10):
        spheres = drawn_spheres(SphereLayout(), np.random.default_rng(seed))
        counts.append(len(spheres))
        ends = (spheres["y"] < 3.0) | (spheres["y"] > 57.0)
        low = (np.abs(spheres["x"]) < 3.0) & (spheres["z"] < 5.0)
        assert not (ends & low).any()
        assert np.abs(spheres["x"]).max() <= 10.0
        assert 0.05 <= spheres["rx"].min() <= spheres["rx"].max() <= 1.5
    whole = sum(density * 20.0 * (last - first) for density, first, last in REGIONS)
    assert whole == pytest.approx(468)
    free = (3.0 + 3.0) * 6.0 * 5.0 / (60.0 * 20.0 * 10.0)  # of the volume; the last zone is dense
    assert 468 * (1 - 3 * free) < np.mean(counts) < 468
    assert len(drawn_spheres(SphereLayout(density=2.0), np.random.default_rng(0))) > 1.9 * min(counts)


def test_what_the_camera_does_not_draw_as_it_is_is_counted(tmp_path):
    near = ROW.replace("12.5", "13.9")  # 1.4 m apart, radii of 0.75 m
    low = ROW.replace("2.25", "0.5").replace("12.5", "40.0")
    spheres = read_spheres(written(tmp_path, ROW + near + low), (2, 2))
    assert about(spheres) == (3, 1, 1)


def test_an_episode_in_a_file_s_world_ends_at_its_goal(tmp_path):
    file = written(tmp_path, ROW)
    config = EnvConfig(scene=file, layout={"spawn_half_m": 0.0, "length_m": 5.0}, observation="none")
    env = CorridorEnv(config)
    env.reset(seed=0)
    over, steps = False, 0
    while not over:
        _, _, terminated, truncated, info = env.step(0)
        over, steps = terminated or truncated, steps + 1
    assert info["success"]
    assert steps == 50
    assert env.scene.spawn_range_m == (0.0, 0.0)


def moving_world(tmp_path, rows, loop="false", scale="1.0"):
    (tmp_path / "csvtrajs").mkdir(exist_ok=True)
    text = "\n".join(", ".join(map(str, (*row, 1, 0, 0, 0))) for row in rows)
    (tmp_path / "csvtrajs" / "one.csv").write_text(f"# header\n{text}\n")
    said = f"Object1:\n  csvtraj: one\n  loop: {loop}\n  prefab: rpg_box01\n  scale: [1.0, 1.0, {scale}]\n"
    file = tmp_path / "dynamic_obstacles.yaml"
    file.write_text(f"N: 1\n{said}")
    return str(file)


def test_a_recorded_path_is_followed_and_a_straight_one_needs_its_ends_alone(tmp_path):
    times = np.arange(0.0, 2.001, 0.02)
    rng = np.random.default_rng(0)
    for wild in (0.0, 1.0):
        x = 10.0 + 0.5 * times + wild * rng.uniform(-1, 1, times.size).cumsum()
        rows = np.stack([times, x, 3.0 - times, np.full(times.size, 2.5)], axis=1)
        (body,) = read_moving(moving_world(tmp_path, rows), (int(wild), 0))
        assert len(body.t_s) == (times.size if wild else 2)
        assert body.body["rx"] == 0.5
        some = rows[::7]
        told = np.stack([-some[:, 2], some[:, 1], some[:, 3]], axis=1)
        assert np.abs(body.places(some[:, 0]) - told).max() < 1e-9
        assert np.array_equal(*body.places(np.array([9.0, 2.0])))


def test_a_moving_world_that_cannot_be_read_is_refused(tmp_path):
    file = moving_world(tmp_path, [(0, 1, 2, 3), (1, 2, 2, 3)], scale="2.0")
    with pytest.raises(ValueError, match="Object1: scale must be equal"):
        read_moving(file, (0, 0))
    (tmp_path / "csvtrajs" / "one.csv").unlink()
    with pytest.raises(ValueError, match="cannot be read"):
        read_moving(moving_world(tmp_path, [(0, 1, 2, 3)]).replace("dynamic", "no"), (1, 1))
    with pytest.raises(ValueError, match="moving"):
        make_scene("spheres", np.random.default_rng(0), moving=True)


@pytest.mark.skipif(not FOREIGN.is_dir(), reason=NO_FOREIGN)
def test_the_official_world_and_the_planners_layouts_are_read_and_have_ways_through():
    file = FOREIGN / "official" / "static_obstacles.csv"
    scene = make_scene(str(file), np.random.default_rng(0), 0.3, 5.0)
    assert about(scene.obstacles)[0] == 988
    assert scene.passable(0.3, 5.0)
    assert scene.passable(0.0, 4.0)
    assert not scene.passable(0.3, 2.0)
    assert len(read_moving(str(file.with_name("dynamic_obstacles.yaml")), (0, 0))) == 132
    easy = sorted((FOREIGN / "dess").glob("*/*/static_obstacles.csv"))
    assert len(easy) == 18
    for one in easy:
        world = make_scene(str(one), np.random.default_rng(0), 0.3, 5.0, length_m=15.0, passable=False)
        assert about(world.obstacles).spheres >= 20
