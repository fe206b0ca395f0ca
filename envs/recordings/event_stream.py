"""Event Stream files (.es), version 2: one byte for the time since the last event, then its pixel.

From the format's description (github.com/neuromorphic-paris/event_stream) and the library of its
authors, sepia (MIT licence), which counts rows from below.
"""

import numba
import numpy as np

from envs.events import EVENT
from envs.recordings.event_file import EventFile, Request, finish

MAGIC_ES = b"Event Stream"
HEADER_BYTES = len(MAGIC_ES) + 8  # version 3, type 1, width 2, height 2
DVS, ATIS = 1, 2
EVENT_BYTES = 5


def read_es(request: Request) -> EventFile:
    """Changes of brightness in a file of type DVS or ATIS; an ATIS file's exposures are passed over.

    Raises:
        ValueError: Another version or type, a truncated body, a pixel outside the sensor, or a
            rule of `finish`.
    """
    raw = np.fromfile(request.path, np.uint8)
    head = raw[:HEADER_BYTES].tolist()
    if bytes(head[: len(MAGIC_ES)]) != MAGIC_ES or len(head) < HEADER_BYTES:
        raise request.refusal("has no header of an Event Stream file; it is none, or damaged")
    major, kind = head[12], head[15]
    if major != 2 or kind not in (DVS, ATIS):
        raise request.refusal(
            f"is of version {major} and type {kind}; types 1 (DVS) and 2 (ATIS) of version 2 are read"
        )
    request = request.sized(*np.frombuffer(raw[16:HEADER_BYTES], "<u2").tolist())
    body, height = raw[HEADER_BYTES:], request.height or 0
    count, skipped, whole = decode_es(body, kind == ATIS, height, np.empty(0, EVENT))
    if not whole:
        raise request.refusal("is truncated, or has a row outside its sensor; copy or record it again")
    events = np.empty(request.check_count(count), EVENT)
    decode_es(body, kind == ATIS, height, events)
    return finish(request, "es", events, skipped)


@numba.njit(cache=True, error_model="numpy")
def decode_es(raw: np.ndarray, is_atis: bool, height: int, events: np.ndarray) -> tuple[int, int, bool]:
    """Decode once with empty `events` to count, once to fill.

    The first byte of an event is its time since the last one [us] and, below it, one bit (ATIS:
    two) of what happened; times too long for it are sent before in bytes of their own.

    Args:
        raw: uint8, the file after its header.
        is_atis: Whether the events are of type ATIS.
        height: Rows of the sensor [px].
        events: EVENT array to fill.

    Returns:
        Number of events, number of exposures, and whether all is whole and inside the rows.
    """
    bits = 2 if is_atis else 1
    least = 0xFC if is_atis else 0xFE  # bytes from here on only count time
    longest = np.int64(0xFF >> bits)
    n, exposures, t, i = 0, 0, np.int64(0), 0
    while i < raw.size:
        first = np.int64(raw[i])
        if first >= least:
            t += longest * (first - least)  # DVS: 0xFE does nothing
            i += 1
            continue
        if i + EVENT_BYTES > raw.size:
            return n, exposures, False
        t += first >> bits
        y = height - 1 - (raw[i + 3] | np.int64(raw[i + 4]) << 8)
        if y < 0:
            return n, exposures, False
        if is_atis and first & 1:
            exposures += 1
        else:
            if n < events.size:
                event = events[n]
                event.t, event.x, event.y = t, raw[i + 1] | np.int64(raw[i + 2]) << 8, y
                event.p = 1 if first >> (bits - 1) & 1 else -1
            n += 1
        i += EVENT_BYTES
    return n, exposures, True
