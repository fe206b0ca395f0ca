"""Files of iniVation cameras and jAER are read: AEDAT 2.0 and AEDAT 4.0.

AEDAT 2.0 is read from its description (inivation.github.io, "AEDAT file formats"). AEDAT 4.0
is packets of compressed flatbuffers; the walk through them checks every offset and that each is
of the kind that it should be, so that a damaged file is refused. Other streams in a file (frames,
inertial samples) are passed over.
"""

import struct
from xml.etree import ElementTree

import numpy as np

from envs.recordings.event_file import EventFile, Request, assemble, finish, unwrap

MAGIC_2 = b"#!AER-DAT2"
MAGIC_4 = b"#!AER-DAT4.0\r\n"
EVENT_PACKET, PACKET_TABLE = b"EVTS", b"FTAB"  # identifiers of flatbuffers
MAX_HEADER_BYTES = 1 << 20
MAX_PACKET_BYTES = 1 << 28

DVS128_SIZE = (128, 128)
DAVIS_SIZES = {"DAVIS240": (240, 180), "DAVIS346": (346, 260), "DAVIS640": (640, 480), "DAVIS128": (128, 128)}
DVS128_SPECIAL = 0x8000
DAVIS_SPECIAL = 0x80000400  # a frame's or inertial sample (bit 31), an external event (bit 10)

CODECS = {1: "lz4", 2: "lz4", 3: "zstd", 4: "zstd"}
PACKED_EVENT = np.dtype(
    {
        "names": ["t", "x", "y", "on"],
        "formats": ["<i8", "<i2", "<i2", "u1"],
        "offsets": [0, 8, 10, 12],
        "itemsize": 16,
    }
)


def read_aedat2(request: Request) -> EventFile:
    """Events of an AEDAT 2.0 file of a DVS128 or of a DAVIS.

    The camera is the one that the header names (`AEChip`), else the one with the size that
    the caller gives, else a DVS128 if all addresses fit into its 16 bits. jAER counts rows
    from below and shows columns mirrored; x and y here go right and down. The 32-bit clock
    is unwrapped.

    Raises:
        ValueError: A truncated body, an unknown camera, or a rule of `finish`.
    """
    raw = request.path.read_bytes()
    start, chip = _aedat2_header(request, raw)
    if (len(raw) - start) % 8:
        raise request.refusal(
            f"is truncated: {len(raw) - start} bytes after the header are no whole number of 8-byte entries; "
            f"copy it again, or cut its last {(len(raw) - start) % 8} bytes"
        )
    body = np.frombuffer(raw, ">u4", offset=start).reshape(-1, 2)
    request.check_count(len(body))
    address, t_us = body[:, 0].astype(np.uint32), unwrap(body[:, 1], 32)
    width, height, is_davis = _camera(request, chip, address)
    request = request.sized(width, height)
    kept = address & (DAVIS_SPECIAL if is_davis else DVS128_SPECIAL) == 0
    address, t_us = address[kept], t_us[kept]
    if is_davis:
        x, y, p = address >> 12 & 1023, address >> 22 & 511, address >> 11 & 1
    else:
        x, y, p = address >> 1 & 127, address >> 8 & 127, 1 - (address & 1)
    if len(x) and (x.max() >= width or y.max() >= height):
        raise request.refusal(
            f"has addresses up to x={x.max()}, y={y.max()}, outside a sensor of {width}x{height}; "
            "give the camera's width and height, or repair the file"
        )
    events = assemble(request, t_us, width - 1 - x, height - 1 - y, p)
    return finish(request, "aedat2", events, int(np.count_nonzero(~kept)))


def _aedat2_header(request: Request, raw: bytes) -> tuple[int, str]:
    """Where the entries begin, and the name of the camera's chip or an empty text."""
    start, chip = 0, ""
    while raw.startswith(b"#", start):
        end = raw.find(b"\n", start, start + MAX_HEADER_BYTES)
        if end < 0:
            raise request.refusal("has a header without end; it is no AEDAT 2.0 file, or damaged")
        line = raw[start:end]
        start = end + 1
        if line.startswith(b"# AEChip:"):
            chip = line.partition(b":")[2].strip().decode("latin-1")
        if line.startswith(b"#End Of ASCII Header"):
            break
    return start, chip


def _camera(request: Request, chip: str, address: np.ndarray) -> tuple[int, int, bool]:
    """Width, height and whether the addresses are those of a DAVIS."""
    for name, size in DAVIS_SIZES.items():
        if name in chip.upper():
            return *size, True
    given = (request.width, request.height)
    if chip.endswith("DVS128") or given == DVS128_SIZE:
        return *DVS128_SIZE, False
    if not chip and given in DAVIS_SIZES.values():
        return *DAVIS_SIZES[next(name for name, size in DAVIS_SIZES.items() if size == given)], True
    if chip or given != (None, None) or (len(address) and address.max() >= 1 << 16):
        sizes = ", ".join(f"{width}x{height}" for width, height in DAVIS_SIZES.values())
        raise request.refusal(
            f"is of {chip or 'an unknown camera'}, no DVS128 or DAVIS; give width and height of one ({sizes})"
        )
    return *DVS128_SIZE, False


def read_aedat4(request: Request) -> EventFile:
    """Events of an AEDAT 4.0 file, uncompressed or packed with LZ4 or Zstandard.

    Raises:
        ValueError: A truncated or damaged packet, none or several event streams, a packet of
            more than 256 MiB, a table of packets that is not where the header says, or a rule of
            `finish`.
    """
    raw = request.path.read_bytes()
    try:
        (size,) = struct.unpack_from("<I", raw, len(MAGIC_4))
        start = len(MAGIC_4) + 4
        if not 0 < size <= min(MAX_HEADER_BYTES, len(raw) - start):
            raise ValueError(f"its header declares {size} bytes")
        header = raw[start : start + size]
        stream, width, height = _event_stream(header)
        request = request.sized(width, height)
        codec = CODECS.get(_scalar(header, 0, "<i", 0))
        end = _scalar(header, 1, "<q", -1)  # where the table of packets begins, if there is one
        if end == -1:
            end = len(raw)
        elif not start + size <= end < len(raw):
            raise ValueError(f"its table of packets should be at byte {end} of {len(raw)}")
        else:
            _unpacked(memoryview(raw)[end:], codec, PACKET_TABLE)
        parts, count = [], 0
        for body in _packets(raw, start + size, end, stream):
            # A copy lets go of the rest of its packet.
            parts.append(_events(_unpacked(body, codec, EVENT_PACKET)).copy())
            count += len(parts[-1])
            request.check_count(count)
    except (struct.error, ElementTree.ParseError, UnicodeDecodeError, OSError, ValueError) as error:
        if str(error).startswith(str(request.path)):
            raise
        raise request.refusal(f"is damaged or no AEDAT 4.0 file ({error}); copy or record it again") from None
    packed = np.concatenate([np.empty(0, PACKED_EVENT), *parts])
    events = assemble(request, packed["t"], packed["x"], packed["y"], (packed["on"] != 0).view(np.int8))
    return finish(request, "aedat4", events)


def _packets(raw: bytes, start: int, end: int, stream: int) -> list[memoryview]:
    """The packed bodies of one stream."""
    bodies, view = [], memoryview(raw)
    while start < end:
        number, size = struct.unpack_from("<ii", raw, start)
        start += 8
        if not 0 <= size <= end - start:
            raise ValueError(f"the packet at byte {start - 8} declares {size} bytes and {end - start} follow")
        if number == stream:
            bodies.append(view[start : start + size])
        start += size
    return bodies


def _unpacked(body: memoryview, codec: str | None, kind: bytes) -> bytes:
    """One flatbuffer of a kind; no more is unpacked than its first four bytes declare."""
    if codec is None:
        whole = bytes(body[4:])
    else:
        import pyarrow  # half a second, and only for this format

        with pyarrow.CompressedInputStream(pyarrow.py_buffer(body), codec) as packed:
            (size,) = struct.unpack("<I", packed.read(4))
            if size > MAX_PACKET_BYTES:
                raise ValueError(f"a packet declares {size} bytes; at most {MAX_PACKET_BYTES} are unpacked")
            whole = packed.read(size)
        if len(whole) != size:
            raise ValueError(f"a packet declares {size} bytes and holds {len(whole)}")
    if whole[4:8] != kind:
        raise ValueError(f"where a packet of {kind.decode()} should be is one of {whole[4:8]!r}")
    return whole


def _events(buffer: bytes) -> np.ndarray:
    """The events of one flatbuffer `EventPacket`."""
    place = _field(buffer, 0)
    if place is None:
        return np.empty(0, PACKED_EVENT)
    start, count = _vector(buffer, place)
    if count * PACKED_EVENT.itemsize > len(buffer) - start:
        raise ValueError(f"a packet declares {count} events and has no room for them")
    return np.frombuffer(buffer, PACKED_EVENT, count, start)


def _event_stream(header: bytes) -> tuple[int, int, int]:
    """Number, width and height of the one event stream that the header's XML describes."""
    place = _field(header, 2)
    if place is None:
        raise ValueError("its header describes no streams")
    start, count = _vector(header, place)
    text = header[start : start + count].decode()
    if "<!" in text:
        raise ValueError("its header declares XML entities, which are not read")
    found = []
    document = ElementTree.fromstring(text)  # noqa: S314  no entities are in it, nor more than a megabyte
    for node in document.iterfind(".//node[@name='outInfo']/node"):
        facts = {item.get("key"): item.text or "" for item in node.iterfind("attr")}
        if facts.get("typeIdentifier") == "EVTS":
            sizes = {item.get("key"): item.text or "" for item in node.iterfind("node[@name='info']/attr")}
            found.append(
                (int(node.get("name", "")), int(sizes.get("sizeX", "")), int(sizes.get("sizeY", "")))
            )
    if len(found) != 1:
        raise ValueError(f"it holds {len(found)} event streams; files with one are read")
    return found[0]


def _field(buffer: bytes, number: int) -> int | None:
    """Where a field of the root table of a flatbuffer lies, or None if it has its default."""
    (table,) = struct.unpack_from("<I", buffer)
    (back,) = struct.unpack_from("<i", buffer, table)
    if table - back < 0:
        raise ValueError("a table points outside its packet")
    (size,) = struct.unpack_from("<H", buffer, table - back)
    if 4 + 2 * number + 2 > size:
        return None
    (offset,) = struct.unpack_from("<H", buffer, table - back + 4 + 2 * number)
    return table + offset if offset else None


def _vector(buffer: bytes, place: int) -> tuple[int, int]:
    """Where the elements of a vector or text begin, and how many there are."""
    (offset,) = struct.unpack_from("<I", buffer, place)
    (count,) = struct.unpack_from("<I", buffer, place + offset)
    return place + offset + 4, count


def _scalar(buffer: bytes, number: int, code: str, default: int) -> int:
    """A number in the root table of a flatbuffer."""
    place = _field(buffer, number)
    return default if place is None else int(struct.unpack_from(code, buffer, place)[0])
