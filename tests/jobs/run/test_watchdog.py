import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.patience import HANG_S

pytestmark = pytest.mark.system
ROOT = Path(__file__).resolve().parents[3]
HANG = """
import time
from jobs.run.watchdog import ending_after
with ending_after(1800.0):
    pass
with ending_after({limit}):
    {block}
print("done")
"""


def run(limit, block):
    code = HANG.format(limit=limit, block=block)
    return subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=HANG_S
    )


def test_a_process_that_hangs_is_ended_and_says_where():
    done = run(0.5, "max(iter(int, 1))")  # never lets go of the interpreter
    assert done.returncode == 1
    assert "Timeout" in done.stderr
    assert 'File "<string>", line 7' in done.stderr
    assert "done" not in done.stdout


def test_what_is_in_time_goes_on():
    assert run(1800.0, "pass").stdout == "done\n"
