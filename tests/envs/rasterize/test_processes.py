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


@pytest.mark.parametrize(
    "code",
    [
        "import envs.rasterize.renderer",
        "import envs.corridor; env = envs.corridor.CorridorEnv(); env.reset(seed=0); env.step(0)",
    ],
)
def test_neither_importing_the_renderer_nor_a_scene_without_a_mesh_loads_opengl(code):
    heavy = "('OpenGL', 'pyrender', 'trimesh')"
    code += f"; import sys; sys.exit(any(m in sys.modules for m in {heavy}))"
    assert run_python(code).returncode == 0


BLOCKED = """
import ctypes, sys
load = ctypes.CDLL.__init__
def blocked(self, name, *args, **keywords):
    if name and str(name).split('/')[-1].split('.')[0] in ('{library}', 'lib{library}'):
        raise OSError(f'{{name}}: cannot open shared object file: No such file or directory')
    load(self, name, *args, **keywords)
ctypes.CDLL.__init__ = blocked
"""
NO_DEVICE = "import os, sys; os.environ['EGL_DEVICE_ID'] = '999'"


@pytest.mark.parametrize(
    ("fault", "system", "remedy"),
    [
        (BLOCKED.format(library="EGL"), "linux", PACKAGES),
        (BLOCKED.format(library="GL"), "linux", PACKAGES),
        (BLOCKED.format(library="EGL"), "darwin", "use renderer=raycast"),
        (NO_DEVICE, "linux", "Invalid device ID"),
    ],
)
def test_a_missing_system_library_or_device_is_one_line_that_names_it_or_its_remedy(fault, system, remedy):
    code = f"""
{fault}
from envs.rasterize import PyrenderRenderer
from envs.scene import make_scene
import numpy as np
sys.platform = '{system}'
try:
    PyrenderRenderer(make_scene('poles', np.random.default_rng(0)), 8, 8)
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
