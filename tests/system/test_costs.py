"""The list of costly tests: what counts as a test's cost, and when it fails a run."""

import sys

import pytest

from tests.support.started import ROOT, said

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

pytestmark = [pytest.mark.system, pytest.mark.slow]


def test_a_run_fails_only_by_tests_that_work_more_than_the_limit(tmp_path):
    (tmp_path / "conftest.py").write_text(CONFTEST)
    (tmp_path / "test_small.py").write_text(TESTS)
    (tmp_path / "pytest.ini").write_text(f"[pytest]\npythonpath = {ROOT}\nmarkers = slow\n")
    words = ("-p", "no:cacheprovider", "--most-units", "4", str(tmp_path))
    told = said(sys.executable, "-m", "pytest", *words, cwd=tmp_path, status=1)
    listed = {line.split("::")[-1] for line in told.splitlines() if "test_small.py::" in line}
    assert listed == {"test_works", "test_has_a_child_that_works"}, told
