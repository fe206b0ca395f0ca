import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from envs.rasterize import PyrenderRenderer
from envs.rasterize.renderer import PACKAGES
from envs.scene import make_scene
from tests.support.patience import HANG_S
from tests.support.rendering import POSE, picture

pytestmark = pytest.mark.system
ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="module")
def expected():
    try:
        return picture()
    except RuntimeError as error:
        pytest.skip(str(error))


def run_python(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=HANG_S
    )


def test_importing_the_renderer_loads_no_opengl():
    heavy = "('OpenGL', 'pyrender', 'trimesh')"
    code = f"import sys, envs.rasterize.renderer; sys.exit(any(m in sys.modules for m in {heavy}))"
    assert run_python(code).returncode == 0


@pytest.mark.parametrize(
    ("library", "system", "remedy"),
    [("EGL", "linux", PACKAGES), ("GL", "linux", PACKAGES), ("EGL", "darwin", "use renderer=raycast")],
)
def test_a_missing_system_library_is_one_line_that_names_the_remedy(library, system, remedy):
    code = f"""
import ctypes, ctypes.util, sys
import numpy as np
load, find = ctypes.CDLL.__init__, ctypes.util.find_library
def blocked(self, name, *args, **keywords):
    if name and str(name).split('/')[-1].split('.')[0] in ('{library}', 'lib{library}'):
        raise OSError(f'{{name}}: cannot open shared object file: No such file or directory')
    load(self, name, *args, **keywords)
ctypes.CDLL.__init__ = blocked
from envs.rasterize import PyrenderRenderer
from envs.scene import OBSTACLE, Scene
sys.platform = '{system}'
try:
    PyrenderRenderer(Scene('empty', np.zeros(0, OBSTACLE)), 8, 8)
except RuntimeError as error:
    print(error)
"""
    result = run_python(code)
    assert remedy in result.stdout, result.stderr
    assert len(result.stdout.strip().splitlines()) == 1


def test_a_forked_child_renders_beside_its_parent(expected):
    code = f"""
import os, sys
import numpy as np
from tests.support.rendering import POSE, picture
from envs.rasterize import PyrenderRenderer
from envs.scene import make_scene
parent = PyrenderRenderer(make_scene('poles', np.random.default_rng(1)), 64, 64)
before = parent.render(*POSE)
child = os.fork()
if child == 0:
    os._exit(0 if np.array_equal(picture(), before) else 3)
status = os.waitpid(child, 0)[1]
same = np.array_equal(parent.render(*POSE), before)
sys.exit(0 if status == 0 and same and before.tobytes().hex() == '{expected.tobytes().hex()}' else 1)
"""
    assert run_python(code).returncode == 0


def test_a_device_that_is_not_there_is_one_line():
    code = """
import os
os.environ['EGL_DEVICE_ID'] = '999'
import numpy as np
from envs.rasterize import PyrenderRenderer
from envs.scene import OBSTACLE, Scene
try:
    PyrenderRenderer(Scene('empty', np.zeros(0, OBSTACLE)), 8, 8)
except RuntimeError as error:
    print(error)
"""
    result = run_python(code)
    assert "Invalid device ID" in result.stdout, result.stderr
    assert len(result.stdout.strip().splitlines()) == 1


@pytest.mark.slow
def test_workers_of_ray_draw_the_same_bytes_at_the_same_time(expected, tmp_path):
    ray = pytest.importorskip("ray")
    from jobs.config.schema import ClusterConfig
    from jobs.run.ray_cluster import start_ray

    class Worker:
        def draw(self, times: int) -> list[bytes]:
            scene = make_scene("poles", np.random.default_rng(1))
            renderers = [PyrenderRenderer(scene, 64, 64) for _ in range(2)]
            return [renderer.render(*POSE).tobytes() for _ in range(times) for renderer in renderers]

    ray.shutdown()  # one that an earlier test has left may have too few cores, and be waited for forever
    start_ray(ClusterConfig(name="local", address=None, num_cpus=3, storage=None), tmp_path)
    try:
        workers = [ray.remote(num_cpus=1)(Worker).remote() for _ in range(3)]
        for pictures in ray.get([worker.draw.remote(20) for worker in workers]):
            assert set(pictures) == {expected.tobytes()}
    finally:
        ray.shutdown()
