"""The wheel: what is in it, and that it works without the clone and without what only jobs need."""

import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.system
ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)[1]
# Raised before a meta path finder is asked, as if the package were not installed.
ABSENT = (
    "ray",
    "mlflow",
    "hydra",
    "omegaconf",
    "optuna",
    "pyrender",
    "OpenGL",
    "scipy",
    "matplotlib",
    "yaml",
)
WITHOUT = f"""
import importlib.machinery, sys
find = importlib.machinery.PathFinder.find_spec
def find_spec(name, path=None, target=None):
    return None if name.partition(".")[0] in {ABSENT!r} else find(name, path, target)
importlib.machinery.PathFinder.find_spec = find_spec
"""
USES = """
import numpy as np
import envs
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


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """A wheel of this clone, built without a trace in it."""
    folder = tmp_path_factory.mktemp("wheel")
    (folder / "base.cfg").write_text(f"[build]\nbuild_base = {folder / 'build'}\n")
    environment = {**os.environ, "DIST_EXTRA_CONFIG": str(folder / "base.cfg")}
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(ROOT)]
    subprocess.run(command, env=environment, cwd=folder, check=True, capture_output=True)
    (path,) = folder.glob("evade-*.whl")
    return path


def test_it_holds_the_packages_and_the_policies_and_nothing_else(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        (metadata,) = (archive.read(name).decode() for name in names if name.endswith("/METADATA"))
    tops = {name.partition("/")[0] for name in names}
    rooms = "core", "envs", "models", "jobs"
    assert {top for top in tops if not top.endswith((".dist-info", ".data"))} == {*rooms}
    tracked = subprocess.check_output(["git", "ls-files", *rooms], cwd=ROOT, text=True)
    assert set(tracked.splitlines()) <= set(names)
    command = subprocess.check_output(["git", "ls-files", "conf", "platform/launch.py"], cwd=ROOT, text=True)
    installed = {name.partition("/data/share/evade/")[2] for name in names}
    assert set(command.splitlines()) <= installed
    needed = re.findall(r"^Requires-Dist: ([\w-]+)(?!.*extra ==).*$", metadata, re.MULTILINE)
    assert {"numpy", "numba", "torch", "gymnasium"} <= set(needed)
    assert set(needed).isdisjoint(ABSENT)


@pytest.mark.slow
def test_it_works_without_the_clone_and_without_what_only_jobs_need(wheel, tmp_path):
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "site")
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "site")}
    code = WITHOUT + EXAMPLE + USES
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    result, missing, place = done.stdout.splitlines()
    assert re.fullmatch(r"(True|False) \d+\.\d+", result)
    assert missing == "renderer='pyrender', which meshes need, is not installed: evade[meshes]"
    assert Path(place).is_relative_to(tmp_path)
