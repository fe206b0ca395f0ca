from jobs.run.libraries import hold

hold()  # before anything else is imported

import platform  # noqa: E402
import subprocess  # noqa: E402
import sys  # noqa: E402
from pathlib import Path  # noqa: E402

from hypothesis import settings  # noqa: E402

from tests.support.costs import Costs  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]

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


def pytest_addoption(parser):
    """Add the limit of `make test-costs`."""
    text = "fail the run, after its last test, if a quick test takes more units than this"
    parser.addoption("--most-units", type=float, default=None, metavar="N", help=text)


def pytest_configure(config):
    """Measure the quick tests; a worker leaves their list to the process that started it."""
    most_units = None if hasattr(config, "workerinput") else config.getoption("--most-units")
    config.pluginmanager.register(Costs(most_units), "costs")
