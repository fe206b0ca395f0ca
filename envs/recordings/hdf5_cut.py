"""Open HDF5 files that were cut off, as by a full disk or a copy that stopped.

HDF5 refuses a file that is shorter than its first block declares. Here such a file has the declared length,
and what is missing cannot be read, so that the rows before the first missing chunk are whole.
"""

import io
import struct
from collections.abc import Callable
from pathlib import Path

import h5py

from envs.recordings.event_file import CUT_PACKETS, Request

MAGIC = b"\x89HDF\r\n\x1a\n"
END_AT = {0: 40, 1: 44, 2: 28, 3: 28}  # byte of the declared length, by the version of the first block
SIZE_AT = {0: 13, 1: 13, 2: 9, 3: 9}  # byte of the number of bytes of an address, which is 8
HEAD_BYTES, ADDRESS_BYTES = 64, 8
ERRORS = (OSError, RuntimeError)  # of reading what is missing


class CutFile(io.RawIOBase):
    """A file with its declared length; reading beyond its end is an error."""

    def __init__(self, path: Path, length: int) -> None:
        """Open the file for reading."""
        self._path, self._file, self._length = path, path.open("rb", buffering=0), length
        self._end, self._place = path.stat().st_size, 0

    def __repr__(self) -> str:
        """Return the path, which HDF5 takes for the file's name."""
        return str(self._path)

    def seek(self, offset: int, whence: int = 0) -> int:
        """Move to a byte."""
        self._place = offset + {0: 0, 1: self._place, 2: self._length}[whence]
        return self._place

    def tell(self) -> int:
        """Return the byte that is next."""
        return self._place

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        """Read bytes that are there."""
        if self._place + len(buffer) > self._end:
            raise OSError(f"the file was cut off at byte {self._end}")
        self._file.seek(self._place)
        count = self._file.readinto(buffer) or 0
        self._place += count
        return count

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()


def open_hdf5(path: Path) -> h5py.File:
    """Open a file for reading, also if it was cut off."""
    length = declared_length(path)
    if length <= path.stat().st_size:
        return h5py.File(path, "r")
    return h5py.File(CutFile(path, length), "r")


def is_cut(file: h5py.File) -> bool:
    """Whether an open file was cut off."""
    return bool(file.driver == "fileobj")


def declared_length(path: Path) -> int:
    """Return the length that the first block of a file declares [bytes]; 0 if it is of an unknown kind."""
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    version = head[len(MAGIC)] if len(head) == HEAD_BYTES and head.startswith(MAGIC) else -1
    if version not in END_AT or head[SIZE_AT[version]] != ADDRESS_BYTES:
        return 0
    length: int = struct.unpack_from("<Q", head, END_AT[version])[0]
    return length if length < 1 << 63 else 0


def until_cut(request: Request, rows: slice, *reads: Callable[[slice], object]) -> slice:
    """Return the rows of a file that was cut off, up to the first that is missing, which is counted.

    Args:
        request: The file, in whose tally it is counted.
        rows: Rows to be read.
        reads: Each reads some rows of a data set.
    """

    def are_whole(some: slice) -> bool:
        try:
            return all(read(some) is not None for read in reads)
        except ERRORS:
            return False

    if are_whole(rows):
        return rows
    request.tally.damage[CUT_PACKETS] += 1
    first, stop = rows.start, rows.stop
    while stop > first:
        middle = (first + stop + 1) // 2
        if are_whole(slice(first, middle)):
            first = middle
        else:
            stop = middle - 1
    return slice(rows.start, first)
