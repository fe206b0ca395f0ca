"""The launcher in this process, for the tests of this folder."""

import importlib.util
import sys
import types
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def launcher():
    spec = importlib.util.spec_from_file_location("launch_under_test", ROOT / "platform" / "launch.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def launch(launcher, monkeypatch, capsys, tmp_path):
    """Run the launcher in this process, in an empty folder; returns status, stdout, stderr."""
    monkeypatch.chdir(tmp_path)

    def run(*words: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["evade", *words])
        try:
            status = launcher.main()
        except SystemExit as leaving:
            status = leaving.code or 0
        return status, *capsys.readouterr()

    return run


@pytest.fixture
def job(launcher, monkeypatch):
    """Replace the job `train` by a function, and return the configurations that it was given."""

    def replace(function) -> None:
        module = types.ModuleType("jobs_under_test")
        module.run = function
        monkeypatch.setitem(sys.modules, "jobs_under_test", module)
        monkeypatch.setitem(launcher.JOBS, "train", launcher.JOBS["train"]._replace(module="jobs_under_test"))

    return replace
