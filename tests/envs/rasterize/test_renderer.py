import dataclasses
import gc
import pickle
import threading

import numpy as np
import pytest
import trimesh

from envs.rasterize import PyrenderRenderer
from envs.rasterize.renderer import FRAME
from envs.rasterize.shaders import SURFACES
from envs.raycast import RaycastRenderer
from envs.scene import OBSTACLE, Scene, Texture, make_scene
from envs.scene.obstacles import KINDS
from envs.scene.textures import PATTERNS

POSES = [
    (0, 0, 2, 0),
    (5, 20, 2, 0.4),
    (-8, 40, 3, -0.7),
    (0, 50, 12, 0.2),
    (30, 40, 9, 1.4),
    (0, 95, 2, 3.1),
    (12, 70, 0.5, -1.5),
]


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


def test_anti_aliasing_comes_closer_to_the_exact_picture(make, scene):
    exact = RaycastRenderer(scene, 64, 64)
    centres, smooth = make(samples=1), make()
    for pose in POSES[:4]:
        truth = exact.render(*pose)
        errors = [np.abs(renderer.render(*pose) - truth).mean() for renderer in (centres, smooth)]
        assert errors[1] < 0.4 * errors[0]
        assert errors[1] < 3e-3


def test_the_image_is_linear_float_and_finer_than_eight_bits(make, scene):
    image = make().render(0, 0, 2)
    assert image.shape == (64, 64)
    assert image.dtype == np.float32
    assert image[0, 32] == np.float32(scene.sky_luminance)
    assert image[-1, 32] == pytest.approx(float(scene.shade(scene.ground_albedo, (0, 0, 1))), abs=1e-6)
    assert np.abs(image * 255 - np.rint(image * 255)).max() > 0.1


@pytest.mark.parametrize("samples", [1, 2])
def test_every_pixel_lies_between_the_darkest_and_the_brightest_surface(make, samples):
    rng = np.random.default_rng(7)
    found = np.zeros(24, OBSTACLE)
    found["kind"] = np.arange(24) % len(KINDS)
    found["x"], found["y"] = (np.arange(24) % 4) * 6.0 - 9.0, (np.arange(24) // 4) * 12.0 + 8.0
    found["rx"] = found["ry"] = rng.uniform(0.05, 2.0, 24)
    found["rz"], found["albedo"] = rng.uniform(0.05, 3.0, 24), 0.4
    found["z"] = found["rz"] + rng.uniform(0.0, 3.0, 24) * (np.arange(24) % 3 > 0)
    looks = {
        key: Texture("noise", 1.0, 0.25) for key in ("ground_texture", "wall_texture", "obstacle_texture")
    }
    world = Scene(name="test", obstacles=found, **looks)
    darkest, brightest = 0.4 * 0.75 * world.ambient, 0.8 * 1.25
    renderer = make(scene=world, samples=samples)
    for _ in range(60):
        body = found[rng.integers(24)]
        at = [body[k] + rng.choice([0.0, 1e-6, 1e-3, 1.0, 3.0]) * rng.normal() for k in ("x", "y", "z")]
        image = renderer.render(at[0], at[1], abs(at[2]), rng.uniform(-10, 10), rng.uniform(-5, 5))
        assert np.isfinite(image).all()
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


def test_the_uniforms_lie_in_memory_as_the_shaders_expect(make):
    make()
    from OpenGL import GL

    from envs.rasterize.context import Program, start

    platform, _ = start(8, 8, False)
    with platform.current():
        for surface in range(len(SURFACES)):
            size, program = np.zeros(1, np.int32), Program(surface, PATTERNS.index("plain"))
            GL.glGetActiveUniformBlockiv(program._program_id, 0, GL.GL_UNIFORM_BLOCK_DATA_SIZE, size)
            assert size[0] == FRAME.itemsize
    platform.delete_context()


def test_rendering_twice_gives_the_same_bytes(make):
    one, two = make(), make()
    assert one.render(0, 30, 2).tobytes() == one.render(0, 30, 2).tobytes() == two.render(0, 30, 2).tobytes()


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


def test_textured_and_plain_scenes_share_a_renderer_and_two_renderers_a_scene(make, scene):
    plain, waves = Texture(), Texture("noise", 2.0, 0.5, (1.0, 0.0))
    worlds = [dataclasses.replace(scene, ground_texture=look) for look in (plain, waves)]
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
    np.testing.assert_array_equal(two.render(0, 10, 2, 0, 0.3), fresh[1])


def test_a_renderer_after_many_others_works(scene, make):
    expected = make().render(0, 10, 2)
    for _ in range(12):
        other = PyrenderRenderer(scene, 64, 64)
        np.testing.assert_array_equal(other.render(0, 10, 2), expected)
        other.close()


def test_scenes_follow_each_other_and_none_is_left_behind(make):
    worlds = [make_scene("poles", np.random.default_rng(seed)) for seed in range(3)]
    renderer = make()
    fresh = [make(scene=world).render(0, 10, 2) for world in worlds]
    for _ in range(2):
        for world, expected in zip(worlds, fresh, strict=True):
            renderer.set_scene(world)
            assert np.array_equal(renderer.render(0, 10, 2), expected)


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


LOOKS = {
    "plain": {},
    "moving checkers": {
        "ground_texture": Texture("checker", 2.0, 0.5, (1.0, 0.5)),
        "wall_texture": Texture("checker", 1.5, 0.25, (0.5, 0.0)),
        "obstacle_texture": Texture("checker", 0.5, 0.5, (1.0, 0.0)),
    },
    "moving noise": {
        key: Texture("noise", 1.5, 0.25, (1.0, 0.5))
        for key in ("ground_texture", "wall_texture", "obstacle_texture")
    },
}


@pytest.mark.benchmark
@pytest.mark.parametrize("look", LOOKS)
@pytest.mark.parametrize("kind", range(len(KINDS)), ids=KINDS)
@pytest.mark.parametrize("samples", [1, 2])
def test_a_frame_of_forty_bodies_takes_milliseconds(benchmark, make, scene, kind, look, samples):
    found = scene.obstacles.copy()
    found["kind"] = kind
    world = dataclasses.replace(scene, obstacles=found, **LOOKS[look])
    benchmark(make(scene=world, samples=samples).render, 0.3, 20.0, 2.0, 0.05, 0.1)
