"""Find the members of a truncated zip file, which has lost its table of members.

A header precedes each member, which suffices to read the member up to the end of the file.
"""

import io
import struct
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import IO

HEADER = struct.Struct("<4s5H3I2H")
MAGIC = b"PK\x03\x04"
STORED, DEFLATED = 0, 8
LARGE = 0xFFFFFFFF  # this size means that the extra field contains the size
LARGE_FIELD = 1
MAX_MEMBERS = 1000
CHUNK_BYTES = 1 << 16


def cut_members(path: Path) -> dict[str, Callable[[], IO[bytes]]]:
    """Return functions that open the members of a zip file, by their names, in their order."""
    found: dict[str, Callable[[], IO[bytes]]] = {}
    end, place = path.stat().st_size, 0
    with path.open("rb") as file:
        while len(found) < MAX_MEMBERS:
            file.seek(place)
            head = file.read(HEADER.size)
            if len(head) < HEADER.size or not head.startswith(MAGIC):
                return found
            _, _, _, method, *_, packed, unpacked, name_bytes, extra_bytes = HEADER.unpack(head)
            name, extra = file.read(name_bytes), file.read(extra_bytes)
            start = place + HEADER.size + name_bytes + extra_bytes
            size = _packed_size(extra, packed, unpacked) or end - start  # 0: never finished
            if method in (STORED, DEFLATED) and start <= end:
                found[name.decode("utf-8", "replace")] = partial(_open, path, start, size, method)
            place = start + size
    return found


def _packed_size(extra: bytes, packed: int, unpacked: int) -> int:
    """Return the packed size of a member [bytes]."""
    if packed != LARGE:
        return packed
    place = 0
    while place + 4 <= len(extra):
        kind, size = struct.unpack_from("<HH", extra, place)
        own = place + 4 + (8 if unpacked == LARGE else 0)
        if kind == LARGE_FIELD and own + 8 <= len(extra):
            return int(struct.unpack_from("<Q", extra, own)[0])
        place += 4 + size
    return 0


def _open(path: Path, start: int, size: int, method: int) -> IO[bytes]:
    """Open a member."""
    return io.BufferedReader(_Member(path, start, size, method))


class _Member(io.RawIOBase):
    """The unpacked bytes of a member, up to the end of its packed bytes or the first damage."""

    def __init__(self, path: Path, start: int, size: int, method: int) -> None:
        """Open the file at the member's first byte."""
        self._file, self._left = path.open("rb"), size
        self._file.seek(start)
        self._unpack = zlib.decompressobj(-zlib.MAX_WBITS) if method == DEFLATED else None

    def readable(self) -> bool:
        """Return True."""
        return True

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        """Read some bytes; 0 at the end."""
        data = self._next(len(buffer))
        buffer[: len(data)] = data
        return len(data)

    def _next(self, most: int) -> bytes:
        """Return up to `most` unpacked bytes; none at the end."""
        if self._unpack is None:
            return self._packed(most)
        while not self._unpack.eof:
            packed = self._unpack.unconsumed_tail or self._packed(CHUNK_BYTES)
            try:
                data = self._unpack.decompress(packed, most)
            except zlib.error:
                return b""
            if data or not packed:
                return data
        return b""

    def _packed(self, most: int) -> bytes:
        """Return the next packed bytes."""
        data = self._file.read(min(most, self._left))
        self._left -= len(data)
        return data

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()
