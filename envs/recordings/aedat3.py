"""Read AEDAT 3.1 and 3.0, cAER's files (DVS Gesture): packets of events after a text header.

Source: the format's description (inivation.github.io, "AEDAT file formats") and libcaer's headers.
"""

import struct
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from envs.events import EVENT
from envs.recordings.event_file import CUT, CUT_PACKETS, TRIGGER, Opened, Request, gathered

MAGIC_3 = b"#!AER-DAT3"
MAX_HEADER_BYTES = 1 << 20
MAX_PACKET_BYTES = 1 << 28
PACKET = struct.Struct("<hhiiiiii")  # type, source, size, offset of t, wraps of t, capacity, number, valid
SPECIAL, POLARITY, FRAME, IMU6 = range(4)  # types of packets
WORD = np.dtype([("data", "<u4"), ("t", "<i4")])
EDGES = {2: (0, 1), 3: (0, -1), 4: (0, 0), 10: (1, 1), 11: (1, -1)}  # special type: channel, edge
# Sensor sizes by the beginning of the source's name in the header; the first match counts.
SIZES = (
    ("DVS128", 128, 128), ("DAVIS128", 128, 128), ("DAVIS208", 208, 192), ("DAVIS240", 240, 180),
    ("DAVIS346", 346, 260), ("DAVIS640", 640, 480), ("DAVISHET640", 640, 480), ("DAVISRGB", 640, 480),
    ("DVS132S", 132, 104), ("DVXPLORERMINI", 320, 240), ("DVXPLORER", 640, 480),
)  # fmt: skip


class Header(NamedTuple):
    """Contents of the header.

    Attributes:
        start: First byte of the packets.
        sources: Names of the sources by number.
        from_below: Whether rows count from below, as in version 3.0.
    """

    start: int
    sources: dict[int, str]
    from_below: bool


def read_aedat3(request: Request) -> Opened:
    """Open the events of one source of an AEDAT 3 file: the one that `stream` names, else the first.

    Raises:
        ValueError: The header has no end, the format is not RAW, or there is no such source.
    """
    header = read_header(request)
    sources = sorted(header.sources)
    if request.stream is not None and request.stream not in sources:
        raise request.refusal(f"has no source {request.stream}; give stream as one of {header.sources}")
    if len(sources) > 1 and request.stream is None:
        request.tally.notes.append(f"source {sources[0]} is read of {header.sources}; stream= chooses")
    source = request.stream if request.stream is not None else next(iter(sources), None)
    name = header.sources.get(source, "").upper() if source is not None else ""
    size = next(((w, h) for known, w, h in SIZES if name.startswith(known)), (None, None))
    request = request.sized(*size)
    return Opened("aedat3", request, gathered(request, EVENT, _packets(request, header, source)))


def read_header(request: Request) -> Header:
    """Read the header's lines of text.

    Raises:
        ValueError: The header has no end, or names a format other than RAW.
    """
    with request.path.open("rb") as file:
        head = file.read(MAX_HEADER_BYTES)
    start, sources, is_ended = 0, {}, False
    while head.startswith(b"#", start) and (end := head.find(b"\n", start)) >= 0:
        line = head[start:end].decode("latin-1").strip()
        start = end + 1
        if line.startswith("#Source "):
            number, _, name = line.removeprefix("#Source ").partition(":")
            if number.strip().isdigit():
                sources[int(number)] = name.strip()
        if line.startswith("#Format:") and line.partition(":")[2].strip() != "RAW":
            raise request.refusal(
                f"has the format {line.partition(':')[2].strip()}; RAW is read: save it as RAW"
            )
        if line.startswith("#!END-HEADER"):
            is_ended = True
            break
    from_below = head.startswith(b"#!AER-DAT3.0")
    if not is_ended and not from_below:
        raise request.refusal(
            "has a header without its end; it is no AEDAT 3.1 file, or damaged: copy it again"
        )
    return Header(start, sources, from_below)


def packets(request: Request, header: Header) -> Iterator[tuple[int, int, int, bytes]]:
    """Yield type, source, wraps of the clock [2**31 us] and body of each packet."""
    with request.path.open("rb") as file:
        file.seek(header.start)
        while head := file.read(PACKET.size):
            if len(head) < PACKET.size:
                request.tally.damage[CUT] += len(head)
                return
            kind, source, size, _, turns, _, number, _ = PACKET.unpack(head)
            if min(size, number, turns, kind) < 0 or size * number > MAX_PACKET_BYTES:
                raise request.refusal(
                    f"is damaged: a packet at byte {file.tell() - PACKET.size} declares {number} events of "
                    f"{size} bytes; copy or record it again"
                )
            body = file.read(size * number)
            if len(body) < size * number:  # cut off: read its complete events
                request.tally.damage[CUT_PACKETS] += 1
                body = body[: len(body) // size * size]
            yield kind, source, turns, body


def _packets(request: Request, header: Header, source: int | None) -> Iterator[np.ndarray]:
    """Yield the events and triggers of the packets of one source."""
    for kind, number, turns, body in packets(request, header):
        if source is not None and number != source:
            continue
        if kind not in (POLARITY, SPECIAL) or len(body) % WORD.itemsize:
            request.tally.skipped += 1
            continue
        words = np.frombuffer(body, WORD)
        words = words[words["data"] & 1 == 1]
        data, t_us = words["data"], words["t"].astype(np.int64) + (turns << 31)
        if kind == SPECIAL:
            request.tally.skipped += len(words)
            yield _triggers(data >> 1 & 127, t_us)
            continue
        events, y = np.empty(len(words), EVENT), data >> 2 & 0x7FFF
        events["t"], events["x"], events["p"] = t_us, data >> 17 & 0x7FFF, data >> 1 & 1
        events["y"] = (request.height or 1) - 1 - y.astype(np.int64) if header.from_below else y
        yield events


def _triggers(kinds: np.ndarray, t_us: np.ndarray) -> np.ndarray:
    """Return the external triggers among special events."""
    rows = [(t, *EDGES[kind]) for kind, t in zip(kinds.tolist(), t_us.tolist(), strict=True) if kind in EDGES]
    return np.array(rows, TRIGGER)
