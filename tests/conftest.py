from jobs.run.libraries import hold

hold()  # before anything else is imported

import os  # noqa: E402
import platform  # noqa: E402
import subprocess  # noqa: E402
import sys  # noqa: E402
from pathlib import Path  # noqa: E402

import pytest  # noqa: E402
from hypothesis import settings  # noqa: E402
from numba.core import event  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
# A quick test takes at most this much processor time; EVADE_TEST_SECONDS is for slow machines.
QUICK_S = float(os.environ.get("EVADE_TEST_SECONDS", "5"))
NOT_QUICK = ("system", "slow", "benchmark", "faults", "cluster")

# The first example of a property may compile kernels.
settings.register_profile("patient", deadline=None)
settings.load_profile("patient")

# Started as `pytest`, the standard library's module is loaded before the repository's.
if not hasattr(platform, "__path__"):
    platform.__path__ = [str(ROOT / "platform")]


def pytest_sessionstart(session):
    """Compile the kernels once, before workers start that would each compile them."""
    if getattr(session.config.option, "numprocesses", None) and not hasattr(session.config, "workerinput"):
        subprocess.run([sys.executable, "-m", "tests.support.kernels"], cwd=ROOT, check=False)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    """Fail a quick test that is not quick.

    It is processor time that counts, of this process and of children that have ended: what else the
    machine does changes it little. What numba compiles here is not the test's: it is compiled once.
    """
    compiling.spent_s = 0.0
    began = _processor_s()
    with event.install_listener("numba:compile", compiling):
        result = yield
    spent = _processor_s() - began - compiling.spent_s
    if spent > QUICK_S and not any(item.get_closest_marker(name) for name in NOT_QUICK):
        kinds = "`system` (it starts Ray, the launcher or another process) or `slow`"
        pytest.fail(
            f"took {spent:.1f} s of the {QUICK_S:g} s of a quick test; make it cheaper, or mark it {kinds}"
        )
    return result


class _Compiling(event.Listener):
    """Adds up the processor time of compilations, which lie within each other."""

    def __init__(self):
        self.depth, self.began_s, self.spent_s = 0, 0.0, 0.0

    def on_start(self, event):
        if self.depth == 0:
            self.began_s = _processor_s()
        self.depth += 1

    def on_end(self, event):
        self.depth -= 1
        if self.depth == 0:
            self.spent_s += _processor_s() - self.began_s


compiling = _Compiling()


def _processor_s() -> float:
    return sum(os.times()[:4])
