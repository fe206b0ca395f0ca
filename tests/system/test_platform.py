"""The package `platform` stands for the standard library's module of that name, wherever Python starts."""

import importlib.util
import pickle
import platform
import subprocess
import sys

import pytest

from tests.support.started import ROOT, said, started

pytestmark = pytest.mark.system


def python(*arguments, cwd=ROOT):
    return said(sys.executable, *arguments, cwd=cwd, PYTHONPATH="")


def test_it_differs_from_the_standard_library_only_by_its_path(tmp_path):
    code = "import platform as p; print(sorted(vars(p)), p.__file__, p.__doc__, p.version())"
    ours, theirs = python("-c", code), python("-c", code, cwd=tmp_path)
    assert "'__path__', " in ours
    assert ours.replace("'__path__', ", "") == theirs


def test_running_it_prints_what_the_standard_library_prints(tmp_path):
    words = ("-m", "platform", "terse", "--nonaliased")
    assert python(*words) == python(*words, cwd=tmp_path)


def test_reloading_keeps_identity_and_processes_started_in_every_way_can_use_it(tmp_path):
    copy = tmp_path / "platform"  # a second copy of the repository on the path does not confuse it
    copy.mkdir()
    copy.joinpath("__init__.py").write_text((ROOT / "platform" / "__init__.py").read_text())
    code = f"""
import importlib, multiprocessing, pickle, sys
sys.path.insert(1, {str(tmp_path)!r})
import platform
if __name__ == "__main__":
    assert platform.__path__[0] == {str(ROOT / "platform")!r}
    uname = platform.uname()
    assert importlib.reload(platform) is platform and platform.__path__
    assert pickle.loads(pickle.dumps(platform.uname())) == uname
    assert type(platform.uname()).__module__ == "platform"
    for way in ("fork", "spawn", "forkserver"):
        with multiprocessing.get_context(way).Pool(1) as pool:
            assert pool.apply(platform.system) == platform.system()
"""
    python("-c", code)


def test_its_pickles_can_be_read_without_it():
    code = "import pickle, platform, sys; sys.stdout.buffer.write(pickle.dumps(platform.uname()))"
    written = subprocess.check_output([sys.executable, "-c", code], cwd=ROOT)
    assert pickle.loads(written).system == platform.system()


@pytest.mark.skipif(importlib.util.find_spec("test") is None, reason="this Python lacks its test suite")
def test_the_standard_librarys_own_tests_pass_in_the_repository_root():
    done = started(sys.executable, "-m", "unittest", "test.test_platform", PYTHONPATH="")
    assert "\nOK" in done.stderr
