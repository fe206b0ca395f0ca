"""Read events of ROS bags: dvs_msgs, prophesee_event_msgs and event_camera_msgs.

Messages are decoded from their bytes: an object for each event would take a hundred times as long.
"""

import struct
from collections.abc import Iterator

import numpy as np

from envs.recordings.event_file import CUT, CUT_PACKETS, Opened, Part, Request, assemble
from envs.recordings.event_packets import PacketDecoder
from envs.recordings.ros_messages import EventArray, EventPacket, Values, event_array, event_packet
from envs.recordings.ros_storage import Bag, Message, Topic, messages, open_bags

# Types of messages with events, and with arrays of packed bytes.
ARRAYS = ("dvs_msgs/EventArray", "prophesee_event_msgs/EventArray")
PACKETS = ("event_camera_msgs/EventPacket", "event_array_msgs/EventArray")
MIN_BYTES = 2  # of an event, about


def read_ros(request: Request) -> Opened:
    """Open a ROS 1 bag, or a rosbag2 as a folder or a .db3 or .mcap file.

    Events come from the topic that `topic` names, else from the one topic of events with most messages.

    Raises:
        ValueError: The library rosbags is missing, or there is no such topic; the message lists them.
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
    size = _size(bags, topic.name)
    return Opened("ros", request.sized(*size), _parts(request, bags, topic))


def _chosen(request: Request, topics: list[Topic]) -> Topic:
    """Return the topic that is read."""
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


def _size(bags: list[Bag], topic: str) -> tuple[int | None, int | None]:
    """Return the sensor's width and height by the first whole message."""
    for bag in bags:
        for message in messages(bag, {topic}):
            decoded = _decoded(message, bag)
            if decoded is not None:
                return decoded.width or None, decoded.height or None
    return None, None


def _parts(request: Request, bags: list[Bag], topic: Topic) -> Iterator[Part]:
    """Yield the events of a topic."""
    packets, arrays, size = PacketDecoder(request), [], 0
    for bag in bags:
        for message in messages(bag, {topic.name}):
            decoded = _decoded(message, bag)
            if isinstance(decoded, EventPacket):
                packets.add(decoded)
            elif decoded is not None:
                arrays.append(decoded.columns)
            else:
                request.tally.damage[CUT_PACKETS] += 1
            size += len(message.raw) // MIN_BYTES
            if size >= request.part_events:
                yield _part(request, packets, arrays)
                arrays, size = [], 0
    yield _part(request, packets, arrays)


def _decoded(message: Message, bag: Bag) -> EventArray | EventPacket | None:
    """Return what a message says, or None if it is damaged."""
    try:
        values = Values(message.raw, bag.is_ros1)
        return event_array(values) if message.kind in ARRAYS else event_packet(values)
    except (struct.error, ValueError):
        return None


def _part(request: Request, packets: PacketDecoder, arrays: list[np.ndarray]) -> Part:
    """Return the events of some messages."""
    if arrays:
        t_us, x, y, p = np.concatenate(arrays, axis=1)
        return assemble(request, t_us, x, y, p)
    return packets.taken()
