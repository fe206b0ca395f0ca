"""Compiled kernels serve every machine of a class, and packages come as pip is told to get them."""

import importlib.util
import json
import os
import shutil
import sys

import pytest

from core import target
from tests.support.started import ROOT, started

KERNEL = "import numba\n\n@numba.njit(cache=True)\ndef double(x):\n    return 2.0 * x\n"
# A processor that another machine reports, and what numba compiles of a kernel there.
RUN = """
import collections, json, sys
import llvmlite.binding
name, features = json.loads(sys.argv[1])
llvmlite.binding.get_host_cpu_name = lambda: name
llvmlite.binding.get_host_cpu_features = lambda: llvmlite.binding.targets.FeatureMap(features)
from envs.kernel import double
from numba.core import event
compiled = collections.Counter()
class Count(event.Listener):
    def on_start(self, event): compiled[event.kind] += 1
    def on_end(self, event): pass
with event.install_listener("numba:compile", Count()):
    assert double(1.0) == 2.0
print(compiled["numba:compile"], sum(double.stats.cache_hits.values()))
"""
HASWELL, ZEN4 = ("haswell", {"avx2": True, "avx512f": False}), ("znver4", {"avx2": True, "avx512f": True})


def run_on(folder, processor, **environment):
    """How many kernels a process compiles and loads if its machine reports a processor."""
    free = [f"--unset={name}" for name in (target.NAME, target.FEATURES, "NUMBA_CACHE_DIR")]
    own = [f"{name}={value}" for name, value in environment.items()]
    ran = started("env", *free, *own, sys.executable, "-c", RUN, json.dumps(processor), cwd=folder)
    assert ran.returncode == 0, ran.stderr
    return tuple(int(word) for word in ran.stdout.split())


@pytest.mark.system
def test_a_copy_of_compiled_kernels_serves_another_processor(tmp_path):
    first, second = tmp_path / "first", tmp_path / "second"
    (first / "envs").mkdir(parents=True)
    shutil.copy(ROOT / "envs" / "__init__.py", first / "envs")
    shutil.copytree(ROOT / "core", first / "core")
    (first / "envs" / "kernel.py").write_text(KERNEL)
    assert run_on(first, ZEN4) == (1, 0)
    shutil.copytree(first, second, copy_function=shutil.copy)  # with times of its own, as a clone or wheel
    assert run_on(second, HASWELL) == (0, 1)
    assert run_on(second, HASWELL, NUMBA_CPU_NAME="haswell") == (1, 0)  # the user's choice, kept beside it
    assert run_on(second, HASWELL) == (0, 1)


@pytest.fixture
def free(monkeypatch):
    """A process that has neither chosen a target nor compiled anything."""
    for name in (target.NAME, target.FEATURES):
        monkeypatch.setenv(name, "")  # so that it is put back as it was
        monkeypatch.delenv(name)
    monkeypatch.setattr(target, "_has_compiled", lambda: False)
    monkeypatch.setattr(target.sysconfig, "get_platform", lambda: "linux-x86_64")
    return monkeypatch


def test_a_processor_without_avx2_is_refused_with_a_remedy_that_works(free, tmp_path):
    old = tmp_path / "cpuinfo"
    old.write_text("processor : 0\nflags\t\t: fpu sse2 abm movbe bmi1 f16c fma\n")
    with pytest.raises(RuntimeError, match=r"lacks avx2, bmi2 .* NUMBA_CPU_NAME=generic"):
        target.fix_target(old)
    assert target.NAME not in os.environ
    free.setenv(target.NAME, "generic")
    target.fix_target(old)
    assert target.FEATURES not in os.environ


def test_a_machine_of_another_kind_compiles_for_itself(free):
    free.setattr(target.sysconfig, "get_platform", lambda: "linux-riscv64")
    target.fix_target()
    assert target.NAME not in os.environ


def test_what_numba_has_compiled_before_keeps_its_target(free):
    free.setattr(target, "_has_compiled", lambda: True)
    with pytest.warns(UserWarning, match="import envs or models first"):
        target.fix_target()
    assert target.NAME not in os.environ


def installer():
    """The module of platform/install.py, which is a script."""
    spec = importlib.util.spec_from_file_location("install", ROOT / "platform" / "install.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_uv_gets_the_settings_of_pip_or_leaves_the_work_to_pip():
    settings = installer().uv_settings
    assert settings({})["UV_TORCH_BACKEND"] == "auto"
    own = settings({"find-links": "a b", "cert": "c", "progress-bar": "off"})
    assert "UV_TORCH_BACKEND" not in own  # torch comes from where the user says
    assert (own["UV_FIND_LINKS"], own["SSL_CERT_FILE"]) == ("a,b", "c")
    assert settings({"find-links": "a", "only-binary": ":all:"}) is None


def test_every_setting_of_pip_on_this_machine_is_read():
    assert all(isinstance(value, str) for value in installer().pip_settings().values())
