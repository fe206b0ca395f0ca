"""Read npz and npy files with any array names, and zip files of one text file; write npz files.

Arrays are found by their names. Nothing is unpickled, and nothing is unpacked before its header has been
checked. Columns are read in parallel, in parts.
"""

import contextlib
import shutil
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from core.files import replaced
from envs.recordings.event_file import CUT, CUT_TABLE, Append, Opened, Part, Request, assemble
from envs.recordings.names import COLUMNS, column_of, microseconds, roles, usual_unit
from envs.recordings.npz_cut import cut_members
from envs.recordings.text import read_text

MAX_HEADER_BYTES = 1 << 16
NOISE = "is_noise"  # optional array with a label for each event
ROWS = 4  # columns of a table
FIRST_ROWS = 1 << 16  # rows from which the order of the columns of a table is inferred
WRITTEN = {name: np.dtype(code) for name, code in (("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "u1"))}
BROKEN = (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, ValueError)
UNREADABLE = "is no readable array file ({}); copy or save it again"
# Name of the array -> sensor size, for data sets whose files do not state it.
SIZES = {"event_data": (640, 480)}  # N-ImageNet
SECONDS = ("events_t",)  # names of times in seconds: EVIMO 2


class Array(NamedTuple):
    """An array of a file.

    Attributes:
        name: Name in the file.
        open: Function that opens its bytes, from the header on.
        shape, dtype: As declared in the header.
    """

    name: str
    open: Callable[[], IO[bytes]]
    shape: tuple[int, ...]
    dtype: np.dtype


class Column(NamedTuple):
    """Location of a column of the events.

    Attributes:
        array: Name of the array.
        field: Name of a field of a structured array, number of a column of a table, or None.
    """

    array: str
    field: str | int | None


def read_npz(request: Request) -> Opened:
    """Open an npz file, or a zip file of one text file as in E2VID.

    Arrays are t, x, y and p, by these or other common names, or one array of rows, structured or of four
    columns; and optionally width, height, time_unit. Whole times are microseconds unless the file or the
    caller states another unit; fractional times need a unit.

    Raises:
        ValueError: There are no such arrays, or one is pickled, differs in length, or has not the number of
            bytes that it declares.
    """
    members, is_cut = _members(request)
    texts = [name for name in members if name.lower().endswith((".txt", ".csv"))]
    if not any(name.endswith(".npy") for name in members) and len(texts) == 1:
        opened = read_text(request, members[texts[0]])
    else:
        with request.refusing(BROKEN, UNREADABLE):
            try:
                arrays = {
                    name.removesuffix(".npy"): _header(request, name.removesuffix(".npy"), open_bytes)
                    for name, open_bytes in members.items()
                    if name.endswith(".npy")
                }
                opened = _opened(request, "npz", arrays)
            except BROKEN as error:
                if not (is_cut and str(error).startswith(str(request.path))):
                    raise
                raise request.refusal(
                    f"was cut off before the end of its columns ({', '.join(members)}); copy it again"
                ) from None
    request.tally.damage.update({CUT_TABLE: 1} if is_cut else {})
    return opened


def read_npy(request: Request) -> Opened:
    """Open an npy file of rows: a structured array, or a table of four columns.

    Raises:
        ValueError: As in `read_npz`.
    """
    with request.refusing(BROKEN, UNREADABLE):
        array = _header(request, "rows", lambda: request.path.open("rb"))
        return _opened(request, "npy", {"rows": array})


def _members(request: Request) -> tuple[dict[str, Callable[[], IO[bytes]]], bool]:
    """Return functions that open the members of a zip file, and whether the file is truncated."""
    with request.refusing(BROKEN, UNREADABLE):
        try:
            archive = zipfile.ZipFile(request.path)
            return {name: partial(archive.open, name) for name in archive.namelist()}, False
        except BROKEN:
            found = cut_members(request.path)
            if not found:
                raise
            return found, True


def _header(request: Request, name: str, open_bytes: Callable[[], IO[bytes]]) -> Array:
    """Return the description of an array from its header."""
    with open_bytes() as file:
        shape, dtype = _shape(request, file, name)
    return Array(name, open_bytes, shape, dtype)


def _shape(request: Request, file: IO[bytes], name: str) -> tuple[tuple[int, ...], np.dtype]:
    """Read shape and dtype of an array; leave the file at the first value."""
    try:
        version = np.lib.format.read_magic(file)
        read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[
            version
        ]
        shape, is_fortran, dtype = read(file, max_header_size=MAX_HEADER_BYTES)
    except Exception as error:  # numpy's header parser may raise any type
        raise request.refusal(
            f"array {name} has no sound header ({type(error).__name__}); save it again"
        ) from None
    if min(shape, default=0) < 0 or (is_fortran and len(shape) > 1):
        raise request.refusal(f"array {name} has shape {shape} by columns; save np.ascontiguousarray of it")
    return shape, dtype


def _opened(request: Request, format: str, arrays: dict[str, Array]) -> Opened:
    """Find the columns of the events, the sensor's size and the unit of time."""
    columns = _columns(request, arrays)
    if NOISE in arrays:
        columns.append(Column(NOISE, None))
    used = [arrays[name] for name in dict.fromkeys(column.array for column in columns)]
    lengths = {array.name: array.shape[0] if array.shape else 0 for array in used}
    if len(set(lengths.values())) > 1:
        raise request.refusal(
            f"has arrays of different lengths ({lengths}); save one entry per event in each"
        )
    count = request.check_declared(next(iter(lengths.values())))
    request = _sized(request, arrays, used)
    name = columns[0].field if isinstance(columns[0].field, str) else columns[0].array
    unit = roles(request, [name])[1]
    if "time_unit" in arrays:
        unit = str(_one(request, arrays, "time_unit")) or unit
    if "timestamp_scale_ms" in arrays:
        unit = {1e3: "s", 1.0: "ms", 1e-3: "us", 1e-6: "ns"}.get(
            float(_one(request, arrays, "timestamp_scale_ms"))
        )
    if columns[0].array in SECONDS and not request.time_unit:
        unit = "s"
    return Opened(format, request, _parts(request, used, columns, unit, count))


def _columns(request: Request, arrays: dict[str, Array]) -> list[Column]:
    """Return the locations of t, x, y and p."""
    found = {name: array for name, array in arrays.items() if array.shape and array.dtype.kind in "iufbV"}
    if request.group is not None:
        if request.group not in found:
            raise request.refusal(f"has no array {request.group!r}; {_listing(arrays)}: give group as one")
        found = {request.group: found[request.group]}
    rows = [name for name, array in found.items() if _is_rows(array)]
    by_name = {}
    if request.columns and set(request.columns) <= found.keys() and len(request.columns) == ROWS:
        by_name = dict(zip(COLUMNS, request.columns, strict=True))
    elif request.columns is None:
        one = {name.removeprefix("events_"): name for name in found if len(found[name].shape) == 1}
        by_name = {name: list(one.values())[place] for name, place in roles(request, one)[0].items()}
        if "events_xy" in found and {"t", "p"} <= by_name.keys():  # EVIMO 2
            xy = [Column("events_xy", 0), Column("events_xy", 1)]
            return [Column(by_name["t"], None), *xy, Column(by_name["p"], None)]
    if set(COLUMNS) <= by_name.keys():
        return [Column(by_name[name], None) for name in COLUMNS]
    if len(rows) != 1:
        _refuse_objects(request, arrays)
        missing = next((name for name in COLUMNS if name not in by_name), "t")
        raise request.refusal(
            f"has no array {missing!r}; {_listing(arrays)}: give columns= with the names of the arrays of "
            "t, x, y and p, or group= with the name of one array of rows"
        )
    return _row_columns(request, found[rows[0]])


def _refuse_objects(request: Request, arrays: dict[str, Array]) -> None:
    """Raise ValueError for an array that has the name of a column but contains no numbers."""
    for place in roles(request, arrays)[0].values() if request.group is None else ():
        array = list(arrays.values())[place]
        if array.dtype.kind not in "iufb":
            raise _no_numbers(request, array)


def _no_numbers(request: Request, array: Array) -> ValueError:
    """Return the error for an array that does not contain numbers."""
    return request.refusal(
        f"array {array.name} has dtype {array.dtype} and shape {array.shape}; save numbers"
    )


def _is_rows(array: Array) -> bool:
    """Whether an array has a row for each event."""
    return bool(array.dtype.names) or (len(array.shape) == 2 and array.shape[1] >= ROWS)


def _row_columns(request: Request, array: Array) -> list[Column]:
    """Return the locations of t, x, y and p in an array of rows."""
    if array.dtype.names:
        names = list(array.dtype.names)
        places, _ = roles(request, names)
        if request.columns and set(request.columns) <= set(names):
            return [Column(array.name, name) for name in request.columns]
        if not set(COLUMNS) <= places.keys():
            raise request.refusal(
                f"array {array.name} has the fields {names}; give columns= with those of t, x, y, p"
            )
        return [Column(array.name, names[places[name]]) for name in COLUMNS]
    words = request.columns or table_order(request, array.name, _first_rows(request, array))
    places, _ = roles(request, words)
    if not set(COLUMNS) <= places.keys() or len(words) > array.shape[1]:
        raise request.refusal(
            f"columns={tuple(words)} must name t, x, y and p among the columns of {array.name}"
        )
    return [Column(array.name, places[name]) for name in COLUMNS]


def table_order(request: Request, name: str, rows: np.ndarray) -> tuple[str, ...]:
    """Infer the order of the columns of a table from its numbers.

    The last column must be the polarity. The time is the first or third column, whichever never decreases;
    if both never decrease, the one with the larger range.

    Args:
        request: The file.
        name: Name of the table in the file.
        rows: Its first rows, (N, 4).

    Raises:
        ValueError: The numbers do not fit either order.
    """
    if rows.shape[1] == ROWS and len(rows):
        signs = rows[:, 3].astype(np.float64)
        signs = np.where(signs > 1 << 31, -1.0, signs)
        others = [rows[:, place].astype(np.float64) for place in (0, 2)]
        rises = [bool((np.diff(values) >= 0).all()) for values in others]
        if rises == [True, True]:  # a coordinate may also increase, but only up to the size of a sensor
            is_first = bool(np.ptp(others[0]) >= np.ptp(others[1]))
            rises = [is_first, not is_first]
        if np.isin(signs, (-1, 0, 1)).all() and any(rises):
            return ("t", "x", "y", "p") if rises[0] else ("x", "y", "t", "p")
    raise request.refusal(
        f"the table {name} does not name its columns; give columns= in their order, such as "
        "('x', 'y', 't', 'p')"
    )


def _first_rows(request: Request, array: Array) -> np.ndarray:
    """Return the first rows of a table."""
    with array.open() as file:
        _shape(request, file, array.name)
        return _next(request, file, array, min(FIRST_ROWS, array.shape[0]))


def _parts(
    request: Request, used: list[Array], columns: list[Column], unit: str | None, count: int
) -> Iterator[Part]:
    """Yield the events; the arrays are read in parallel."""
    with request.refusing(BROKEN, UNREADABLE), contextlib.ExitStack() as stack:
        files = [stack.enter_context(array.open()) for array in used]
        for file, array in zip(files, used, strict=True):
            _shape(request, file, array.name)
        for first in range(0, count, request.part_events):
            size = min(request.part_events, count - first)
            some = _side_by_side(request, files, used, size)
            t, x, y, p, *labels = (column_of(request, some[array], field) for array, field in columns)
            t_us = microseconds(request, t, unit, usual_unit(t))
            yield assemble(request, t_us, x, y, p, *labels)
        for file, array in zip(files, used, strict=True):
            if file.read(1):
                raise request.refusal(f"array {array.name} contains more than it declares; save it again")


def _side_by_side(
    request: Request, files: list[IO[bytes]], used: list[Array], size: int
) -> dict[str, np.ndarray]:
    """Return the next rows of all arrays by their names, cut to the shortest array."""
    read = [_next(request, file, array, size) for file, array in zip(files, used, strict=True)]
    whole = min(map(len, read))
    if whole < size:
        request.tally.damage[CUT] += sum((size - whole) * values.itemsize for values in read)
    return {array.name: values[:whole] for array, values in zip(used, read, strict=True)}


def _next(request: Request, file: IO[bytes], array: Array, size: int) -> np.ndarray:
    """Read the next rows of an array; fewer if the file ends."""
    row = int(np.prod(array.shape[1:], dtype=np.int64))
    row_bytes = row * array.dtype.itemsize
    if array.dtype.hasobject or array.dtype.itemsize > 64 * 8 or row > 64 or row_bytes == 0:
        raise _no_numbers(request, array)
    raw = file.read(size * row_bytes)
    got = len(raw) // row_bytes
    values = np.frombuffer(raw, array.dtype, got * row)
    return values.reshape(got, *array.shape[1:])


def _sized(request: Request, arrays: dict[str, Array], used: list[Array]) -> Request:
    """Return the request with the sensor's size from the file, or else the size of its data set."""
    size = [int(_one(request, arrays, name)) if name in arrays else None for name in ("width", "height")]
    usual = SIZES.get(used[0].name)
    if usual and size == [None, None] and (request.width, request.height) == (None, None):
        return request.sized(*usual)
    return request.sized(*size)


def _one(request: Request, arrays: dict[str, Array], name: str) -> np.ndarray:
    """Return the single number or text in an array."""
    array = arrays[name]
    if (
        int(np.prod(array.shape, dtype=object)) != 1
        or array.dtype.kind not in "iufU"
        or array.dtype.itemsize > 64
    ):
        raise request.refusal(
            f"array {name} has dtype {array.dtype} and shape {array.shape}, not one number; save it again"
        )
    with array.open() as file:
        _shape(request, file, name)
        raw = file.read(array.dtype.itemsize)
    if len(raw) != array.dtype.itemsize:
        raise request.refusal(
            f"array {name} declares {array.dtype.itemsize} bytes and contains {len(raw)}; save it again"
        )
    return np.frombuffer(raw, array.dtype)[0]


def _listing(arrays: dict[str, Array]) -> str:
    """Describe the arrays of a file in words."""
    shown = [f"{array.name} {array.dtype} {array.shape}" for array in list(arrays.values())[:12]]
    return f"it contains {', '.join(shown) or 'no arrays'}"


@contextlib.contextmanager
def npz_writer(path: Path, width: int, height: int, is_labelled: bool) -> Iterator[Append]:
    """Yield a function that adds events to an npz file, compressed: t (int64 us), x, y (uint16), p (0, 1).

    A zip file stores one column after the other, so the columns are first written to temporary files in the
    same folder. The file also contains the sensor's size and the unit of the times, the latter in the forms
    of both EventCV and this project.
    """
    types: dict[str, np.dtype] = WRITTEN | ({NOISE: np.dtype(bool)} if is_labelled else {})
    count = 0
    with replaced(path) as part, contextlib.ExitStack() as stack:
        files = {name: stack.enter_context(tempfile.TemporaryFile(dir=path.parent)) for name in types}

        def append(events: np.ndarray, is_noise: np.ndarray | None) -> None:
            nonlocal count
            count += len(events)
            columns: dict[str, Any] = {name: events[name] for name in COLUMNS} | {
                "p": events["p"] > 0,
                NOISE: is_noise,
            }
            for name, dtype in types.items():
                files[name].write(np.ascontiguousarray(columns[name], dtype).tobytes())

        yield append
        facts = {"width": np.array([width], "<u8"), "height": np.array([height], "<u8")}
        facts |= {"timestamp_scale_ms": np.array([1e-3]), "time_unit": np.array("us")}
        with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, dtype in types.items():
                header = {"descr": dtype.str, "fortran_order": False, "shape": (count,)}
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array_header_1_0(member, header)
                    files[name].seek(0)
                    shutil.copyfileobj(files[name], member, 1 << 20)
            for name, value in facts.items():
                with archive.open(f"{name}.npy", "w") as member:
                    np.lib.format.write_array(member, value)
