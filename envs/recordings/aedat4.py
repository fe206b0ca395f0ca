"""Read AEDAT 4.0, the files of iniVation's DV: packets of compressed flatbuffers in numbered streams.

The walk through the packets checks every offset and the kind of each, so that a damaged file is refused. A
file that was cut off is read up to there.
"""

import struct
from collections.abc import Iterator
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from envs.recordings.event_file import CUT, CUT_PACKETS, TRIGGER, Opened, Part, Request, assemble
from envs.recordings.flatbuffer import Table, root

MAGIC_4 = b"#!AER-DAT4.0\r\n"
EVENT_PACKET, PACKET_TABLE = b"EVTS", b"FTAB"  # identifiers of flatbuffers
TRIGGER_PACKET = b"TRIG"
MAX_HEADER_BYTES = 1 << 20
MAX_PACKET_BYTES = 1 << 28
CODECS = {1: "lz4", 2: "lz4", 3: "zstd", 4: "zstd"}
PACKED_EVENT = np.dtype(
    {
        "names": ["t", "x", "y", "on"],
        "formats": ["<i8", "<i2", "<i2", "u1"],
        "offsets": [0, 8, 10, 12],
        "itemsize": 16,
    }
)
# Channel (1 is the generator) and edge of a type.
EDGES = {1: (0, 1), 2: (0, -1), 3: (0, 0), 4: (1, 1), 5: (1, -1)}
BROKEN = (struct.error, ElementTree.ParseError, UnicodeDecodeError, OSError, ValueError)
DAMAGED = "is damaged or no AEDAT 4.0 file ({}); copy or record it again"


class Stream(NamedTuple):
    """One stream of a file.

    Attributes:
        number: Of its packets.
        kind: Identifier, such as b"EVTS" of events.
        width, height: Of the sensor, or None.
    """

    number: int
    kind: bytes
    width: int | None
    height: int | None


class Layout(NamedTuple):
    """What the header says.

    Attributes:
        codec: How packets are compressed, or None.
        streams: All streams.
        start, end: First byte of the packets, and the byte after the last.
        is_whole: Whether the file is as long as the header says.
    """

    codec: str | None
    streams: list[Stream]
    start: int
    end: int
    is_whole: bool


def read_aedat4(request: Request) -> Opened:
    """Open one stream of events of an AEDAT 4.0 file, uncompressed or packed with LZ4 or Zstandard.

    Triggers come with the events. Of several streams of events the one is read that `stream` names, else
    the first.

    Raises:
        ValueError: A damaged header or packet, no stream of events, or a packet of more than 256 MiB.
    """
    layout = read_layout(request)
    chosen = choose(request, layout.streams, EVENT_PACKET)
    if not layout.is_whole:
        request.tally.damage[CUT_PACKETS] += 1
    request = request.sized(chosen.width, chosen.height)
    return Opened("aedat4", request, _parts(request, layout, chosen))


def read_layout(request: Request) -> Layout:
    """Return what the header of a file says.

    Raises:
        ValueError: The header is damaged.
    """
    size = request.path.stat().st_size
    with request.refusing(BROKEN, DAMAGED), request.path.open("rb") as file:
        file.seek(len(MAGIC_4))
        (length,) = struct.unpack("<I", file.read(4))
        start = len(MAGIC_4) + 4 + length
        if not 0 < length <= min(MAX_HEADER_BYTES, size - len(MAGIC_4) - 4):
            raise ValueError(f"its header declares {length} bytes")
        head = root(file.read(length))
        codec, end = CODECS.get(int(head.scalar(0, "i", 0))), int(head.scalar(1, "q", -1))
        streams = list(_streams(head))
        if end == -1 or end >= size:  # without a table of packets, or cut off before it
            return Layout(codec, streams, start, size, end == -1)
        if end < start:
            raise ValueError(f"its table of packets should be at byte {end} of {size}")
        file.seek(end)
        _unpacked(file.read(), codec, PACKET_TABLE)
    return Layout(codec, streams, start, end, True)


def choose(request: Request, streams: list[Stream], kind: bytes) -> Stream:
    """Return the stream of a kind that the caller names, else the first; a note names the others.

    Raises:
        ValueError: There is no such stream.
    """
    found = [stream for stream in streams if stream.kind == kind]
    listing = ", ".join(f"{s.number} ({s.kind.decode('latin-1')}, {s.width}x{s.height})" for s in streams)
    if request.stream is not None:
        found = [stream for stream in found if stream.number == request.stream]
    if not found:
        raise request.refusal(
            f"has no stream {'' if request.stream is None else request.stream} of kind {kind.decode()}; "
            f"its streams are {listing or 'none'}: give stream as one of that kind"
        )
    if len(found) > 1:
        request.tally.notes.append(
            f"stream {found[0].number} is read, and there are {len(found)}: {listing}; stream= chooses"
        )
    return found[0]


def packets(request: Request, layout: Layout, kinds: dict[int, bytes]) -> Iterator[tuple[int, bytes]]:
    """Yield stream numbers and flatbuffers of some streams.

    Args:
        request: The file.
        layout: Of its header.
        kinds: Identifiers of the wanted streams, by number.

    Raises:
        ValueError: A packet is damaged, and is not the last.
    """
    place = layout.start
    with request.refusing(BROKEN, DAMAGED), request.path.open("rb") as file:
        while place < layout.end:
            if layout.end - place < 8:
                request.tally.damage[CUT] += layout.end - place
                return
            file.seek(place)
            number, size = struct.unpack("<ii", file.read(8))
            left = layout.end - place - 8
            if size < 0:
                raise ValueError(f"the packet at byte {place} declares {size} bytes")
            if size > left:
                if layout.is_whole and layout.end < file.seek(0, 2):
                    raise ValueError(f"the packet at byte {place} declares {size} bytes and {left} follow")
                request.tally.damage.setdefault(CUT_PACKETS, 1)
                return
            if number in kinds:
                yield number, _unpacked(file.read(size), layout.codec, kinds[number])
            place += 8 + size


def _parts(request: Request, layout: Layout, chosen: Stream) -> Iterator[Part]:
    """Yield the events of a stream, with the triggers of all streams."""
    kinds = {stream.number: stream.kind for stream in layout.streams if stream.kind == TRIGGER_PACKET}
    kinds[chosen.number] = EVENT_PACKET
    some, triggers, count = [], [np.empty(0, TRIGGER)], 0
    for number, buffer in packets(request, layout, kinds):
        if number != chosen.number:
            triggers.append(_triggers(request, buffer))
            request.tally.skipped += len(triggers[-1])
            continue
        some.append(_events(request, buffer))
        count += len(some[-1])
        if count >= request.part_events:
            yield _part(request, some, triggers)
            some, triggers, count = [], [np.empty(0, TRIGGER)], 0
    yield _part(request, some, triggers)


def _part(request: Request, some: list[np.ndarray], triggers: list[np.ndarray]) -> Part:
    """Return packets as one part."""
    packed = np.concatenate([np.empty(0, PACKED_EVENT), *some])
    on = (packed["on"] != 0).view(np.int8)
    return assemble(request, packed["t"], packed["x"], packed["y"], on, triggers=np.concatenate(triggers))


def _unpacked(body: bytes, codec: str | None, kind: bytes) -> bytes:
    """Return one flatbuffer of a kind; no more is unpacked than its first four bytes declare."""
    if codec is None:
        whole = body[4:]
    else:
        import pyarrow  # half a second, and only for this format

        with pyarrow.CompressedInputStream(pyarrow.py_buffer(body), codec) as packed:
            (size,) = struct.unpack("<I", packed.read(4))
            if size > MAX_PACKET_BYTES:
                raise ValueError(f"a packet declares {size} bytes; at most {MAX_PACKET_BYTES} are unpacked")
            whole = packed.read(size)
        if len(whole) != size:
            raise ValueError(f"a packet declares {size} bytes and contains {len(whole)}")
    if whole[4:8] != kind:
        raise ValueError(f"where a packet of {kind.decode()} should be is one of {whole[4:8]!r}")
    return whole


def _events(request: Request, buffer: bytes) -> np.ndarray:
    """Return the events of one flatbuffer `EventPacket`, copied, so that the rest of the packet is freed."""
    with request.refusing(BROKEN, DAMAGED):
        start, count = root(buffer).vector(0, PACKED_EVENT.itemsize)
    return np.frombuffer(buffer, PACKED_EVENT, count, start).copy()


def _triggers(request: Request, buffer: bytes) -> np.ndarray:
    """Return the external triggers of one flatbuffer `TriggerPacket`."""
    with request.refusing(BROKEN, DAMAGED):
        rows = [
            (int(row.scalar(0, "q", 0)), *EDGES[int(row.scalar(1, "b", 0))])
            for row in root(buffer).tables(0)
            if int(row.scalar(1, "b", 0)) in EDGES
        ]
    return np.array(rows, TRIGGER)


def _streams(head: Table) -> Iterator[Stream]:
    """Yield the streams that the header's XML describes."""
    start, count = head.vector(2, 1)
    if not count:
        raise ValueError("its header describes no streams")
    text = head.buffer[start : start + count].decode()
    if "<!" in text:
        raise ValueError("its header declares XML entities, which are not read")
    document = ElementTree.fromstring(text)  # noqa: S314  no entities are in it, nor more than a megabyte
    for node in document.iterfind(".//node[@name='outInfo']/node"):
        facts = {item.get("key"): item.text or "" for item in node.iterfind("attr")}
        sizes = {item.get("key"): item.text or "" for item in node.iterfind("node[@name='info']/attr")}
        width, height = (int(sizes[name]) if sizes.get(name) else None for name in ("sizeX", "sizeY"))
        yield Stream(
            int(node.get("name", "")), facts.get("typeIdentifier", "").encode("latin-1"), width, height
        )
