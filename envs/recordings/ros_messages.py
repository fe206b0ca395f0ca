"""Decode the messages of ROS that cameras send, from the bytes of ROS 1 or of CDR (ROS 2)."""

import struct
from typing import NamedTuple

import numpy as np

# An event of ROS 1: x, y, seconds, nanoseconds, polarity, without gaps.
EVENT_1 = np.dtype([("x", "<u2"), ("y", "<u2"), ("s", "<u4"), ("ns", "<u4"), ("p", "u1")])
EVENT_2_BYTES = 16  # from one event of CDR to the next


class Values:
    """Numbers and texts of a message, one after the other.

    A struct.error or ValueError means that the message ends too early.
    """

    def __init__(self, raw: bytes, is_ros1: bool) -> None:
        """Begin with the first value; the four bytes before a message of CDR say its byte order."""
        self.raw, self.is_ros1, self.place = raw, is_ros1, 0 if is_ros1 else 4
        self._order = "<" if is_ros1 or raw[1:2] in (b"\1", b"\3") else ">"

    def real(self, code: str) -> float:
        """Return the next number by its code for `struct`; only in CDR there is a gap before it."""
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
        """Return the time [us] of a header: a number (ROS 1), a time and the name of a frame."""
        if self.is_ros1:
            self.number("I")
        seconds, nanoseconds = self.number("I"), self.number("I")
        self.text()
        return seconds * 1_000_000 + (nanoseconds + 500) // 1000


class EventArray(NamedTuple):
    """A message of dvs_msgs or prophesee_event_msgs.

    Attributes:
        width, height: Pixels of the sensor.
        columns: int64 (4, N): t [us], x, y, p in {0, 1}.
    """

    width: int
    height: int
    columns: np.ndarray


class EventPacket(NamedTuple):
    """A message of event_camera_msgs.

    Attributes:
        width, height: Pixels of the sensor.
        time_base_ns: Added to the times of the packet, by some encodings.
        encoding: Such as "evt3".
        body: The bytes of the camera.
    """

    width: int
    height: int
    time_base_ns: int
    encoding: str
    body: bytes


def event_array(values: Values) -> EventArray:
    """Return the events of a message."""
    values.header()
    height, width, count = values.number("I"), values.number("I"), values.number("I")
    rows = _rows_1(values, count) if values.is_ros1 else _rows_2(values, count)
    return EventArray(width, height, rows)


def event_packet(values: Values) -> EventPacket:
    """Return a packet of bytes."""
    values.header()
    height, width = values.number("I"), values.number("I")
    values.number("Q")  # which packet it is
    base, encoding, is_big = values.number("Q"), values.text(), values.number("B")
    if is_big:
        raise ValueError("big-endian packets are not read")
    return EventPacket(width, height, base, encoding, values.bytes())


def _rows_1(values: Values, count: int) -> np.ndarray:
    """Return the columns of events of ROS 1."""
    return _columns(np.frombuffer(values.raw, EVENT_1, count, values.place))


def _rows_2(values: Values, count: int) -> np.ndarray:
    """Return the columns of events of CDR.

    The gaps of CDR leave x and y of all events but the first two bytes further ahead.
    """
    if not count:
        return np.empty((4, 0), np.int64)
    size = EVENT_2_BYTES * count - 3
    if size > len(values.raw) - values.place:
        raise ValueError(f"a list of {count} events is not whole")
    body = np.frombuffer(values.raw, np.uint8, size, values.place)
    padded = np.zeros(EVENT_2_BYTES * (count + 1), np.uint8)
    padded[2 : 2 + size] = body
    padded[:4] = body[:4]  # x and y of the first
    late = np.dtype({"names": ["x", "y", "s", "ns", "p"], "formats": ["<u2", "<u2", "<u4", "<u4", "u1"],
                     "offsets": [0, 2, 6, 10, 14], "itemsize": EVENT_2_BYTES})  # fmt: skip
    return _columns(np.frombuffer(padded.tobytes(), late, count))


def _columns(rows: np.ndarray) -> np.ndarray:
    """Return t [us], x, y and p, int64 (4, N)."""
    seconds, nanoseconds, *others = (rows[name].astype(np.int64) for name in ("s", "ns", "x", "y", "p"))
    return np.stack((seconds * 1_000_000 + (nanoseconds + 500) // 1000, *others))
