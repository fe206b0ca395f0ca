"""ROS bags for tests, written by the library rosbags."""

from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

DEFINITIONS = {
    "Event": "uint16 x\nuint16 y\ntime ts\nbool polarity",
    "EventArray": "Header header\nuint32 height\nuint32 width\nEvent[] events",
}
PACKET = (
    "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\nstring encoding\n"
    "bool is_bigendian\nuint8[] events"
)
BASE_US = 1_461_581_614_000_000


def store_of(package: str, is_ros1: bool) -> Any:
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    for name, text in DEFINITIONS.items():
        text = text if is_ros1 else text.replace("time ts", "builtin_interfaces/Time ts")
        text = text if is_ros1 else text.replace("Header header", "std_msgs/Header header")
        store.register(get_types_from_msg(text, f"{package}/msg/{name}"))
    store.register(get_types_from_msg(PACKET, "event_camera_msgs/msg/EventPacket"))
    return store


def header(store, us: int, is_ros1: bool) -> Any:
    time = store.types["builtin_interfaces/msg/Time"](sec=us // 1_000_000, nanosec=us % 1_000_000 * 1000)
    number = {"seq": 0} if is_ros1 else {}
    return store.types["std_msgs/msg/Header"](stamp=time, frame_id="dvs", **number)


def array_message(store, package: str, events: np.ndarray, is_ros1: bool) -> Any:
    time, event = store.types["builtin_interfaces/msg/Time"], store.types[f"{package}/msg/Event"]
    rows = [
        event(x=x, y=y, ts=time(sec=t // 1_000_000, nanosec=t % 1_000_000 * 1000), polarity=p > 0)
        for t, x, y, p in events.tolist()
    ]
    kind = store.types[f"{package}/msg/EventArray"]
    first = int(events["t"][0]) if len(events) else BASE_US
    return kind(header=header(store, first, is_ros1), height=180, width=240, events=rows)


def write_bag(
    path: Path, topics: dict[str, tuple[str, list]], store, is_ros1: bool, plugin: Any = None
) -> Path:
    """A bag with messages of some topics."""
    bag = (
        Writer1(path) if is_ros1 else Writer2(path, version=9, storage_plugin=plugin or StoragePlugin.SQLITE3)
    )
    with bag:
        for topic, (kind, messages) in topics.items():
            link = bag.add_connection(topic, kind, typestore=store)
            for number, message in enumerate(messages):
                raw = store.serialize_ros1(message, kind) if is_ros1 else store.serialize_cdr(message, kind)
                bag.write(link, (BASE_US + 1000 * number) * 1000, raw)
    return path


def davis(events: np.ndarray, package: str, is_ros1: bool, size: int = 100) -> Any:
    store = store_of(package, is_ros1)
    parts = [events[first : first + size] for first in range(0, len(events), size)]
    return store, (
        f"{package}/msg/EventArray",
        [array_message(store, package, part, is_ros1) for part in parts],
    )
