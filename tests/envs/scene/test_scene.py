import dataclasses
import math
import pickle

import numpy as np
import pytest
import trimesh

from envs.scene import LAYOUTS, OBSTACLE, Layout, Scene, Texture, make_scene


def scene_of(*discs: tuple[float, float, float], **fields) -> Scene:
    poles = np.zeros(len(discs), OBSTACLE)
    for pole, (x, y, radius) in zip(poles, discs, strict=True):
        pole["x"], pole["y"], pole["rx"], pole["ry"], pole["z"], pole["rz"] = x, y, radius, radius, 4.0, 4.0
        pole["albedo"] = 0.25
    return Scene("hand", poles, **fields)


@pytest.mark.parametrize("name", ["poles", "gates", "spheres"])
def test_the_same_seed_gives_the_same_bytes(name):
    one, same, other = (make_scene(name, np.random.default_rng(seed)) for seed in (5, 5, 6))
    assert one.obstacles.tobytes() == same.obstacles.tobytes()
    assert one.obstacles.tobytes() != other.obstacles.tobytes()


@pytest.mark.parametrize("name", LAYOUTS)
def test_every_scene_has_ways_through_and_flying_straight_usually_fails(name):
    rng = np.random.default_rng(0)
    scenes = [make_scene(name, rng) for _ in range(40)]
    starts = rng.uniform(-10.0, 10.0, 40)
    hits = [scene.collides((x, 0.0), (x, 100.0), 0.3) for scene, x in zip(scenes, starts, strict=True)]
    assert 0.7 < np.mean(hits) <= 1.0


def test_a_corridor_that_is_not_passable_is_drawn_again_from_the_same_generator(monkeypatch):
    first, second = (make_scene("poles", rng) for rng in [np.random.default_rng(1)] * 2)
    answers = iter([False, True])
    monkeypatch.setattr(Scene, "passable", lambda *_: next(answers))
    scene = make_scene("poles", np.random.default_rng(1))
    assert scene.obstacles.tobytes() == second.obstacles.tobytes() != first.obstacles.tobytes()
    monkeypatch.setattr(Scene, "passable", lambda *_: False)
    scene = make_scene("poles", np.random.default_rng(1), passable=False)
    assert scene.obstacles.tobytes() == first.obstacles.tobytes()


def test_a_layout_that_is_never_passable_is_refused_with_its_remedies():
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match=r"scene 'poles' .*radius 4.0 m.*min_gap_m.*passable to false"):
        make_scene("poles", rng, 4.0)
    assert not make_scene("poles", rng, 4.0, passable=False).passable(4.0)
    make_scene("poles", rng, 4.0, 9.0)  # above the poles
    for vehicle in ((math.nan, 2.0), (-0.1, 2.0), (0.3, math.inf)):
        with pytest.raises(ValueError, match="vehicle radius"):
            make_scene("poles", rng, *vehicle)


def test_an_own_layout_is_a_scene_like_any_other_and_overrides_replace_its_values(monkeypatch):
    monkeypatch.setitem(LAYOUTS, "forest", Layout(num_obstacles=50, radius_min_m=0.2))
    scene = make_scene("forest", np.random.default_rng(0), num_obstacles=3.0, width_m=40)
    assert (scene.name, len(scene.obstacles), scene.width_m) == ("forest", 3, 40.0)


@pytest.mark.parametrize(
    ("name", "overrides", "message"),
    [
        ("caves", {}, "poles_eval.*mesh file, got 'caves'"),
        ("", {}, "mesh file, got ''"),
        ("poles", {"pole_count": 3}, "num_obstacles"),
        ("poles", {"vehicle_radius_m": 3}, "has no 'vehicle_radius_m'; it has .* height_m"),
    ],
)
def test_a_scene_that_cannot_be_is_refused_by_name(name, overrides, message):
    with pytest.raises(ValueError, match=message):
        make_scene(name, np.random.default_rng(0), **overrides)


def test_sections_are_remembered_for_a_few_heights_only():
    scene = scene_of((0.0, 10.0, 0.5))
    first = scene.sections(2.0)
    assert scene.sections(2.0) is first
    others = {len(scene.sections(0.1 * k)) for k in range(80)}
    assert (others, len(scene.sections(9.0))) == ({1}, 0)
    assert scene.sections(2.0) is not first  # so many other heights have pushed it out
    with pytest.raises(ValueError, match="read-only"):
        scene.sections(2.0)[0] = 0.0


CHECKER = Texture("checker", contrast=0.5)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"width_m": math.nan}, "width_m"),
        ({"wall_height_m": math.inf}, "wall_height_m"),
        ({"walls_y_m": (5.0, 5.0)}, "walls_y_m"),
        ({"spawn_range_m": (-math.inf, 1.0)}, "spawn_range_m"),
        ({"sun": (0.4, -0.5, 0.5)}, "unit vector"),
        ({"ambient": -0.1}, "ambient"),
        ({"diffuse": 0.7}, "diffuse"),
        ({"ground_albedo": math.nan}, "ground_albedo"),
        ({"wall_albedo": 0.7, "wall_texture": CHECKER}, "wall_albedo=0.7.*wall_texture"),
    ],
)
def test_a_corridor_that_cannot_be_is_refused(fields, message):
    with pytest.raises(ValueError, match=f"scene 'hand'.*{message}"):
        scene_of(**fields)
    for plain in (Texture("checker", contrast=0.0), Texture("plain", contrast=0.5)):
        scene_of(wall_albedo=1.0, wall_texture=plain)


def test_a_scene_cannot_be_changed_and_survives_pickling():
    scene = scene_of((0.0, 10.0, 0.5))
    with pytest.raises(ValueError, match="read-only"):
        scene.obstacles["x"] = 1.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        scene.width_m = 1.0
    way = (0.0, 0.0), (0.0, 20.0), 0.5
    assert pickle.loads(pickle.dumps(scene)).first_contact(*way) == scene.first_contact(*way) < 1.0
    with pytest.raises(ValueError, match="OBSTACLE"):
        Scene("hand", np.zeros(3))


@pytest.mark.parametrize(
    ("a", "b", "radius", "height"),
    [
        ((0, math.nan), (0, 1), 0.3, 2),
        ((0, 0), (math.inf, 1), 0.3, 2),
        ((0, 0), (0, 1), math.inf, 2),
        ((0, 0), (0, 1), -0.1, 2),
        ((0, 0), (0, 1), 0.3, math.nan),
    ],
)
def test_a_flight_to_nowhere_is_refused(a, b, radius, height):
    with pytest.raises(ValueError, match="finite, radius >= 0"):
        scene_of().first_contact(a, b, radius, height)


def test_surfaces_follow_the_law_of_lambert():
    scene = scene_of()
    assert scene.shade(0.5, scene.sun) == pytest.approx(0.5)
    assert scene.shade(0.5, [-s for s in scene.sun]) == pytest.approx(0.5 * scene.ambient)
    assert np.linalg.norm(scene.sun) == pytest.approx(1.0)


def box_file(folder, size=(2.0, 1.0, 4.0), at=(0.0, 30.0, 2.0)):
    path = folder / "box.stl"
    trimesh.creation.box(size).apply_translation(at).export(path)
    return str(path)


def test_a_mesh_file_stands_in_the_lane_and_is_hit_at_the_height_of_the_flight(tmp_path):
    scene = make_scene(box_file(tmp_path), np.random.default_rng(0), wall_height_m=3)
    assert (scene.wall_height_m, len(scene.obstacles)) == (3.0, 0)
    for x, height, contact in (
        (0.0, 2.0, 0.292),
        (0.0, 4.0, 0.292),
        (0.0, 4.001, math.inf),
        (1.31, 2.0, math.inf),
    ):
        found = scene.first_contact((x, 0.0), (x, 100.0), 0.3, height)  # the box's front is at 29.5 m
        assert found == pytest.approx(contact)


def test_a_mesh_is_shaded_flat_by_the_law_of_lambert(tmp_path):
    scene = make_scene(box_file(tmp_path), np.random.default_rng(0))
    vertices, faces, luminance = scene.mesh
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward = corners.mean(axis=1) - (0.0, 30.0, 2.0)
    assert ((normals * outward).sum(axis=1) > 0).all()
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    assert luminance[faces] == pytest.approx(np.repeat(scene.shade(0.25, normals)[:, None], 3, axis=1))


def test_a_mesh_file_is_read_once_and_again_when_it_has_changed(tmp_path):
    path = box_file(tmp_path)
    first = make_scene(path, np.random.default_rng(0))
    assert make_scene(path, np.random.default_rng(1)) is first
    box_file(tmp_path, size=(2.0, 3.0, 4.0), at=(0.0, 30.0, 2.5))
    (tmp_path / "box.stl").touch()
    changed = make_scene(path, np.random.default_rng(0))
    assert changed.first_contact((0, 0), (0, 100), 0.0) == pytest.approx(0.285)


def test_a_mesh_file_may_be_scaled_and_has_to_be_passable(tmp_path):
    path, rng = box_file(tmp_path, at=(0.0, 5.0, 2.0)), np.random.default_rng(0)
    assert make_scene(path, rng, scale=0.5).first_contact((0, 0), (0, 100), 0.0, 1.0) == pytest.approx(0.0225)
    with pytest.raises(ValueError, match=r"no corridor.*scale.*passable to false"):
        make_scene(path, rng, scale=14.5)
    assert make_scene(path, rng, scale=14.5, passable=False).mesh[0][:, 0].max() == pytest.approx(14.5)
    for name, value in (("scale", 0), ("width_m", 20), ("num_obstacles", 3)):
        with pytest.raises(ValueError, match=name):
            make_scene(path, rng, **{name: value})
