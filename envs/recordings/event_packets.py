"""Decode the packets of event_camera_msgs, as described in event_camera_codecs (Apache 2.0).

The encodings of Prophesee's cameras are streams of words, so a packet depends on the packets before it.
libcaer and mono are rows of 8 bytes. libcaer_cmp is words of 16 bits, and each packet is independent.
"""

from typing import NamedTuple

import numba
import numpy as np

from envs.recordings.event_file import CUT, RESERVED, Part, Request, Tally, assemble, concatenated
from envs.recordings.prophesee import WORDS, evt_parts

ROW = np.dtype([("data", "<u4"), ("t", "<i4")])
MONO = np.dtype([("t", "<u4"), ("x", "<u2"), ("y", "<u2")])
TIME_HIGH, TIME_LOW, ADDRESS_X, ADDRESS_Y, BASE_Y, VECTOR_8 = range(6)  # types of words of libcaer_cmp


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
        time_base_ns: Offset that some encodings add to the times of the packet.
        encoding: Name of the encoding, such as "evt3".
        body: The bytes of the camera.
    """

    width: int
    height: int
    time_base_ns: int
    encoding: str
    body: bytes


class PacketDecoder:
    """Collect the messages of a topic, and decode several packets together."""

    def __init__(self, request: Request) -> None:
        self._request = request
        self._words: dict[str, list[bytes]] = {}
        self._rows: list[np.ndarray] = [np.empty((4, 0), np.int64)]
        self._states: dict[str, np.ndarray] = {}

    def add(self, packet: EventArray | EventPacket) -> None:
        """Add a packet.

        Raises:
            ValueError: Its encoding is not known.
        """
        if isinstance(packet, EventArray):
            self._rows.append(packet.columns)
        elif packet.encoding in WORDS:
            self._words.setdefault(packet.encoding, []).append(packet.body)
        elif packet.encoding in ROWS:
            self._rows.append(ROWS[packet.encoding](packet, self._request.tally))
        else:
            known = ", ".join((*WORDS, *ROWS))
            raise self._request.refusal(
                f"has packets of the encoding {packet.encoding!r}; {known} are read: record it with one"
            )

    def taken(self) -> Part:
        """Return the events and triggers of the packets since the last call."""
        found: list[Part] = []
        for encoding, bodies in self._words.items():
            dtype = WORDS[encoding]
            raw = b"".join(body[: len(body) // dtype.itemsize * dtype.itemsize] for body in bodies)
            words = np.frombuffer(raw, dtype)
            found += evt_parts(self._request, encoding, words, states=self._states)
        rows = np.concatenate(self._rows, axis=1)
        if rows.size or not found:
            found.append(assemble(self._request, *rows))
        self._words, self._rows = {}, [np.empty((4, 0), np.int64)]
        return concatenated(found)


def _libcaer(packet: EventPacket, tally: Tally) -> np.ndarray:
    """Return the columns of libcaer's polarity events, whose 31-bit clock may wrap within a packet."""
    words = _whole(packet.body, ROW, tally)
    low = words["t"].astype(np.int64)
    turns = np.cumsum(np.diff(low, prepend=low[:1]) < 0)
    t_us = packet.time_base_ns // 1000 + (turns << 31) + low
    data = words["data"].astype(np.int64)
    return np.stack((t_us, data >> 17 & 0x7FFF, data >> 2 & 0x7FFF, data >> 1 & 1))


def _mono(packet: EventPacket, tally: Tally) -> np.ndarray:
    """Return the columns of rows of time [ns], x, y and polarity."""
    rows = _whole(packet.body, MONO, tally)
    t_us = (packet.time_base_ns + rows["t"].astype(np.int64)) // 1000
    y = rows["y"].astype(np.int64)
    return np.stack((t_us, rows["x"].astype(np.int64), y & 0x7FFF, y >> 15))


def _libcaer_cmp(packet: EventPacket, tally: Tally) -> np.ndarray:
    """Return the columns of libcaer's compressed words."""
    words = _whole(packet.body, np.dtype("<u2"), tally)
    columns = np.empty((4, 8 * len(words)), np.int64)
    count, reserved = decode_libcaer_cmp(words, packet.time_base_ns // 1000, columns)
    if reserved:
        tally.damage[RESERVED] += reserved
    return columns[:, :count]


def _whole(body: bytes, dtype: np.dtype, tally: Tally) -> np.ndarray:
    """Return the complete entries of a packet; count the remaining bytes as damage."""
    rest = len(body) % dtype.itemsize
    if rest:
        tally.damage[CUT] += rest
    return np.frombuffer(body, dtype, len(body) // dtype.itemsize)


@numba.njit(cache=True, error_model="numpy")
def decode_libcaer_cmp(  # noqa: C901  a branch for each type of word
    words: np.ndarray, base_us: int, columns: np.ndarray
) -> tuple[int, int]:
    """Decode a packet of libcaer_cmp.

    Args:
        words: uint16 (N,): value 12 bits, type 4 bits.
        base_us: Time of the packet [us].
        columns: int64 (4, 8 N), filled with t [us], x, y and p.

    Returns:
        Number of events, number of words of an unknown type.
    """
    n, reserved = 0, 0
    high = low = x = y = p = np.int64(0)
    for i in range(words.size):
        kind, value = np.int64(words[i]) >> 12, np.int64(words[i]) & 0xFFF
        mask = np.int64(0)
        if kind == TIME_HIGH:
            high = value << 12
        elif kind == TIME_LOW:
            low = value
        elif kind == ADDRESS_X:
            x = value & 2047
        elif kind == ADDRESS_Y or kind == BASE_Y:  # noqa: SIM109  numba would make a tuple
            y, p = value & 2047, value >> 11
            mask = np.int64(kind == ADDRESS_Y)
        elif kind == VECTOR_8:
            mask = value & 255
        else:
            reserved += 1
        for bit in range(8):
            if mask >> bit & 1:
                columns[0, n], columns[1, n] = base_us + (high | low), x
                columns[2, n], columns[3, n] = y + bit, p
                n += 1
        y += 8 if kind == VECTOR_8 else 0
    return n, reserved


ROWS = {"libcaer": _libcaer, "libcaer_cmp": _libcaer_cmp, "mono": _mono}
