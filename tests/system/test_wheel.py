"""The wheel: what is in it, and that it works without the clone and without what only jobs need."""

import re
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

from tests.support.started import ROOT, said, started

pytestmark = pytest.mark.system
ROOMS = ("core", "envs", "models", "jobs")
EXAMPLE = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)[1]
# Of the extras: what `evade demo` does without, and what neither environment nor policies import.
ABSENT = ("ray", "mlflow", "optuna", "pyrender", "OpenGL", "scipy", "matplotlib", "pandas")
COMMANDS_ALONE = ("hydra", "omegaconf", "yaml", "rich")
COMPILED = ("*.nbi", "*.nbc", "compiled_*")
USES = """
import numpy as np
import envs
from envs.corridor import CorridorEnv
from envs.events import EventCamera
from envs.recordings import read_events, write_events
camera = EventCamera(8, 6)
camera.reset(np.full((6, 8), 0.2, np.float32), 0)
events = camera.step(np.full((6, 8), 0.9, np.float32), 1000)
for name in ("a.h5", "a.raw", "a.aedat4"):
    write_events(name, events, 8, 6)
    assert read_events(name).events.tobytes() == events.tobytes(), name
try:
    CorridorEnv(renderer="pyrender").reset(seed=0)
except RuntimeError as error:
    print(error)
print(envs.__file__)
"""


def without(*packages):
    """Python as if these packages were not installed: they are not found where a module is looked for."""
    return f"""
import importlib.machinery
find = importlib.machinery.PathFinder.find_spec
def find_spec(name, path=None, target=None):
    return None if name.partition(".")[0] in {packages!r} else find(name, path, target)
importlib.machinery.PathFinder.find_spec = find_spec
"""


def compiled(folder):
    """The compiled kernels of the rooms in a folder, and the files that say of which sources they are."""
    files = (path for name in COMPILED for path in folder.glob(f"[a-z]*/**/__pycache__/{name}"))
    return {path.relative_to(folder).as_posix() for path in files}


@pytest.fixture(scope="module")
def kernels():
    """Those of this clone, the first of which are compiled."""
    said(sys.executable, "-m", "jobs.run.compile")
    return {name for name in compiled(ROOT) if name.partition("/")[0] in ROOMS}


@pytest.fixture(scope="module")
def wheel(kernels, tmp_path_factory):
    """A wheel of this clone, built without a trace in it."""
    folder = tmp_path_factory.mktemp("wheel")
    (folder / "base.cfg").write_text(f"[build]\nbuild_base = {folder / 'build'}\n")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder, ROOT]
    said(*command, cwd=folder, DIST_EXTRA_CONFIG=str(folder / "base.cfg"))
    (path,) = folder.glob("evade-*.whl")
    return path


def test_it_holds_the_packages_the_policies_the_command_and_the_kernels_and_nothing_else(wheel, kernels):
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        (metadata,) = (archive.read(name).decode() for name in names if name.endswith("/METADATA"))
    tops = {name.partition("/")[0] for name in names}
    assert "envs/__pycache__/compiled_" in "".join(sorted(kernels))
    assert kernels <= set(names)
    assert {top for top in tops if not top.endswith((".dist-info", ".data"))} == {*ROOMS}
    assert set(said("git", "ls-files", *ROOMS).splitlines()) <= set(names)
    installed = {name.partition("/data/share/evade/")[2] for name in names}
    assert set(said("git", "ls-files", "conf", "platform/launch.py").splitlines()) <= installed
    needed = re.findall(r"^Requires-Dist: ([\w-]+)(?!.*extra ==).*$", metadata, re.MULTILINE)
    assert {"numpy", "numba", "torch", "gymnasium", "hydra-core", "rich"} <= set(needed)
    assert set(needed).isdisjoint(ABSENT)


@pytest.mark.slow
def test_it_works_without_the_clone_and_without_what_only_jobs_need(wheel, tmp_path):
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "site")
    code = without(*ABSENT, *COMMANDS_ALONE) + EXAMPLE + USES
    done = started(sys.executable, "-c", code, cwd=tmp_path, PYTHONPATH=str(tmp_path / "site"))
    assert done.returncode == 0, done.stderr
    result, missing, place = done.stdout.splitlines()
    assert re.fullmatch(r"(True|False) \d+\.\d+", result)
    assert missing == "renderer='pyrender', which meshes need, is not installed: evade[meshes]"
    assert Path(place).is_relative_to(tmp_path)


@pytest.mark.slow
def test_the_command_demo_of_a_new_environment_compiles_nothing_where_its_kernels_fit(wheel, tmp_path):
    place, empty = tmp_path / "environment", tmp_path / "empty"
    empty.mkdir()
    own = {"PYTHONPATH": "", "HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    said(sys.executable, "-m", "venv", "--without-pip", place)
    pip = [sys.executable, "-m", "pip", "--python", place / "bin" / "python", "install", "--quiet"]
    said(*pip, "--no-deps", "--no-index", wheel, cwd=empty, **own)
    (site,) = place.glob("lib/python*/site-packages")
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    (site / "sitecustomize.py").write_text(without(*ABSENT))
    before = compiled(site)
    shown = said(place / "bin" / "demo", cwd=empty, **own)
    assert re.search(r"bytestream_hold-s0 .*\byes\b", shown)
    assert "ompil" not in shown
    assert compiled(site) == before != set()
    (film,) = empty.glob("runs/*/demo/*.mp4")
    assert film.stat().st_size > 100_000
