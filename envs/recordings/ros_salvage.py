"""Walk through ROS bags that have no index, because the recorder crashed or the file was cut off.

By the descriptions of the bag format 2.0 (wiki.ros.org/Bags/Format/2.0) and of MCAP (mcap.dev/spec). What is
whole is read; the walk ends where the file does. It needs lz4 and zstd, which come with rosbags.
"""

import bz2
import contextlib
import os
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


def _present(file: BinaryIO, size: int) -> bytes:
    """Return the next bytes, as many as there are: memory for a damaged size would be taken before."""
    return file.read(min(size, os.fstat(file.fileno()).st_size))


def _walk_bag(path: Path) -> Iterator[Topic | Message]:
    """Walk through a bag of ROS 1."""
    known: dict[bytes, Topic] = {}
    with path.open("rb") as file:
        file.readline()
        while (header := _fields(lambda size: _present(file, size))) is not None:
            (size,) = struct.unpack("<I", file.read(4))
            if size > MAX_RECORD:
                return
            data = _present(file, size)
            if header.get(b"op") == b"\x05":
                yield from _walk_chunk(_unpacked(data, header[b"compression"].decode()), known)
            else:
                yield from _bag_record(header, data, size, known)


def _walk_chunk(chunk: bytes, known: dict[bytes, Topic]) -> Iterator[Topic | Message]:
    """Walk through the records of a chunk, which may have been cut off."""
    place = 0

    def read(size: int) -> bytes:
        nonlocal place
        place += size
        return chunk[place - size : place]

    while place < len(chunk) and (header := _fields(read)) is not None:
        (size,) = struct.unpack("<I", read(4))
        yield from _bag_record(header, read(size), size, known)


def _bag_record(
    header: dict[bytes, bytes], data: bytes, size: int, known: dict[bytes, Topic]
) -> Iterator[Topic | Message]:
    """Yield what a record of a connection or a message says, if it is whole."""
    if len(data) < size:
        return
    if header.get(b"op") == b"\x07":
        facts = _split(data)
        known[header[b"conn"]] = Topic(header[b"topic"].decode(), facts[b"type"].decode(), -1)
        yield known[header[b"conn"]]
    if header.get(b"op") == b"\x02" and header[b"conn"] in known:
        topic = known[header[b"conn"]]
        yield Message(topic.name, topic.kind, data)


def _fields(read: Callable[[int], bytes]) -> dict[bytes, bytes] | None:
    """Return the header of the next record, or None at the end."""
    size = read(4)
    if len(size) < 4:
        return None
    (length,) = struct.unpack("<I", size)
    head = read(length) if length <= MAX_RECORD else b""
    return _split(head) if len(head) == length else None


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
        while len(head := file.read(9)) == 9:
            code, size = struct.unpack("<BQ", head)
            if size > MAX_RECORD or code == 0:
                return
            data = _present(file, size)
            if code == 6:  # a chunk
                for name, record in _mcap_chunk(data):
                    yield from _mcap_record(name, record, known, kinds)
            elif len(data) == size:
                yield from _mcap_record(code, data, known, kinds)


def _mcap_chunk(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the whole records of a chunk."""
    compression, place = _text(data, 28)
    chunk = _unpacked(data[place + 8 :], compression)
    place = 0
    while place + 9 <= len(chunk):
        code, size = struct.unpack_from("<BQ", chunk, place)
        if place + 9 + size > len(chunk):
            return
        yield code, chunk[place + 9 : place + 9 + size]
        place += 9 + size


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
