import importlib
import importlib.util
import os
import pickle
import platform
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.system
ROOT = Path(__file__).resolve().parents[2]


def python(*arguments: str, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return subprocess.run(
        [sys.executable, *arguments], cwd=cwd, env=environment, capture_output=True, text=True, check=False
    )


def test_the_package_is_found_in_the_repository_root():
    code = "import platform; print(platform.__path__[0])"
    assert python("-c", code).stdout.strip() == str(ROOT / "platform")


def test_it_differs_from_the_standard_library_only_by_its_path(tmp_path):
    code = "import platform as p; print(sorted(vars(p)), p.__file__, p.__doc__, p.version())"
    ours, theirs = python("-c", code).stdout, python("-c", code, cwd=tmp_path).stdout
    assert "'__path__', " in ours
    assert ours.replace("'__path__', ", "") == theirs


@pytest.mark.parametrize("arguments", [[], ["terse"], ["--nonaliased"]])
def test_running_it_prints_what_the_standard_library_prints(arguments, tmp_path):
    ours, theirs = (python("-m", "platform", *arguments, cwd=folder) for folder in (ROOT, tmp_path))
    assert (ours.returncode, ours.stdout, ours.stderr) == (0, theirs.stdout, "")


def test_a_second_copy_of_the_repository_on_the_path_does_not_confuse_it(tmp_path):
    copy = tmp_path / "platform"
    copy.mkdir()
    copy.joinpath("__init__.py").write_text((ROOT / "platform" / "__init__.py").read_text())
    code = f"import sys; sys.path.insert(1, {str(tmp_path)!r}); import platform; print(platform.system())"
    assert python("-c", code).stdout.strip() == platform.system()


def test_reloading_keeps_identity_and_pickles_find_their_classes():
    code = """
import importlib, pickle, platform
uname = platform.uname()
again = importlib.reload(platform)
assert again is platform and platform.__path__
assert pickle.loads(pickle.dumps(platform.uname())) == uname
assert type(platform.uname()).__module__ == "platform"
print("ok")
"""
    result = python("-c", code)
    assert result.stdout == "ok\n", result.stderr


def test_its_pickles_can_be_read_without_it():
    code = "import pickle, platform, sys; sys.stdout.buffer.write(pickle.dumps(platform.uname()))"
    written = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, check=True).stdout
    assert pickle.loads(written).system == platform.system()


def test_processes_started_in_every_way_can_use_it():
    code = """
import multiprocessing, platform
if __name__ == "__main__":
    for way in ("fork", "spawn", "forkserver"):
        with multiprocessing.get_context(way).Pool(1) as pool:
            assert pool.apply(platform.system) == platform.system()
    print("ok")
"""
    result = python("-c", code)
    assert result.stdout == "ok\n", result.stderr


@pytest.mark.skipif(importlib.util.find_spec("test") is None, reason="this Python lacks its test suite")
def test_the_standard_librarys_own_tests_pass_in_the_repository_root():
    result = python("-m", "unittest", "test.test_platform")
    assert result.returncode == 0, result.stderr
    assert "\nOK" in result.stderr


def test_libraries_that_use_it_import_in_the_repository_root():
    code = "import platform, numpy, pip, pytest, hydra; assert platform.__path__; print(platform.machine())"
    assert python("-c", code).stdout.strip() == platform.machine()


@pytest.mark.slow
@pytest.mark.parametrize("library", ["torch", "ray.rllib", "mlflow", "numba", "trimesh", "pyrender"])
def test_heavy_libraries_import_in_the_repository_root(library):
    result = python("-c", f"import {library}, platform; assert platform.__path__; print(platform.machine())")
    assert result.stdout.strip().endswith(platform.machine()), result.stderr


def test_this_test_run_sees_the_package_too():
    assert importlib.util.find_spec("platform.launch") is not None
