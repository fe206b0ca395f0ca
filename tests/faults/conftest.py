import contextlib
import os
import subprocess
import time
from pathlib import Path

import pytest

from tests.support.clusters import TOKEN, cluster  # noqa: F401  a fixture
from tests.support.faults import DEADLINE_S, TABLE


def pytest_configure(config):
    """Ray reads the token once in a process, when it is imported; jobs make their own.

    Only for the fault tests: this file is loaded when any test of the tree is collected, and a local Ray of
    another test could not be reached with it.
    """
    if config.option.markexpr == "faults":
        os.environ.update(TOKEN)


def pytest_sessionfinish(session):
    """A worker of pytest-xdist hands its rows to the process that prints the table."""
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["faults"] = TABLE


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node):
    TABLE.extend(tuple(row) for row in getattr(node, "workeroutput", {}).get("faults", []))


def pytest_terminal_summary(terminalreporter):
    if not TABLE:
        return
    head = ("fault", "outcome", "lost")
    wide = [max(len(row[column]) for row in [head, *TABLE]) for column in range(3)]
    terminalreporter.section("faults")
    for row in [head, *sorted(TABLE)]:
        terminalreporter.line("  ".join(text.ljust(width) for text, width in zip(row, wide, strict=True)))


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 64 MiB of its own."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64m", "tmpfs", str(folder)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("a full disk needs a small file system, and mounting one is not permitted")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


@pytest.fixture
def small_memory():
    """A group of processes that together may take 64 MiB more than they have; without the right to make one,
    a path of nothing.
    """
    root = Path("/sys/fs/cgroup")
    unified = (root / "cgroup.controllers").is_file()
    group = root / ("" if unified else "memory") / f"evade-faults-{os.getpid()}"
    with contextlib.suppress(OSError):
        group.mkdir()
        (group / ("memory.max" if unified else "memory.limit_in_bytes")).write_text(str(64 << 20))
    yield group
    deadline = time.monotonic() + DEADLINE_S
    while group.is_dir():  # until the last of its processes has gone
        assert time.monotonic() < deadline, (group / "cgroup.procs").read_text()
        with contextlib.suppress(OSError):
            group.rmdir()
        time.sleep(0.1)
