"""The time of day for the tracking store, which shows differences of times as durations.

The machine's clock is read once; afterwards the time runs on steadily, even if that clock is set.
"""

import time

_START_MS = (time.time() - time.monotonic()) * 1000


def now_ms() -> int:
    """Return the milliseconds since 1970."""
    return int(_START_MS + time.monotonic() * 1000)
