"""Read events from ROS bags: dvs_msgs, prophesee_event_msgs and event_camera_msgs.

Messages are decoded directly from bytes: an object for each event would take a hundred times as long.
"""

import struct
from collections.abc import Iterator

import numpy as np

from envs.recordings.event_file import CUT, CUT_PACKETS, Opened, Part, Request
from envs.recordings.event_packets import EventArray, EventPacket, PacketDecoder
from envs.recordings.ros_storage import Bag, Message, Topic, messages, open_bags

# Types of messages with arrays of events, and with packed bytes.
ARRAYS = ("dvs_msgs/EventArray", "prophesee_event_msgs/EventArray")
PACKETS = ("event_camera_msgs/EventPacket", "event_array_msgs/EventArray")
MIN_BYTES = 2  # approximate size of an event
# An event of ROS 1: x, y, seconds, nanoseconds, polarity, without gaps.
EVENT_1 = np.dtype([("x", "<u2"), ("y", "<u2"), ("s", "<u4"), ("ns", "<u4"), ("p", "u1")])
EVENT_2_BYTES = 16  # from one event of CDR to the next


class Values:
    """Read the numbers and texts of a message one after the other.

    A struct.error or ValueError means that the message ends too early.
    """

    def __init__(self, raw: bytes, is_ros1: bool) -> None:
        """Start at the first value; a CDR message has four bytes before it that state the byte order."""
        self.raw, self.is_ros1, self.place = raw, is_ros1, 0 if is_ros1 else 4
        self._order = "<" if is_ros1 or raw[1:2] in (b"\1", b"\3") else ">"

    def real(self, code: str) -> float:
        """Return the next number by its code for `struct`; CDR aligns numbers, ROS 1 does not."""
        size = struct.calcsize("<" + code)
        if not self.is_ros1:
            self.place += (4 - self.place) % size
        value: float = struct.unpack_from(self._order + code, self.raw, self.place)[0]
        self.place += size
        return value

    def number(self, code: str) -> int:
        """Return the next whole number by its code for `struct`."""
        return int(self.real(code))

    def text(self) -> str:
        """Return the next text."""
        return self.bytes().rstrip(b"\0").decode("utf-8", "replace")

    def bytes(self) -> bytes:
        """Return the next list of bytes."""
        size = self.number("I")
        if size > len(self.raw) - self.place:
            raise ValueError(f"a list of {size} bytes is not whole")
        self.place += size
        return self.raw[self.place - size : self.place]

    def header(self) -> int:
        """Read a header (ROS 1: a number; a time; the name of a frame) and return its time [us]."""
        if self.is_ros1:
            self.number("I")
        seconds, nanoseconds = self.number("I"), self.number("I")
        self.text()
        return seconds * 1_000_000 + (nanoseconds + 500) // 1000


def read_ros(request: Request) -> Opened:
    """Open a ROS 1 bag, or a rosbag2 as a folder or a .db3 or .mcap file.

    Events come from the topic that `topic` names, else from the topic of events with most messages.

    Raises:
        ValueError: The library rosbags is missing, or there is no such topic; the message lists all topics.
    """
    bags = open_bags(request)
    topics = list(dict.fromkeys(topic for bag in bags for topic in bag.topics))
    for bag in bags:
        if not bag.is_whole:
            request.tally.damage[CUT_PACKETS] += 1
    if not topics and not all(bag.is_whole for bag in bags):  # cut off before its first record
        request.tally.damage[CUT] += sum(bag.path.stat().st_size for bag in bags)
        return Opened("ros", request, iter(()))
    topic = _chosen(request, topics)
    for _, first in _decoded(bags, topic):
        if first is not None:
            request = request.sized(first.width, first.height)
            break
    return Opened("ros", request, _parts(request, bags, topic))


def _chosen(request: Request, topics: list[Topic]) -> Topic:
    """Return the topic to read."""
    found = [topic for topic in topics if topic.kind in (*ARRAYS, *PACKETS)]
    if request.topic is not None:
        found = [topic for topic in found if topic.name == request.topic]
    if not found:
        listing = ", ".join(f"{topic.name} ({topic.kind})" for topic in topics)
        wanted = "" if request.topic is None else f" {request.topic!r}"
        raise request.refusal(
            f"has no topic{wanted} of events ({', '.join((*ARRAYS, *PACKETS))}); its topics are {listing}: "
            "give topic as one of events, or another bag"
        )
    found = sorted(found, key=lambda topic: -topic.number)
    if len(found) > 1:
        names = ", ".join(topic.name for topic in found)
        request.tally.notes.append(f"topic {found[0].name} is read of {names}; topic= chooses")
    return found[0]


def _parts(request: Request, bags: list[Bag], topic: Topic) -> Iterator[Part]:
    """Yield the events of a topic."""
    packets, size = PacketDecoder(request), 0
    for message, decoded in _decoded(bags, topic):
        if decoded is not None:
            packets.add(decoded)
        else:
            request.tally.damage[CUT_PACKETS] += 1
        size += len(message.raw) // MIN_BYTES
        if size >= request.part_events:
            yield packets.taken()
            size = 0
    yield packets.taken()


def _decoded(bags: list[Bag], topic: Topic) -> Iterator[tuple[Message, EventArray | EventPacket | None]]:
    """Yield the messages of a topic, each with its decoded contents, or None if it is damaged."""
    for bag in bags:
        for message in messages(bag, {topic.name}):
            values = Values(message.raw, bag.is_ros1)
            try:
                decoded = event_array(values) if message.kind in ARRAYS else event_packet(values)
            except (struct.error, ValueError):
                yield message, None
            else:
                yield message, decoded


def event_array(values: Values) -> EventArray:
    """Decode a message that is an array of events."""
    values.header()
    height, width, count = values.number("I"), values.number("I"), values.number("I")
    if values.is_ros1:
        rows = np.frombuffer(values.raw, EVENT_1, count, values.place)
    else:
        rows = _rows_2(values, count)
    seconds, nanoseconds, *others = (rows[name].astype(np.int64) for name in ("s", "ns", "x", "y", "p"))
    t_us = seconds * 1_000_000 + (nanoseconds + 500) // 1000
    return EventArray(width, height, np.stack((t_us, *others)))


def event_packet(values: Values) -> EventPacket:
    """Decode a message that is a packet of bytes."""
    values.header()
    height, width = values.number("I"), values.number("I")
    values.number("Q")  # number of the packet
    base, encoding, is_big = values.number("Q"), values.text(), values.number("B")
    if is_big:
        raise ValueError("big-endian packets are not read")
    return EventPacket(width, height, base, encoding, values.bytes())


def _rows_2(values: Values, count: int) -> np.ndarray:
    """Return the events of a CDR message as rows with the fields of `EVENT_1`.

    Because of CDR's alignment, x and y of the first event lie two bytes earlier than in all others.
    """
    if not count:
        return np.empty(0, EVENT_1)
    size = EVENT_2_BYTES * count - 3
    if size > len(values.raw) - values.place:
        raise ValueError(f"a list of {count} events is not whole")
    body = np.frombuffer(values.raw, np.uint8, size, values.place)
    padded = np.zeros(EVENT_2_BYTES * (count + 1), np.uint8)
    padded[2 : 2 + size] = body
    padded[:4] = body[:4]  # x and y of the first
    late = np.dtype({"names": ["x", "y", "s", "ns", "p"], "formats": ["<u2", "<u2", "<u4", "<u4", "u1"],
                     "offsets": [0, 2, 6, 10, 14], "itemsize": EVENT_2_BYTES})  # fmt: skip
    return np.frombuffer(padded.tobytes(), late, count)
