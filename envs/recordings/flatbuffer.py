"""Read the tables of flatbuffers (google.github.io/flatbuffers, "Internals"), with every offset checked.

A struct.error or ValueError means that a buffer is damaged.
"""

import struct
from collections.abc import Iterator
from typing import NamedTuple


class Table(NamedTuple):
    """A table in a buffer.

    Attributes:
        buffer: The bytes.
        place: First byte of the table.
    """

    buffer: bytes
    place: int

    def field(self, number: int) -> int | None:
        """Return the place of a field, or None if it has its default."""
        (back,) = struct.unpack_from("<i", self.buffer, self.place)
        if not 0 <= self.place - back < len(self.buffer):
            raise ValueError("a table points outside its packet")
        (size,) = struct.unpack_from("<H", self.buffer, self.place - back)
        if 4 + 2 * number + 2 > size:
            return None
        (offset,) = struct.unpack_from("<H", self.buffer, self.place - back + 4 + 2 * number)
        return self.place + offset if offset else None

    def scalar(self, number: int, code: str, default: float) -> float:
        """Return a number by its code for `struct`."""
        place = self.field(number)
        value: float = default if place is None else struct.unpack_from("<" + code, self.buffer, place)[0]
        return value

    def vector(self, number: int, size: int) -> tuple[int, int]:
        """Return the place of the first element of a vector or text, and how many of `size` bytes there are.

        Raises:
            ValueError: The buffer has no room for them.
        """
        place = self.field(number)
        if place is None:
            return 0, 0
        (offset,) = struct.unpack_from("<I", self.buffer, place)
        (count,) = struct.unpack_from("<I", self.buffer, place + offset)
        start = place + offset + 4
        if count * size > len(self.buffer) - start:
            raise ValueError(f"a packet declares {count} entries and has no room for them")
        return start, count

    def tables(self, number: int) -> Iterator["Table"]:
        """Yield the tables of a vector of tables."""
        start, count = self.vector(number, 4)
        for place in range(start, start + 4 * count, 4):
            (offset,) = struct.unpack_from("<I", self.buffer, place)
            yield Table(self.buffer, place + offset)


def root(buffer: bytes) -> Table:
    """Return the root table of a buffer."""
    (place,) = struct.unpack_from("<I", buffer)
    return Table(buffer, place)
