import ast
import importlib
import importlib.metadata
import os
import re
import shutil
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import jobs
from tests.support.started import ROOT, said

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
LOCKS = ("requirements.lock", "requirements-dev.lock")
LOCK = [line for name in LOCKS for line in (ROOT / name).read_text().splitlines() if line and line[0] != "#"]
DEFAULT = (ROOT / "requirements.lock").read_text().splitlines()
LOCKED_EXTRAS = ("jobs", "meshes", "dev", "docs")
ROOMS = ("core", "envs", "models", "jobs")
OUTSIDE = ("benchmarks", "research")  # of the wheel
SOURCES = ("*.*", "Makefile", ".ci/*", "conf/**/*.yaml", "docker/*", "docs/*.md", "[a-z]*/**/*.py")


def locked() -> dict[str, str]:
    return dict(line.split("==") for line in LOCK)


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_every_line_of_the_lock_pins_one_package_and_leaves_the_build_of_torch_open():
    assert [line for line in LOCK if not re.fullmatch(r"[a-z0-9.-]+==[0-9][a-z0-9.]*", line)] == []
    assert len(locked()) == len(LOCK)
    assert [name for name in locked() if name.startswith(("nvidia", "triton", "cuda"))] == []


def test_the_lock_holds_everything_that_the_project_needs_in_a_fitting_version():
    extras = PROJECT["optional-dependencies"]
    for text in [*PROJECT["dependencies"], *(text for extra in LOCKED_EXTRAS for text in extras[extra])]:
        needed = Requirement(text)
        assert needed.specifier.contains(locked()[normal(needed.name)]), text


def test_the_default_commands_need_the_first_lock_alone():
    extras, pinned = PROJECT["optional-dependencies"], {line.partition("==")[0] for line in DEFAULT}
    first = [*PROJECT["dependencies"], *extras["jobs"], *extras["meshes"]]
    assert {normal(Requirement(text).name) for text in first} <= pinned
    assert pinned.isdisjoint({"furo", "mypy", "onnx", "onnxruntime", "pytest", "ruff", "stable-baselines3"})


def test_the_installed_versions_are_those_of_the_lock():
    installed = {name: importlib.metadata.version(name).partition("+")[0] for name in locked()}
    assert installed == locked()


def test_the_installed_version_is_that_of_the_project():
    assert importlib.metadata.version("evade") == PROJECT["version"]


@pytest.mark.parametrize("entry", PROJECT["scripts"].values())
def test_every_entry_point_leads_to_a_function(entry):
    module, _, name = entry.partition(":")
    assert callable(getattr(importlib.import_module(module), name))


def test_the_command_says_so_when_the_launcher_is_not_there(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(jobs, "__file__", str(tmp_path / "jobs" / "__init__.py"))
    assert jobs.main() == 2
    assert "pip install -e ." in capsys.readouterr().err


@pytest.mark.system
def test_importing_the_rooms_is_light():
    code = "import sys, envs, jobs, models; print({'torch', 'ray', 'mlflow', 'hydra'} & set(sys.modules))"
    assert said(sys.executable, "-c", code) == "set()\n"


def make(*words: str) -> str:
    free = [f"--unset={name}" for name in os.environ if name.startswith("MAKE")]  # as if typed
    return said("env", *free, "make", *words)


def test_make_help_lists_every_target_and_make_knows_how_to_reach_it():
    (line,) = re.findall(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    targets = line.split()
    listed = make("help")
    assert {line.split()[0] for line in listed.splitlines()[1:]} == {*targets} - {"system-libraries"}
    assert make() == listed
    make("--dry-run", *targets)


def test_a_sweep_trains_and_ships_its_policies_first_only_if_told_to():
    def planned(*words: str) -> str:
        return make("--dry-run", "sweep-robustness", "POLICIES=rgb", "SEEDS=4", *words)

    assert "job=train" not in planned()
    told = planned("train=true", "ARGS=budget=smoke")
    flown = "+exp=robustness 'study.policies=[rgb,straight,oracle]' budget=smoke"
    parts = ["job=train", "launch publish budget=smoke", flown]
    assert sorted(map(told.index, parts)) == list(map(told.index, parts))


def test_make_takes_the_first_python_that_runs_and_says_so_if_none_does(tmp_path):
    shutil.copy(ROOT / "Makefile", tmp_path)
    for name, status in {"python3.11": 1, "python3.12": 0, "python3.13": 0}.items():
        (tmp_path / name).write_text(f"#!/bin/sh\necho $0 $* >&2\nexit {status}\n")
        (tmp_path / name).chmod(0o755)
    (tmp_path / "requirements.lock").touch()
    (tmp_path / "pyproject.toml").touch()

    def made() -> str:
        words = ("env", "-i", f"PATH={tmp_path}", shutil.which("make"), ".venv/.installed")
        return said(*words, cwd=tmp_path, status=2)  # these make no environment

    assert "python3.12 -m venv .venv" in made()
    for name in ("python3.12", "python3.13"):
        (tmp_path / name).unlink()
    refused = made()
    assert "needs Python 3.11, 3.12 or 3.13" in refused
    assert "-m venv" not in refused


def test_the_continuous_integration_script_is_valid():
    said("bash", "-n", ".ci/run")
    assert (ROOT / ".ci" / "run").stat().st_mode & 0o111


def test_no_file_names_a_package_index_or_a_folder_of_one_machine():
    index = r"\s--(?:extra-)?index-url|\s--find-links|\s--trusted-host"
    private = re.compile(index + r"|/home/(?!evade/)[a-z]|/root/")  # evade is the image's own user
    files = [path for pattern in SOURCES for path in ROOT.glob(pattern) if path.is_file()]
    texts = [path for path in files if path.suffix not in (".db", ".png", ".gif", ".svg", ".mp4")]
    texts.remove(Path(__file__))
    assert {str(path): found for path in texts if (found := private.findall(path.read_text()))} == {}
    named = {str(path.relative_to(ROOT)) for path in texts}
    assert {"Makefile", "requirements.lock", "platform/launch.py", "conf/config.yaml", ".ci/run"} <= named


def test_no_test_imports_another_test_module_nor_does_a_script_that_it_starts():
    # A script stands in the text of its test.
    a_test = r"^\s*(?:from|import) [\w.]*\btest_\w+|^\s*from tests[\w.]* import .*\btest_"
    importing = re.compile(a_test, re.MULTILINE)
    tests = list((ROOT / "tests").rglob("*.py"))
    assert Path(__file__) in tests
    assert {str(path): found for path in tests if (found := importing.findall(path.read_text()))} == {}


def test_the_body_of_a_function_stays_below_forty_lines():
    def body_lines(function: ast.FunctionDef) -> int:
        body = function.body[1:] if ast.get_docstring(function) is not None else function.body
        return body[-1].end_lineno - body[0].lineno + 1 if body else 0

    sizes = [
        (str(path.relative_to(ROOT)), node.name, body_lines(node))
        for room in (*ROOMS, *OUTSIDE)
        for path in (ROOT / room).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    ]
    assert [found for found in sizes if found[2] >= 40] == []
    assert len(sizes) > 1000


def test_files_stand_in_packages_not_in_the_rooms_themselves():
    top = [path for room in ("envs", "models", "jobs") for path in (ROOT / room).glob("*.py")]
    assert len(top) <= 19


def test_code_and_docs_use_the_words_of_the_field():
    old = re.compile(r"\b(pilots?|sightings?|outbox|nearness|flown)\b", re.IGNORECASE)
    files = [path for room in (*ROOMS, *OUTSIDE, "docs") for path in (ROOT / room).rglob("*.*")]
    texts = [path for path in files if path.suffix in (".py", ".md", ".j2", ".yaml", ".csv")]
    assert len(texts) > 150
    found = {path: old.findall(path.read_text()) for path in [*texts, ROOT / "README.md"]}
    assert {path: words for path, words in found.items() if words and "_build" not in path.parts} == {}


def test_few_values_are_of_any_type():
    """A third of them are sections of a study's file, which is data: no class names its keys."""
    untyped = re.compile(r"\b(?:dict|Mapping)\[str, Any\]")
    texts = [path.read_text() for room in ROOMS for path in (ROOT / room).rglob("*.py")]
    assert sum(len(untyped.findall(text)) for text in texts) < 155


def test_both_rooms_prepare_their_kernels_in_the_same_way():
    envs, models = ((ROOT / room / "__init__.py").read_text().splitlines() for room in ("envs", "models"))
    assert envs[1:] == models[1:]
    assert {"fix_target()", "forget_stale_kernels(Path(__file__).parent)"} <= set(envs)
