import dataclasses
import gc
import pickle
import threading

import numpy as np
import pytest
import trimesh

from envs.rasterize import PyrenderRenderer
from envs.scene import OBSTACLE, Scene, Texture, make_scene
from envs.scene.obstacles import KINDS


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene("poles", np.random.default_rng(3))


@pytest.fixture
def make(scene):
    made = []

    def build(**keywords) -> PyrenderRenderer:
        try:
            made.append(PyrenderRenderer(keywords.pop("scene", scene), 64, 64, **keywords))
        except RuntimeError as error:
            pytest.skip(str(error))
        return made[-1]

    yield build
    for renderer in made:
        renderer.close()


def test_every_pixel_lies_between_the_darkest_and_the_brightest_surface(make):
    rng = np.random.default_rng(7)
    found = np.zeros(24, OBSTACLE)
    found["kind"] = np.arange(24) % len(KINDS)
    found["x"], found["y"] = (np.arange(24) % 4) * 6.0 - 9.0, (np.arange(24) // 4) * 12.0 + 8.0
    found["rx"] = found["ry"] = rng.uniform(0.05, 2.0, 24)
    found["rz"], found["albedo"] = rng.uniform(0.05, 3.0, 24), 0.4
    found["z"] = found["rz"] + rng.uniform(0.0, 3.0, 24) * (np.arange(24) % 3 > 0)
    surfaces = ("ground_texture", "wall_texture", "obstacle_texture")
    looks = dict.fromkeys(surfaces, Texture("noise", 1.0, 0.25))
    world = Scene(name="test", obstacles=found, **looks)
    darkest, brightest = 0.4 * 0.75 * world.ambient, 0.8 * 1.25
    renderer = make(scene=world, samples=2)
    for _ in range(60):
        body = found[rng.integers(24)]
        at = [body[k] + rng.choice([0.0, 1e-6, 1e-3, 1.0, 3.0]) * rng.normal() for k in ("x", "y", "z")]
        image = renderer.render(at[0], at[1], abs(at[2]), rng.uniform(-10, 10), rng.uniform(-5, 5))
        assert image.dtype == np.float32
        assert darkest - 1e-5 <= image.min() <= image.max() <= brightest + 1e-5


def test_a_bad_pose_is_refused_and_leaves_the_renderer_working(make):
    renderer = make()
    before = renderer.render(0, 10, 2)
    for bad in ((np.nan, 0, 2), (0, 0, -0.1), (0, 2e6, 2), (0, 0, 2, np.inf)):
        with pytest.raises(ValueError, match="pose"):
            renderer.render(*bad)
    with pytest.raises(ValueError, match="t_s"):
        renderer.render(0, 10, 2, 0, np.nan)
    np.testing.assert_array_equal(renderer.render(0, 10, 2), before)


def test_an_image_too_large_for_opengl_is_one_line(make, scene):
    make()
    with pytest.raises(RuntimeError, match="OpenGL failed") as caught:
        PyrenderRenderer(scene, 100_000, 4)
    assert "\n" not in str(caught.value)


def test_pyrender_finds_the_name_that_numpy_2_removed(make):
    make()
    import pyrender

    low, high = pyrender.Mesh.from_trimesh(trimesh.creation.box((1.0, 2.0, 3.0))).bounds
    assert (high - low).tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize("end", ["close", "collected"])
def test_the_end_of_one_renderer_leaves_the_others_working(make, scene, end):
    keep = make()
    before = keep.render(1, 10, 2)
    other = PyrenderRenderer(scene, 32, 32)
    other.render(0, 0, 2)
    if end == "close":
        other.close()
        other.close()
        with pytest.raises(RuntimeError, match="closed"):
            other.render(0, 0, 2)
    del other
    assert np.array_equal(keep.render(1, 10, 2), before)
    assert np.array_equal(make().render(1, 10, 2), before)


def test_a_renderer_collected_while_another_draws_takes_nothing_from_it(make):
    keep = make()
    before = keep.render(1, 10, 2)
    from envs.rasterize.context import start

    platform, other = start(64, 64, True)
    platform.delete_context()
    with keep._platform.current():
        del other
        gc.collect()
    np.testing.assert_array_equal(keep.render(1, 10, 2), before)


def test_threads_render_with_their_own_renderer_and_with_one_made_elsewhere(make, scene):
    shared = make()
    expected = shared.render(0, 20, 2)
    results = {}

    def work(key: str, renderer: PyrenderRenderer | None) -> None:
        own = renderer or PyrenderRenderer(scene, 64, 64)
        results[key] = own.render(0, 20, 2)
        if renderer is None:
            own.close()

    for key, renderer in (("own", None), ("shared", shared)):
        thread = threading.Thread(target=work, args=(key, renderer))
        thread.start()
        thread.join()
    assert np.array_equal(results["own"], expected)
    assert np.array_equal(results["shared"], expected)


def test_scenes_follow_each_other_textured_or_not_in_renderers_side_by_side(make, scene):
    waves = Texture("noise", 2.0, 0.5, (1.0, 0.0))
    worlds = [
        scene,
        dataclasses.replace(scene, ground_texture=waves),
        make_scene("poles", np.random.default_rng(4)),
    ]
    fresh = [make(scene=world).render(0, 10, 2, 0, 0.3) for world in worlds]
    assert np.abs(fresh[0] - fresh[1]).mean() > 0.01
    one, two = make(), make()
    for _ in range(2):
        for world, expected in zip(worlds, fresh, strict=True):
            for renderer in (one, two):
                renderer.set_scene(world)
            for renderer in (one, two):
                np.testing.assert_array_equal(renderer.render(0, 10, 2, 0, 0.3), expected)
    one.close()
    np.testing.assert_array_equal(two.render(0, 10, 2, 0, 0.3), fresh[2])


def test_a_failure_of_opengl_can_be_pickled(make, monkeypatch):
    renderer = make()
    monkeypatch.setattr("envs.rasterize.context.Platform.make_current", _raise_gl_error)
    with pytest.raises(RuntimeError, match="OpenGL failed") as caught:
        renderer.render(0, 0, 2)
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)
    monkeypatch.undo()


def _raise_gl_error(_platform: object) -> None:
    from OpenGL.error import GLError

    raise GLError(12290, "bad access", baseOperation=None)
