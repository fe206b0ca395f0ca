"""Walk through ROS bags that have no index, because the recorder crashed or the file was cut off.

By the descriptions of the bag format 2.0 (wiki.ros.org/Bags/Format/2.0) and of MCAP (mcap.dev/spec). What is
whole is read; the walk ends where the file does. It needs lz4 and zstd, which come with rosbags.
"""

import bz2
import contextlib
import io
import sqlite3
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

MAX_RECORD = 1 << 31


class Topic(NamedTuple):
    """A topic of a bag.

    Attributes:
        name: Such as "/dvs/events".
        kind: Type of its messages, package/Name.
        number: Number of messages; -1: not known.
    """

    name: str
    kind: str
    number: int


class Message(NamedTuple):
    """A message of a bag.

    Attributes:
        topic: Its topic.
        kind: Its type.
        raw: As it is serialized.
    """

    topic: str
    kind: str
    raw: bytes


Walk = Callable[[Path], Iterator[Topic | Message]]


def topics(path: Path) -> list[Topic]:
    """Return the topics of a bag without an index."""
    return list(dict.fromkeys(item for item in _walk(path) if isinstance(item, Topic)))


def messages(path: Path, names: set[str]) -> Iterator[Message]:
    """Yield the whole messages of some topics of a bag without an index."""
    for item in _walk(path):
        if isinstance(item, Message) and item.topic in names:
            yield item


def _walk(path: Path) -> Iterator[Topic | Message]:
    """Yield topics and messages in the order of the file, until it ends or makes no sense."""
    with path.open("rb") as file:
        magic = file.read(16)
    walk: Walk = _walk_db3
    if magic.startswith(b"#ROSBAG"):
        walk = _walk_bag
    elif magic.startswith(b"\x89MCAP"):
        walk = _walk_mcap
    with contextlib.suppress(struct.error, sqlite3.Error, KeyError, EOFError, UnicodeDecodeError, OSError):
        yield from walk(path)


def _walk_bag(path: Path) -> Iterator[Topic | Message]:
    """Walk through a bag of ROS 1."""
    known: dict[bytes, Topic] = {}
    with path.open("rb") as file:
        file.readline()
        for header, data, is_whole in _bag_records(file, path.stat().st_size):
            if header.get(b"op") == b"\x05":  # a chunk, which may have been cut off
                chunk = _unpacked(data, header[b"compression"].decode())
                for fields, record, is_there in _bag_records(io.BytesIO(chunk), len(chunk)):
                    if is_there:
                        yield from _bag_record(fields, record, known)
            elif is_whole:
                yield from _bag_record(header, data, known)


def _bag_records(file: BinaryIO, most: int) -> Iterator[tuple[dict[bytes, bytes], bytes, bool]]:
    """Yield header and data of each record, and whether these are whole.

    At most `most` bytes are read at once: memory for a damaged size would be taken before.
    """
    while len(size := file.read(4)) == 4:
        (length,) = struct.unpack("<I", size)
        head = file.read(min(length, most))
        if length > MAX_RECORD or len(head) < length:
            return
        fields = _split(head)
        (length,) = struct.unpack("<I", file.read(4))
        if length > MAX_RECORD:
            return
        data = file.read(min(length, most))
        yield fields, data, len(data) == length


def _bag_record(
    header: dict[bytes, bytes], data: bytes, known: dict[bytes, Topic]
) -> Iterator[Topic | Message]:
    """Yield what a record of a connection or a message says."""
    if header.get(b"op") == b"\x07":
        facts = _split(data)
        known[header[b"conn"]] = Topic(header[b"topic"].decode(), facts[b"type"].decode(), -1)
        yield known[header[b"conn"]]
    if header.get(b"op") == b"\x02" and header[b"conn"] in known:
        topic = known[header[b"conn"]]
        yield Message(topic.name, topic.kind, data)


def _split(head: bytes) -> dict[bytes, bytes]:
    """Return the fields of a header: their length, then name=value."""
    fields, place = {}, 0
    while place < len(head):
        (size,) = struct.unpack_from("<I", head, place)
        name, _, value = head[place + 4 : place + 4 + size].partition(b"=")
        fields[name] = value
        place += 4 + size
    return fields


def _walk_mcap(path: Path) -> Iterator[Topic | Message]:
    """Walk through an mcap file."""
    known: dict[int, Topic] = {}
    kinds: dict[int, str] = {0: ""}
    with path.open("rb") as file:
        file.seek(8)
        for code, data, is_whole in _mcap_records(file, path.stat().st_size):
            if code == 0:
                return
            if code == 6:  # a chunk, which may have been cut off
                compression, place = _text(data, 28)
                chunk = _unpacked(data[place + 8 :], compression)
                for name, record, is_there in _mcap_records(io.BytesIO(chunk), len(chunk)):
                    if is_there:
                        yield from _mcap_record(name, record, known, kinds)
            elif is_whole:
                yield from _mcap_record(code, data, known, kinds)


def _mcap_records(file: BinaryIO, most: int) -> Iterator[tuple[int, bytes, bool]]:
    """Yield code and data of each record, and whether these are whole; at most `most` bytes at once."""
    while len(head := file.read(9)) == 9:
        code, size = struct.unpack("<BQ", head)
        if size > MAX_RECORD:
            return
        data = file.read(min(size, most))
        yield code, data, len(data) == size


def _mcap_record(
    code: int, data: bytes, known: dict[int, Topic], kinds: dict[int, str]
) -> Iterator[Topic | Message]:
    """Yield what a record of a schema, a channel or a message says."""
    if code == 3:
        (number,) = struct.unpack_from("<H", data)
        kinds[number] = _text(data, 2)[0].replace("/msg/", "/")
    elif code == 4:
        number, schema = struct.unpack_from("<HH", data)
        known[number] = Topic(_text(data, 4)[0], kinds.get(schema, ""), -1)
        yield known[number]
    elif code == 5:
        (number,) = struct.unpack_from("<H", data)
        if number in known:
            yield Message(known[number].name, known[number].kind, data[22:])


def _text(data: bytes, place: int) -> tuple[str, int]:
    """Return a text after its length, and the place behind it."""
    (size,) = struct.unpack_from("<I", data, place)
    return data[place + 4 : place + 4 + size].decode(), place + 4 + size


def _walk_db3(path: Path) -> Iterator[Topic | Message]:
    """Walk through a database, row by row until one is damaged."""
    with contextlib.closing(sqlite3.connect(f"file:{path}?mode=ro&immutable=1", uri=True)) as database:
        rows = database.execute("SELECT id, name, type FROM topics").fetchall()
        known = {number: Topic(name, kind.replace("/msg/", "/"), -1) for number, name, kind in rows}
        yield from known.values()
        for number, raw in database.execute("SELECT topic_id, data FROM messages"):
            if number in known:
                yield Message(known[number].name, known[number].kind, raw)


def _unpacked(data: bytes, compression: str) -> bytes:
    """Return what can be unpacked of a chunk."""
    if compression in ("", "none"):
        return data
    if compression == "bz2":
        return bz2.BZ2Decompressor().decompress(data)
    if compression == "lz4":
        import lz4.frame

        unpacked: bytes = lz4.frame.LZ4FrameDecompressor().decompress(data)
        return unpacked
    from backports import zstd

    whole: bytes = zstd.ZstdDecompressor().decompress(data)
    return whole
