"""The list of costly tests: what counts as a test's cost, and when it fails a run."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
CONFTEST = """
from tests.support.costs import Costs

def pytest_addoption(parser):
    parser.addoption("--most-units", type=float, default=None)

def pytest_configure(config):
    config.pluginmanager.register(Costs(config.getoption("--most-units")), "costs")
"""
TESTS = """
import subprocess, sys, time
import pytest
from tests.support.costs import processor_s, unit_s

UNIT_S = unit_s()
WORK = "import time\\nwhile time.process_time() < {seconds}: pass"

def work(units):
    end_s = processor_s() + units * UNIT_S
    while processor_s() < end_s:
        pass

def test_works():
    work(8)

def test_has_a_child_that_works():
    subprocess.run([sys.executable, "-c", WORK.format(seconds=8 * UNIT_S)], check=True)

def test_waits():
    time.sleep(8 * UNIT_S)

@pytest.mark.slow
def test_is_not_quick():
    work(8)
"""

pytestmark = pytest.mark.system


def run(folder: Path, *options: str) -> subprocess.CompletedProcess:
    (folder / "conftest.py").write_text(CONFTEST)
    (folder / "test_small.py").write_text(TESTS)
    (folder / "pytest.ini").write_text(f"[pytest]\npythonpath = {ROOT}\nmarkers = slow\n")
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *options, str(folder)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_a_run_fails_only_by_tests_that_work_more_than_the_limit(tmp_path):
    done = run(tmp_path, "--most-units", "4")
    listed = {line.split("::")[-1] for line in done.stdout.splitlines() if "test_small.py::" in line}
    assert (done.returncode, listed) == (1, {"test_works", "test_has_a_child_that_works"}), done.stdout


@pytest.mark.parametrize("options", [(), ("--most-units", "1000")])
def test_a_run_below_the_limit_or_without_one_passes(tmp_path, options):
    assert run(tmp_path, *options).returncode == 0
