"""Read the messages of ROS bags: ROS 1, and rosbag2 in db3 or mcap; also of truncated bags.

Complete bags are read with the library rosbags (the extra `ros`). It cannot read a bag without an index, such
as a crashed recorder leaves. Such a bag is read record by record up to its end, by the descriptions of the
bag format 2.0 (wiki.ros.org/Bags/Format/2.0) and of MCAP (mcap.dev/spec). This needs lz4 and zstd, which come
with rosbags.
"""

import bz2
import contextlib
import io
import sqlite3
import struct
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from envs.recordings.event_file import Request

MAGIC_BAG, MAGIC_DB3, MAGIC_MCAP = b"#ROSBAG V2.0", b"SQLite format 3\0", b"\x89MCAP0\r\n"
STORAGE = (".db3", ".mcap")
MAX_RECORD = 1 << 31
BROKEN = (struct.error, sqlite3.Error, KeyError, EOFError, UnicodeDecodeError, OSError)  # ends of a walk


class Topic(NamedTuple):
    """A topic of a bag.

    Attributes:
        name: Name, such as "/dvs/events".
        kind: Type of its messages, package/Name.
        number: Number of messages; -1: not known.
    """

    name: str
    kind: str
    number: int


class Message(NamedTuple):
    """A message of a bag.

    Attributes:
        topic: Name of its topic.
        kind: Its type.
        raw: The serialized message.
    """

    topic: str
    kind: str
    raw: bytes


class Bag(NamedTuple):
    """A bag that is ready to be read.

    Attributes:
        path: A file, or the folder of a complete rosbag2.
        topics: Its topics.
        is_whole: Whether it has its index.
        is_ros1: Whether messages are serialized as in ROS 1.
    """

    path: Path
    topics: list[Topic]
    is_whole: bool
    is_ros1: bool


def is_bag_folder(path: Path) -> bool:
    """Whether a folder is a rosbag2."""
    return path.is_dir() and (
        (path / "metadata.yaml").is_file() or any(one.suffix in STORAGE for one in path.iterdir())
    )


def open_bags(request: Request) -> list[Bag]:
    """Return the bags of a path: one, or one for each file of a folder without metadata.

    Raises:
        ValueError: The library rosbags is missing, the path is no ROS bag, or the folder has no files of one.
    """
    path = request.path
    try:
        import rosbags  # noqa: F401
    except ImportError:
        raise request.refusal("is a ROS bag, which needs the library rosbags; pip install rosbags") from None
    if bag := _whole(path):
        return [bag]
    files = [path] if path.is_file() else sorted(one for one in path.iterdir() if one.suffix in STORAGE)
    if not files:
        raise request.refusal(
            "is a folder without .db3 or .mcap files; give the folder or a file of a rosbag2"
        )
    if path.is_file() and not _magic(path).startswith((MAGIC_BAG, MAGIC_DB3, MAGIC_MCAP)):
        raise request.refusal("is no ROS bag; give its format, or leave format out")
    return [_whole(one) or _cut(one) for one in files]


def messages(bag: Bag, topics: set[str]) -> Iterator[Message]:
    """Yield the complete messages of some topics, in the order of their recording.

    Where the library cannot read on, an empty message is the last one: its decoder counts it as damaged.
    """
    if not bag.is_whole:
        for item in _walk(bag.path):
            if isinstance(item, Message) and item.topic in topics:
                yield item
        return
    with _reader(bag.path) as reader:
        chosen = [one for one in reader.connections if one.topic in topics]
        try:
            for connection, _, raw in reader.messages(chosen) if chosen else ():
                yield Message(connection.topic, _kind(connection.msgtype), bytes(raw))
        except MemoryError:
            raise
        except Exception:  # the library's errors have no common base
            yield Message(chosen[0].topic, _kind(chosen[0].msgtype), b"")


def _whole(path: Path) -> Bag | None:
    """Return a bag that the library can open, or None if it cannot."""
    try:
        with _reader(path) as reader:
            counts = Counter[tuple[str, str]]()
            for one in reader.connections:
                counts[one.topic, _kind(one.msgtype)] += one.msgcount
    except Exception:  # the library's errors have no common base; `_cut` then tries the file
        return None
    topics = [Topic(name, kind, count) for (name, kind), count in counts.items()]
    return Bag(path, topics, True, _is_ros1(path))


def _cut(path: Path) -> Bag:
    """Return a bag without an index."""
    topics = list(dict.fromkeys(item for item in _walk(path) if isinstance(item, Topic)))
    return Bag(path, topics, False, _is_ros1(path))


def _reader(path: Path) -> Any:
    """Return the library's reader of a path by its content."""
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2

    return Reader1(path) if _is_ros1(path) else Reader2(path)


def _is_ros1(path: Path) -> bool:
    """Whether a path is a bag of ROS 1."""
    return path.is_file() and _magic(path).startswith(MAGIC_BAG)


def _magic(path: Path) -> bytes:
    """Return the first bytes of a file."""
    with path.open("rb") as file:
        return file.read(16)


def _kind(name: str) -> str:
    """Return a type of messages in the form common to ROS 1 and 2: package/Name."""
    return name.replace("/msg/", "/")


def _walk(path: Path) -> Iterator[Topic | Message]:
    """Yield topics and messages in the order of the file, up to its end or the first invalid record."""
    magic, size = _magic(path), path.stat().st_size
    with contextlib.suppress(*BROKEN), path.open("rb") as file:
        if magic.startswith(MAGIC_BAG):
            file.readline()
            yield from _walk_bag(file, size, {})
        elif magic.startswith(MAGIC_MCAP):
            file.seek(len(MAGIC_MCAP))
            yield from _walk_mcap(file, size, {}, {})
        else:
            yield from _walk_db3(path)


def _walk_bag(
    file: BinaryIO, most: int, known: dict[bytes, Topic], is_chunk: bool = False
) -> Iterator[Topic | Message]:
    """Walk through the records of a bag of ROS 1, or of one of its chunks.

    At most `most` bytes are read at once, because a damaged size could otherwise allocate too much memory.
    """
    while len(size := file.read(4)) == 4:
        (length,) = struct.unpack("<I", size)
        head = file.read(min(length, most))
        if length > MAX_RECORD or len(head) < length:
            return
        header = _split(head)
        (length,) = struct.unpack("<I", file.read(4))
        if length > MAX_RECORD:
            return
        data = file.read(min(length, most))
        if header.get(b"op") == b"\x05" and not is_chunk:  # a chunk, which may have been cut off
            chunk = _unpacked(data, header[b"compression"].decode())
            yield from _walk_bag(io.BytesIO(chunk), len(chunk), known, True)
        elif len(data) == length:
            yield from _bag_record(header, data, known)


def _bag_record(
    header: dict[bytes, bytes], data: bytes, known: dict[bytes, Topic]
) -> Iterator[Topic | Message]:
    """Yield the topic of a connection record, or the message of a message record."""
    if header.get(b"op") == b"\x07":
        facts = _split(data)
        known[header[b"conn"]] = Topic(header[b"topic"].decode(), facts[b"type"].decode(), -1)
        yield known[header[b"conn"]]
    if header.get(b"op") == b"\x02" and header[b"conn"] in known:
        topic = known[header[b"conn"]]
        yield Message(topic.name, topic.kind, data)


def _split(head: bytes) -> dict[bytes, bytes]:
    """Return the fields of a header, each stored as its length and name=value."""
    fields, place = {}, 0
    while place < len(head):
        (size,) = struct.unpack_from("<I", head, place)
        name, _, value = head[place + 4 : place + 4 + size].partition(b"=")
        fields[name] = value
        place += 4 + size
    return fields


def _walk_mcap(
    file: BinaryIO, most: int, known: dict[int, Topic], kinds: dict[int, str], is_chunk: bool = False
) -> Iterator[Topic | Message]:
    """Walk through the records of an mcap file, or of one of its chunks; `most` as in `_walk_bag`."""
    while len(head := file.read(9)) == 9:
        code, size = struct.unpack("<BQ", head)
        if code == 0 or size > MAX_RECORD:
            return
        data = file.read(min(size, most))
        if code == 6 and not is_chunk:  # a chunk, which may have been cut off
            compression, place = _text(data, 28)
            chunk = _unpacked(data[place + 8 :], compression)
            yield from _walk_mcap(io.BytesIO(chunk), len(chunk), known, kinds, True)
        elif len(data) == size:
            yield from _mcap_record(code, data, known, kinds)


def _mcap_record(
    code: int, data: bytes, known: dict[int, Topic], kinds: dict[int, str]
) -> Iterator[Topic | Message]:
    """Yield the topic of a channel record or the message of a message record; store schemas in `kinds`."""
    if code == 3:
        (number,) = struct.unpack_from("<H", data)
        kinds[number] = _kind(_text(data, 2)[0])
    elif code == 4:
        number, schema = struct.unpack_from("<HH", data)
        known[number] = Topic(_text(data, 4)[0], kinds.get(schema, ""), -1)
        yield known[number]
    elif code == 5:
        (number,) = struct.unpack_from("<H", data)
        if number in known:
            yield Message(known[number].name, known[number].kind, data[22:])


def _text(data: bytes, place: int) -> tuple[str, int]:
    """Return a text that follows its length, and the position after it."""
    (size,) = struct.unpack_from("<I", data, place)
    return data[place + 4 : place + 4 + size].decode(), place + 4 + size


def _walk_db3(path: Path) -> Iterator[Topic | Message]:
    """Walk through a database, row by row until one is damaged."""
    with contextlib.closing(sqlite3.connect(f"file:{path}?mode=ro&immutable=1", uri=True)) as database:
        rows = database.execute("SELECT id, name, type FROM topics").fetchall()
        known = {number: Topic(name, _kind(kind), -1) for number, name, kind in rows}
        yield from known.values()
        for number, raw in database.execute("SELECT topic_id, data FROM messages"):
            if number in known:
                yield Message(known[number].name, known[number].kind, raw)


def _unpacked(data: bytes, compression: str) -> bytes:
    """Return the part of a chunk that can be unpacked.

    Raises:
        EOFError: The chunk is damaged.
    """
    if compression in ("", "none"):
        return data
    unpack: Any
    if compression == "bz2":
        unpack = bz2.BZ2Decompressor()
    elif compression == "lz4":
        import lz4.frame

        unpack = lz4.frame.LZ4FrameDecompressor()
    else:
        from backports import zstd

        unpack = zstd.ZstdDecompressor()
    try:
        unpacked: bytes = unpack.decompress(data)
    except MemoryError:
        raise
    except Exception as error:  # the errors of the three libraries have no common base
        raise EOFError("a chunk is damaged") from error
    return unpacked
