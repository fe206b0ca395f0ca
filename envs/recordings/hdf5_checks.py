"""Read HDF5 files that may be damaged, hostile or truncated; check sizes before memory is allocated.

The library crashes on some damaged files, follows links to other files, and loops for ever on a heap of texts
that contains a cycle. This module detects such files before the library reads them.

The library also rejects a file that is shorter than its first block declares, such as after a full disk or an
interrupted copy. Here such a file appears to have the declared length, and reading a missing part raises an
error, so that the rows before the first missing chunk can be read.
"""

import contextlib
import io
import math
import mmap
import struct
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin  # noqa: F401  registers the filters
import numpy as np

from envs.recordings.event_file import CUT_PACKETS, Request, check_declared

MAX_CHUNK_BYTES = 1 << 28
# Filters that event files use: deflate, shuffle, fletcher32, lzf, blosc, blosc2. Others (nbit,
# bitshuffle) crashed on damaged files, or (lz4, zstd) allocate whatever size the data declare.
FILTERS = (1, 2, 3, 32000, 32001, 32026)
BLOSC = (32001, 32026)
FLETCHER32, CHECKSUM_BYTES = 3, 4
SIMPLE = (h5py.h5t.TypeIntegerID, h5py.h5t.TypeFloatID, h5py.h5t.TypeStringID)  # allowed types of attributes
HEAP = b"GCOL\1"  # start of a heap of values of variable length, such as the texts of attributes
ERRORS = (OSError, KeyError, ValueError, RuntimeError, TypeError, OverflowError)  # errors of the library
MAGIC = b"\x89HDF\r\n\x1a\n"
END_AT = {0: 40, 1: 44, 2: 28, 3: 28}  # byte of the declared length, by the version of the first block
SIZE_AT = {0: 13, 1: 13, 2: 9, 3: 9}  # byte of the number of bytes of an address, which is 8
HEAD_BYTES, ADDRESS_BYTES = 64, 8
CUT_ERRORS = (OSError, RuntimeError)  # errors of reading a missing part
MAX_NODES, MAX_DEPTH, MAX_LISTED = 10_000, 5, 12  # limits of a listing


@contextlib.contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """Open a file, also a truncated one, after checking that its heaps contain no cycle."""
    check_heaps(path)
    length = _declared_bytes(path)
    source: AbstractContextManager[Any] = contextlib.nullcontext(path)
    if length > path.stat().st_size:
        source = CutFile(path, length)
    with source as name, h5py.File(name, "r") as file:
        yield file


class CutFile(io.FileIO):
    """A file with its declared length; reading beyond its end is an error."""

    def __init__(self, path: Path, length: int) -> None:
        """Open the file for reading."""
        super().__init__(path)
        self._path, self._length, self._end = path, length, path.stat().st_size

    def __repr__(self) -> str:
        """Return the path, which HDF5 uses as the file's name."""
        return str(self._path)

    def seek(self, offset: int, whence: int = 0) -> int:
        """Move to a byte."""
        return super().seek(self._length + offset) if whence == 2 else super().seek(offset, whence)

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        """Read bytes; raise OSError if some of them are missing."""
        if self.tell() + len(buffer) > self._end:
            raise OSError(f"the file was cut off at byte {self._end}")
        return super().readinto(buffer) or 0


def is_cut(file: h5py.File) -> bool:
    """Whether an open file is truncated."""
    return bool(file.driver == "fileobj")


def _declared_bytes(path: Path) -> int:
    """Return the length that the first block of a file declares [bytes]; 0 if its version is unknown."""
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    version = head[len(MAGIC)] if len(head) == HEAD_BYTES and head.startswith(MAGIC) else -1
    if version not in END_AT or head[SIZE_AT[version]] != ADDRESS_BYTES:
        return 0
    length: int = struct.unpack_from("<Q", head, END_AT[version])[0]
    return length if length < 1 << 63 else 0


def attribute(file: h5py.File, name: str) -> Any:
    """Return an attribute that is one number or text; any other type in a damaged file can crash HDF5."""
    stored = file.attrs.get_id(name)
    if stored.shape != () or not isinstance(stored.get_type(), SIMPLE):
        raise ValueError(f"the attribute {name} is no single number or text")
    value = file.attrs[name]
    return value.decode() if isinstance(value, bytes) else value


def two_numbers(file: h5py.File, name: str) -> list[int] | None:
    """Return an attribute that is a list of two integers; None if it is something else."""
    stored = file.attrs.get_id(name)
    if stored.shape != (2,) or not isinstance(stored.get_type(), SIMPLE[:1]):
        return None
    return [int(value) for value in file.attrs[name]]


def data_sets(file: h5py.File) -> dict[str, h5py.Dataset]:
    """Return the data sets of a file by their paths, down to `MAX_DEPTH` levels, without links."""
    found: dict[str, h5py.Dataset] = {}
    nodes = 0
    waiting: list[tuple[str, h5py.Group, int]] = [("", file, 0)]
    while waiting:
        path, group, depth = waiting.pop(0)
        for name in group:
            nodes += 1
            if nodes > MAX_NODES:
                return found
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                continue
            item = group[name]
            if isinstance(item, h5py.Dataset):
                found[f"{path}{name}"] = item
            elif isinstance(item, h5py.Group) and depth < MAX_DEPTH:
                waiting.append((f"{path}{name}/", item, depth + 1))
    return found


def listing(file: h5py.File) -> str:
    """Describe the contents of a file in words."""
    found = data_sets(file)
    shown = [f"{name} {data.dtype} {data.shape}" for name, data in list(found.items())[:MAX_LISTED]]
    more = f" and {len(found) - MAX_LISTED} more" if len(found) > MAX_LISTED else ""
    return f"it contains {', '.join(shown) or 'no data sets'}{more}"


def declared_length(file: h5py.File, name: str, most: int | None = None) -> int:
    """Return the length of a one-dimensional data set, after checking it without reading the data."""
    check_plain(file, name, 1)
    length = len(file[name])
    if most is not None and length > most:
        raise ValueError(f"{name} declares {length} entries; at most {most} are read")
    check_declared(Path(file.filename), name, length * file[name].dtype.itemsize)
    return length


def time_offset(file: h5py.File) -> int:
    """Return the time of t = 0 [us] that a file in DSEC's layout states; 0 if it states none.

    Raises:
        ValueError: It is no whole number.
    """
    if file.get("t_offset", getlink=True) is None:
        return 0
    check_plain(file, "t_offset", 0)
    offset = int(file["t_offset"][()])
    if offset != file["t_offset"][()]:
        raise ValueError("t_offset is no whole number of microseconds")
    return offset


def check_plain(file: h5py.File, name: str, ndim: int) -> None:
    """Raise ValueError for links, virtual or external data, types other than numbers, and huge chunks."""
    data = plain(file, name, ndim)
    fields = [data.dtype[field] for field in data.dtype.names] if data.dtype.names else [data.dtype]
    if not all(field.kind in "iufb" for field in fields):
        raise ValueError(f"{name} contains {data.dtype}, not numbers")
    check_chunks(data, name)


def plain(file: h5py.File, name: str, ndim: int) -> h5py.Dataset:
    """Return a data set; raise ValueError for a link, and for virtual or external data."""
    parts = name.split("/")
    for end in range(1, len(parts) + 1):
        check_own(file, "/".join(parts[:end]))
    data = file[name]
    if not isinstance(data, h5py.Dataset) or data.ndim != ndim or data.external or data.is_virtual:
        raise ValueError(f"{name} is not a plain data set of {ndim} dimensions")
    return data


def check_own(file: h5py.File, name: str) -> None:
    """Raise ValueError for a name that is a link, before following it could open another file."""
    if not isinstance(file.get(name, getlink=True), h5py.HardLink):
        raise ValueError(f"{name} is missing or a link")


def check_chunks(data: h5py.Dataset, name: str) -> None:
    """Raise ValueError for huge chunks, and for filters that are unknown or declare the wrong sizes."""
    size = math.prod(data.chunks) * data.dtype.itemsize if data.chunks else 0
    if size > MAX_CHUNK_BYTES:
        raise ValueError(f"{name} has chunks of more than {MAX_CHUNK_BYTES} bytes")
    pipeline, codes = data.id.get_create_plist(), filters(data)
    for number, code in enumerate(codes):
        if code not in FILTERS:
            raise ValueError(f"{name} is packed with the filter {code}; write it again with blosc or gzip")
        if code in BLOSC and pipeline.get_filter(number)[2][2:4] != (data.dtype.itemsize, size):
            raise ValueError(f"{name} describes its packing wrongly")
    if FLETCHER32 in codes[:-1]:  # the decompressed data may be too short for it
        raise ValueError(f"{name} has its checksum within its compression; write it again without fletcher32")
    # A truncated file may lack the list of chunks; `_read_rows` then checks each chunk.
    if FLETCHER32 in codes and not is_cut(data.file) and data.id.chunk_iter(_too_short):
        raise ValueError(f"{name} has a chunk without its checksum")


def _too_short(chunk: Any) -> bool | None:
    """Return True if a stored chunk is too short for its checksum, else None to continue the iteration."""
    return chunk.size < CHECKSUM_BYTES or None


def row_parts(request: Request, sets: Sequence[h5py.Dataset]) -> Iterator[slice]:
    """Yield the rows of data sets of equal length, part by part, up to the first missing row.

    Args:
        request: The file; its tally counts missing rows as damage.
        sets: The data sets.
    """
    for first in range(0, len(sets[0]), request.part_events):
        rows = slice(first, min(len(sets[0]), first + request.part_events))
        yield _until_cut(request, rows, sets) if is_cut(sets[0].file) else rows
        if request.tally.damage[CUT_PACKETS]:
            return


def _until_cut(request: Request, rows: slice, sets: Sequence[h5py.Dataset]) -> slice:
    """Return the rows up to the first missing one, and count that as damage."""

    def are_whole(some: slice) -> bool:
        try:
            return all(_read_rows(data, some) is not None for data in sets)
        except CUT_ERRORS:
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


def _read_rows(data: h5py.Dataset, rows: slice) -> np.ndarray:
    """Return rows of a data set of a truncated file, after checking the sizes of its chunks."""
    if FLETCHER32 in filters(data):
        columns = range(0, data.shape[1], data.chunks[1]) if data.ndim > 1 else [None]
        for first in range(rows.start // data.chunks[0] * data.chunks[0], rows.stop, data.chunks[0]):
            for column in columns:
                chunk = data.id.get_chunk_info_by_coord((first,) if column is None else (first, column))
                if 0 < chunk.size < CHECKSUM_BYTES:
                    raise ValueError(f"{data.name} has a chunk without its checksum")
    return np.asarray(data[rows])


def filters(data: h5py.Dataset) -> list[int]:
    """Return the numbers of the filters of a data set."""
    pipeline = data.id.get_create_plist()
    return [pipeline.get_filter(number)[0] for number in range(pipeline.get_nfilters())]


def check_heaps(path: Path) -> None:
    """Raise ValueError for a heap of texts in which an object follows itself: HDF5 would loop for ever."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as raw:
        heap = raw.find(HEAP)
        while heap >= 0:
            place, end = heap + 16, min(len(raw), heap + int.from_bytes(raw[heap + 8 : heap + 16], "little"))
            while place + 16 <= end:
                number, size = struct.unpack_from("<H6xQ", raw, place)
                step = 16 + -(-size // 8) * 8 if number else size  # without a number it is free space
                if step == 0 or step >= 1 << 63:
                    raise ValueError(f"the heap at byte {heap} leads in a circle")
                place += step
            heap = raw.find(HEAP, heap + 1)
