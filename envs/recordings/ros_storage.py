"""Read the messages of ROS bags: ROS 1, and rosbag2 in db3 or mcap; also of bags that were cut off.

Whole bags are read with the library rosbags (the extra `ros`). It reads no bag without its index, as a
crashed recorder leaves it; such a bag is walked record by record (`ros_salvage`).
"""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from envs.recordings import ros_salvage
from envs.recordings.event_file import Request
from envs.recordings.ros_salvage import Message, Topic

MAGIC_BAG, MAGIC_DB3, MAGIC_MCAP = b"#ROSBAG V2.0", b"SQLite format 3\0", b"\x89MCAP0\r\n"
STORAGE = (".db3", ".mcap")


class Bag(NamedTuple):
    """A bag that is ready to be read.

    Attributes:
        path: A file, or the folder of a whole rosbag2.
        topics: Its topics.
        is_whole: Whether it has its index.
        is_ros1: Whether messages are serialized as by ROS 1.
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
    """Return the bag of a path: one, or the files of a folder without its metadata.

    Raises:
        ValueError: The library rosbags is missing, or there is no file in the folder.
    """
    path = request.path
    _library(request)
    try:
        return [_whole(path)]
    except Exception:  # the library's errors have no common base, and salvage judges again
        files = [path] if path.is_file() else sorted(one for one in path.iterdir() if one.suffix in STORAGE)
    if not files:
        raise request.refusal(
            "is a folder without .db3 or .mcap files; give the folder or a file of a rosbag2"
        ) from None
    if path.is_file() and not _magic(path).startswith((MAGIC_BAG, MAGIC_DB3, MAGIC_MCAP)):
        raise request.refusal("is no ROS bag; give its format, or leave format out") from None
    return [_whole_or_cut(one) for one in files]


def _whole_or_cut(path: Path) -> Bag:
    """Return one file as a bag, whole if it has its index."""
    try:
        return _whole(path)
    except Exception:  # as above
        return Bag(path, ros_salvage.topics(path), False, _is_ros1(path))


def messages(bag: Bag, topics: set[str]) -> Iterator[Message]:
    """Yield the messages of some topics, in the order of their recording."""
    if not bag.is_whole:
        yield from ros_salvage.messages(bag.path, topics)
        return
    with _reader(bag.path) as reader:
        chosen = [one for one in reader.connections if one.topic in topics]
        if chosen:
            for connection, _, raw in reader.messages(chosen):
                yield Message(connection.topic, _kind(connection.msgtype), bytes(raw))


def _whole(path: Path) -> Bag:
    """Return a bag as the library opens it."""
    with _reader(path) as reader:
        counts = Counter[tuple[str, str]]()
        for one in reader.connections:
            counts[one.topic, _kind(one.msgtype)] += one.msgcount
    topics = [Topic(name, kind, count) for (name, kind), count in counts.items()]
    return Bag(path, topics, True, _is_ros1(path))


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
    """Return a type of messages as ROS 1 and 2 both have it: package/Name."""
    return name.replace("/msg/", "/")


def _library(request: Request) -> None:
    """Refuse a bag if the library is not installed."""
    try:
        import rosbags  # noqa: F401
    except ImportError:
        raise request.refusal("is a ROS bag, which needs the library rosbags; pip install rosbags") from None
