"""How long tests wait: limits guard against hanging alone, since no test may fail by the clock."""

import math
import subprocess
import sys
import time

HANG_S = 1800.0  # a step that takes longer than this hangs; a starved machine starts Ray in minutes


def breath_s() -> int:
    """A while [s], at least 1, in which a waiting process of this host is sure to get its turn.

    Thirty times what a process takes to start here and now.
    """
    began_s = time.monotonic()
    subprocess.run([sys.executable, "-c", ""], check=True, timeout=HANG_S)
    return max(1, math.ceil(30 * (time.monotonic() - began_s)))
