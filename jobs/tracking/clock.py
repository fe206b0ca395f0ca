"""The time of day for the tracking store, which shows differences of times as durations.

The machine's clock is read once. Later times are measured from there by a monotonic clock.
"""

import time

_START_MS = (time.time() - time.monotonic()) * 1000


def now_ms() -> int:
    """Return the time since 1970 [ms]."""
    return int(_START_MS + time.monotonic() * 1000)
