"""Write AEDAT 4.0: a header, packets of events packed with LZ4, and a table of the packets.

By the schema of dv-processing (IOHeader, EventPacket, FileDataTable): each part is a flatbuffer
after its size. All have one layout here, which is therefore written without a library.
"""

import contextlib
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from core.files import replaced
from envs.recordings.aedat4 import EVENT_PACKET, MAGIC_4, PACKED_EVENT, PACKET_TABLE
from envs.recordings.writing import Append

MAX_PIXELS = 1 << 15  # a coordinate is a signed 16-bit integer
PACKET_EVENTS = 1 << 14
LZ4 = 1
TABLE_PLACE = len(MAGIC_4) + 32  # of the field that says where the table begins
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
        file.write(MAGIC_4 + _header(DESCRIPTION.format(width=width, height=height).encode()))

        def append(events: np.ndarray, _: np.ndarray | None) -> None:
            for first in range(0, len(events), PACKET_EVENTS):
                some = _packed(events[first : first + PACKET_EVENTS])
                body = codec.compress(_vector(EVENT_PACKET, len(some), some.tobytes()), asbytes=True)
                file.write(struct.pack("<ii", 0, len(body)))
                rows.append((0, 0, file.tell(), 0, len(body), len(some), *some["t"][[0, -1]].tolist()))
                file.write(body)

        yield append
        table = file.tell()
        file.write(codec.compress(_table(np.array(rows, PACKET)), asbytes=True))
        file.seek(TABLE_PLACE)
        file.write(struct.pack("<q", table))


def _packed(events: np.ndarray) -> np.ndarray:
    """Return events as a packet has them."""
    packed = np.zeros(len(events), PACKED_EVENT)
    for name in ("t", "x", "y"):
        packed[name] = events[name]
    packed["on"] = events["p"] > 0
    return packed


def _header(description: bytes) -> bytes:
    """Return IOHeader: the codec, where the table begins (still -1), and the description of the streams."""
    fields = struct.pack("<HHHHH2x", 10, 20, 4, 8, 16)  # sizes of this list and of the table, then places
    table = struct.pack("<iiqI", 12, LZ4, -1, 4)
    return _sized(struct.pack("<I4s", 20, b"IOHE") + fields + table + _text(description))


def _text(text: bytes) -> bytes:
    return struct.pack("<I", len(text)) + text + b"\0"


def _vector(kind: bytes, count: int, elements: bytes) -> bytes:
    """Return a flatbuffer whose root table has one field, a vector, that begins 32 bytes from its size."""
    fields = struct.pack("<HHH2x", 6, 8, 4)
    return _sized(struct.pack("<I4s", 16, kind) + fields + struct.pack("<iII", 8, 4, count) + elements)


def _table(rows: np.ndarray) -> bytes:
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
    """Return a flatbuffer after its size, filled up to whole 8 bytes."""
    buffer += bytes(-(4 + len(buffer)) % 8)
    return struct.pack("<I", len(buffer)) + buffer
