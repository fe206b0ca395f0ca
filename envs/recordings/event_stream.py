"""Read Event Stream files (.es), version 2: one byte for the time since the last event, then the pixel.

Source: the format's description (github.com/neuromorphic-paris/event_stream) and its authors' library
sepia (MIT licence), which counts rows from below.
"""

from collections.abc import Iterator

import numba
import numpy as np

from envs.events import EVENT
from envs.recordings.event_file import CUT, Opened, Part, Request
from envs.recordings.mapped import mapped

MAGIC_ES = b"Event Stream"
HEADER_BYTES = len(MAGIC_ES) + 8  # version 3, type 1, width 2, height 2
DVS, ATIS = 1, 2
EVENT_BYTES = 5
PLACE, TIME, EXPOSURES = range(3)  # indices of a decoder's state


def read_es(request: Request) -> Opened:
    """Open a file of type DVS or ATIS; exposures of an ATIS are skipped and counted.

    Raises:
        ValueError: The file has another version or type.
    """
    with request.path.open("rb") as file:
        head = file.read(HEADER_BYTES)
    if head[: len(MAGIC_ES)] != MAGIC_ES or len(head) < HEADER_BYTES:
        raise request.refusal("has no header of an Event Stream file, so it is none; give its format")
    major, kind = head[12], head[15]
    if major != 2 or kind not in (DVS, ATIS):
        raise request.refusal(
            f"is of version {major} and type {kind}; types 1 (DVS) and 2 (ATIS) of version 2 are read: "
            "write it again as one of them"
        )
    request = request.sized(*np.frombuffer(head[16:], "<u2").tolist())
    return Opened("es", request, _parts(request, kind == ATIS))


def _parts(request: Request, is_atis: bool) -> Iterator[Part]:
    """Yield the events of a file after its header."""
    size = request.path.stat().st_size - HEADER_BYTES
    raw, forget = mapped(request, HEADER_BYTES, np.dtype("u1"), size)
    state = np.zeros(3, np.int64)
    while True:
        events = np.empty(min(request.part_events, size // EVENT_BYTES + 1), EVENT)
        before = int(state[EXPOSURES])
        n = decode_es(raw, is_atis, request.height or 0, state, events)
        request.tally.skipped += int(state[EXPOSURES]) - before
        yield Part(events[:n])
        forget(int(state[PLACE]))
        if n < len(events):
            break
    if state[PLACE] < size:
        request.tally.damage[CUT] += size - int(state[PLACE])


@numba.njit(cache=True, error_model="numpy")
def decode_es(raw: np.ndarray, is_atis: bool, height: int, state: np.ndarray, events: np.ndarray) -> int:
    """Decode until `events` is full or the bytes end.

    The first byte of an event is its time since the last one [us] and, in the lowest bit (ATIS:
    two bits), its kind. Separate bytes before it carry longer times.

    Args:
        raw: uint8, the file after its header.
        is_atis: Whether the events are of type ATIS.
        height: Rows of the sensor [px]; a row outside it gets y = 65535.
        state: int64 (3,): next byte, time, skipped exposures; updated in place.
        events: EVENT array to fill.

    Returns:
        Number of events.
    """
    bits = 2 if is_atis else 1
    least = 0xFC if is_atis else 0xFE  # bytes from this value on only advance the time
    longest = np.int64(0xFF >> bits)
    n, i, t = 0, state[PLACE], state[TIME]
    while i < raw.size and n < events.size:
        first = np.int64(raw[i])
        if first >= least:
            t += longest * (first - least)  # DVS: 0xFE does nothing
            i += 1
            continue
        if i + EVENT_BYTES > raw.size:
            break
        t += first >> bits
        y = height - 1 - (raw[i + 3] | np.int64(raw[i + 4]) << 8)
        if is_atis and first & 1:
            state[EXPOSURES] += 1
        else:
            event = events[n]
            event.t, event.x = t, raw[i + 1] | np.int64(raw[i + 2]) << 8
            event.y = y if y >= 0 else 65535
            event.p = 1 if first >> (bits - 1) & 1 else -1
            n += 1
        i += EVENT_BYTES
    state[PLACE], state[TIME] = i, t
    return n
