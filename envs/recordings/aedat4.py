"""Read and write AEDAT 4.0, the files of iniVation's DV: compressed flatbuffers in numbered streams.

The reader checks every offset and the type of each packet, so that a damaged file raises an error. A
truncated file is read up to its end. Flatbuffers (google.github.io/flatbuffers, "Internals") are read
without a library: a struct.error or ValueError means that a buffer is damaged. The writer uses one layout, by
the schema of dv-processing (IOHeader, EventPacket, FileDataTable): each is a flatbuffer preceded by its size.
"""

import contextlib
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from core.files import replaced
from envs.recordings.event_file import CUT, CUT_PACKETS, TRIGGER, Append, Opened, Request, gathered

MAGIC_4 = b"#!AER-DAT4.0\r\n"
EVENT_PACKET, PACKET_TABLE = b"EVTS", b"FTAB"  # identifiers of flatbuffers
TRIGGER_PACKET = b"TRIG"
MAX_HEADER_BYTES = 1 << 20
MAX_PACKET_BYTES = 1 << 28
CODECS = {1: "lz4", 2: "lz4", 3: "zstd", 4: "zstd"}
PACKED_EVENT = np.dtype([("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("p", "u1"), ("pad", "V3")])
# Trigger type -> channel (1 is the generator) and edge.
EDGES = {1: (0, 1), 2: (0, -1), 3: (0, 0), 4: (1, 1), 5: (1, -1)}
BROKEN = (struct.error, ElementTree.ParseError, UnicodeDecodeError, OSError, ValueError)
DAMAGED = "is damaged or no AEDAT 4.0 file ({}); copy or record it again"
MAX_PIXELS = 1 << 15  # a coordinate is a signed 16-bit integer
PACKET_EVENTS = 1 << 14
LZ4 = 1
TABLE_PLACE = len(MAGIC_4) + 32  # position of the field that contains the start of the packet table
DESCRIPTION = """<dv version="2.0">
    <node name="outInfo" path="/outInfo/">
        <node name="0" path="/outInfo/0/">
            <attr key="compression" type="string">LZ4</attr>
            <attr key="originalModuleName" type="string">evade</attr>
            <attr key="originalOutputName" type="string">events</attr>
            <attr key="typeDescription" type="string">Array of events (polarity ON/OFF).</attr>
            <attr key="typeIdentifier" type="string">EVTS</attr>
            <node name="info" path="/outInfo/0/info/">
                <attr key="sizeX" type="int">{width}</attr>
                <attr key="sizeY" type="int">{height}</attr>
                <attr key="source" type="string">evade</attr>
            </node>
        </node>
    </node>
</dv>
"""
# A row of the table of packets: a flatbuffer's table with five fields.
PACKET = np.dtype(
    {
        "names": ["fields", "pad", "place", "stream", "size", "count", "first_us", "last_us"],
        "formats": ["<i4", "<i4", "<i8", "<i4", "<i4", "<i8", "<i8", "<i8"],
    }
)


class Table(NamedTuple):
    """A table in a flatbuffer, with every offset checked.

    Attributes:
        buffer: The bytes.
        place: Position of its first byte.
    """

    buffer: bytes
    place: int

    def field(self, number: int) -> int | None:
        """Return the position of a field, or None if the field has its default."""
        (back,) = struct.unpack_from("<i", self.buffer, self.place)
        if not 0 <= self.place - back < len(self.buffer):
            raise ValueError("a table points outside its packet")
        (size,) = struct.unpack_from("<H", self.buffer, self.place - back)
        if 4 + 2 * number + 2 > size:
            return None
        (offset,) = struct.unpack_from("<H", self.buffer, self.place - back + 4 + 2 * number)
        return self.place + offset if offset else None

    def scalar(self, number: int, code: str, default: float) -> float:
        """Return a number by its code for `struct`."""
        place = self.field(number)
        value: float = default if place is None else struct.unpack_from("<" + code, self.buffer, place)[0]
        return value

    def vector(self, number: int, size: int) -> tuple[int, int]:
        """Return the position of the first element of a vector or text, and the number of elements.

        `size` is the size of an element [bytes].

        Raises:
            ValueError: The elements do not fit into the buffer.
        """
        place = self.field(number)
        if place is None:
            return 0, 0
        (offset,) = struct.unpack_from("<I", self.buffer, place)
        (count,) = struct.unpack_from("<I", self.buffer, place + offset)
        start = place + offset + 4
        if count * size > len(self.buffer) - start:
            raise ValueError(f"a packet declares {count} entries and has no room for them")
        return start, count

    def tables(self, number: int) -> Iterator["Table"]:
        """Yield the tables of a vector of tables."""
        start, count = self.vector(number, 4)
        for place in range(start, start + 4 * count, 4):
            (offset,) = struct.unpack_from("<I", self.buffer, place)
            yield Table(self.buffer, place + offset)


def root(buffer: bytes) -> Table:
    """Return the root table of a buffer."""
    (place,) = struct.unpack_from("<I", buffer)
    return Table(buffer, place)


class Stream(NamedTuple):
    """One stream of a file.

    Attributes:
        number: Number of the stream in its packets.
        kind: Identifier, such as b"EVTS" for events.
        width, height: Size of the sensor, or None.
    """

    number: int
    kind: bytes
    width: int | None
    height: int | None


class Layout(NamedTuple):
    """Contents of the header.

    Attributes:
        codec: Compression of the packets, or None.
        streams: All streams.
        start, end: First byte of the packets, and the byte after the last.
        is_whole: Whether the file is as long as the header declares.
    """

    codec: str | None
    streams: list[Stream]
    start: int
    end: int
    is_whole: bool


def read_aedat4(request: Request) -> Opened:
    """Open one stream of events of an AEDAT 4.0 file, uncompressed or packed with LZ4 or Zstandard.

    Triggers are read with the events. If there are several streams of events, `stream` chooses one, else
    the first is read.

    Raises:
        ValueError: The header or a packet is damaged, a packet is larger than 256 MiB, or there is no
            stream of events.
    """
    layout = read_layout(request)
    chosen = choose(request, layout.streams, EVENT_PACKET)
    if not layout.is_whole:
        request.tally.damage[CUT_PACKETS] += 1
    request = request.sized(chosen.width, chosen.height)
    return Opened("aedat4", request, gathered(request, PACKED_EVENT, _packets(request, layout, chosen)))


def read_layout(request: Request) -> Layout:
    """Read the header of a file.

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
    """Return the stream of this kind that the caller names, else the first; add a note about the others.

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
        layout: Contents of its header.
        kinds: Identifiers of the wanted streams, by number.

    Raises:
        ValueError: A packet is damaged; a last packet that is only truncated is counted instead.
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


def _packets(request: Request, layout: Layout, chosen: Stream) -> Iterator[np.ndarray]:
    """Yield the events of the packets of a stream, and the triggers of all streams."""
    kinds = {stream.number: stream.kind for stream in layout.streams if stream.kind == TRIGGER_PACKET}
    kinds[chosen.number] = EVENT_PACKET
    for number, buffer in packets(request, layout, kinds):
        if number == chosen.number:
            yield _events(request, buffer)
        else:
            triggers = _triggers(request, buffer)
            request.tally.skipped += len(triggers)
            yield triggers


def _unpacked(body: bytes, codec: str | None, kind: bytes) -> bytes:
    """Return one flatbuffer of a kind; unpack no more bytes than its first four bytes declare."""
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
    """Return a copy of the events of one flatbuffer `EventPacket`, so that the packet can be freed."""
    with request.refusing(BROKEN, DAMAGED):
        start, count = root(buffer).vector(0, PACKED_EVENT.itemsize)
    events = np.frombuffer(buffer, PACKED_EVENT, count, start).copy()
    events["p"] = events["p"] != 0
    return events


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
    document = ElementTree.fromstring(text)  # noqa: S314  it has no entities and at most a megabyte
    for node in document.iterfind(".//node[@name='outInfo']/node"):
        facts = {item.get("key"): item.text or "" for item in node.iterfind("attr")}
        sizes = {item.get("key"): item.text or "" for item in node.iterfind("node[@name='info']/attr")}
        width, height = (int(sizes[name]) if sizes.get(name) else None for name in ("sizeX", "sizeY"))
        yield Stream(
            int(node.get("name", "")), facts.get("typeIdentifier", "").encode("latin-1"), width, height
        )


@contextlib.contextmanager
def aedat4_writer(path: Path, width: int, height: int) -> Iterator[Append]:
    """Yield a function that adds events to one stream of packets.

    Raises:
        ValueError: The sensor has more than 32768 columns or rows.
    """
    import pyarrow  # half a second, and only for this format

    if max(width, height) > MAX_PIXELS:
        raise ValueError(f"aedat4 addresses at most {MAX_PIXELS} pixels, got {width}x{height}")
    codec, rows = pyarrow.Codec("lz4"), []
    with replaced(path) as part, part.open("wb") as file:
        file.write(MAGIC_4 + _file_header(DESCRIPTION.format(width=width, height=height).encode()))

        def append(events: np.ndarray, _: np.ndarray | None) -> None:
            for first in range(0, len(events), PACKET_EVENTS):
                some = _packed(events[first : first + PACKET_EVENTS])
                body = codec.compress(_vector(EVENT_PACKET, len(some), some.tobytes()), asbytes=True)
                file.write(struct.pack("<ii", 0, len(body)))
                rows.append((0, 0, file.tell(), 0, len(body), len(some), *some["t"][[0, -1]].tolist()))
                file.write(body)

        yield append
        table = file.tell()
        file.write(codec.compress(_packet_table(np.array(rows, PACKET)), asbytes=True))
        file.seek(TABLE_PLACE)
        file.write(struct.pack("<q", table))


def _packed(events: np.ndarray) -> np.ndarray:
    """Return events in the form of a packet."""
    packed = np.zeros(len(events), PACKED_EVENT)
    for name in ("t", "x", "y"):
        packed[name] = events[name]
    packed["p"] = events["p"] > 0
    return packed


def _file_header(description: bytes) -> bytes:
    """Return IOHeader: the codec, the start of the packet table (still -1), and the streams' description."""
    fields = struct.pack("<HHHHH2x", 10, 20, 4, 8, 16)  # sizes of this list and of the table, then offsets
    table = struct.pack("<iiqI", 12, LZ4, -1, 4)
    text = struct.pack("<I", len(description)) + description + b"\0"
    return _sized(struct.pack("<I4s", 20, b"IOHE") + fields + table + text)


def _vector(kind: bytes, count: int, elements: bytes) -> bytes:
    """Return a flatbuffer whose root table has one field, a vector; it starts 32 bytes after the size."""
    fields = struct.pack("<HHH2x", 6, 8, 4)
    return _sized(struct.pack("<I4s", 16, kind) + fields + struct.pack("<iII", 8, 4, count) + elements)


def _packet_table(rows: np.ndarray) -> bytes:
    """Return FileDataTable: a vector of offsets to the rows, which share one list of fields."""
    fields = struct.pack("<HHHHHHH2x", 14, PACKET.itemsize, 8, 16, 24, 32, 40)
    list_place = 32 + 4 * len(rows)
    first = -(-(list_place + len(fields)) // 8) * 8
    places = first + PACKET.itemsize * np.arange(len(rows))
    rows["fields"] = places - list_place
    offsets = (places - 32 - 4 * np.arange(len(rows))).astype("<u4")
    gap = bytes(first - list_place - len(fields))
    return _vector(PACKET_TABLE, len(rows), offsets.tobytes() + fields + gap + rows.tobytes())


def _sized(buffer: bytes) -> bytes:
    """Return a flatbuffer preceded by its size, padded to a multiple of 8 bytes."""
    buffer += bytes(-(4 + len(buffer)) % 8)
    return struct.pack("<I", len(buffer)) + buffer
