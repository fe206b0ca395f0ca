"""Event files without a camera's own encoding: npz, text and CSV, and N-MNIST's 5-byte entries."""

import re
import warnings
import zipfile
import zlib
from pathlib import Path
from typing import IO

import numpy as np

from core.files import replaced
from envs.recordings.event_file import EventFile, Request, assemble, finish, unwrap

US_PER = {"s": 1_000_000.0, "ms": 1000.0, "us": 1.0, "ns": 0.001}
COLUMNS = ("t", "x", "y", "p")
ALIASES = {
    "time": "t",
    "ts": "t",
    "timestamp": "t",
    "timestamps": "t",
    "pol": "p",
    "polarity": "p",
    "on": "p",
}
E2VID = {"columns": "t x y p", "usual_unit": "s"}  # what follows a first line with the sensor's size
MAX_LINE_BYTES = 1000
MAX_HEADER_LINES = 1000
CHUNK_BYTES = 1 << 20
MAX_NPY_HEADER_BYTES = 1 << 16
NMNIST_SIZE = (34, 34)
NOISE = "is_noise"  # an array that labels each event, if there is one
OVERFLOW_ROW, OVERFLOW_US = 240, 1 << 13


def read_npz(request: Request) -> EventFile:
    """Events of an npz file with the arrays t, x, y, p and, if known, width, height, time_unit.

    Integer times are microseconds unless the file or the caller names another unit;
    fractional times need a unit.

    Raises:
        ValueError: An array is missing, pickled, not one-dimensional, of another length, or
            holds another number of bytes than it declares; or a rule of `finish`.
    """
    try:
        with zipfile.ZipFile(request.path) as archive:
            names = set(archive.namelist())
            missing = [name for name in COLUMNS if f"{name}.npy" not in names]
            if missing:
                raise request.refusal(f"has no array {missing[0]!r}; save t, x, y and p by these names")
            columns = [_array(request, archive, name, 1) for name in COLUMNS]
            is_noise = _array(request, archive, NOISE, 1) if f"{NOISE}.npy" in names else None
            width, height = (
                int(_array(request, archive, name, 0)) if f"{name}.npy" in names else None
                for name in ("width", "height")
            )
            unit = str(_array(request, archive, "time_unit", 0)) if "time_unit.npy" in names else None
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, ValueError) as error:
        if str(error).startswith(str(request.path)):
            raise
        raise request.refusal(f"is no readable npz file ({error}); copy or save it again") from None
    if len({len(column) for column in columns}) > 1:
        raise request.refusal("has arrays t, x, y, p of different lengths; save one entry per event in each")
    t, x, y, p = columns
    if t.dtype.kind != "f" and not (unit or request.time_unit):
        unit = "us"
    events = assemble(request, _microseconds(request, t, unit), x, y, p)
    return finish(request.sized(width, height), "npz", events, is_noise=is_noise)


def _array(request: Request, archive: zipfile.ZipFile, name: str, ndim: int) -> np.ndarray:
    """One array of the archive; nothing is unpacked before its header is known to be sound."""
    with archive.open(f"{name}.npy") as file:
        shape, dtype = _npy_header(request, file, name)
        is_number = dtype.kind in ("iufb" if ndim else "iuU") and dtype.itemsize <= 64
        if not is_number or len(shape) != ndim or min(shape, default=0) < 0:
            raise request.refusal(
                f"array {name} has dtype {dtype} and shape {shape}; numbers in {ndim} dimensions are read"
            )
        size = request.check_count(shape[0] if shape else 1) * dtype.itemsize
        raw = file.read(size + 1)
        if len(raw) != size:
            raise request.refusal(
                f"array {name} declares {size} bytes and holds {len(raw)} or more; save it again"
            )
    return np.frombuffer(raw, dtype).reshape(shape)


def _npy_header(request: Request, file: IO[bytes], name: str) -> tuple[tuple[int, ...], np.dtype]:
    """Shape and dtype that an array declares."""
    try:
        version = np.lib.format.read_magic(file)
        read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[
            version
        ]
        shape, _, dtype = read(file, max_header_size=MAX_NPY_HEADER_BYTES)
    except Exception as error:  # numpy's parser of headers promises no type
        raise request.refusal(
            f"array {name} has no sound header ({type(error).__name__}); save it again"
        ) from None
    return shape, dtype


def read_text(request: Request) -> EventFile:
    """Events of a text or CSV file, one line each.

    Lines that begin with `#` may say `columns`, `time_unit`, `width` and `height`, as
    `write_text` does; or the first line names the columns, the time with its unit, such as
    `t_us,x,y,p` or `timestamp[s] x y polarity`. What the file does not say the caller must.
    Columns are separated by commas or spaces. Further columns are passed over. A first line of
    two numbers is E2VID's: width and height, before `t x y p` in seconds.

    Raises:
        ValueError: Columns or unit are unknown, a line is no row of numbers or longer than
            1,000 bytes, the text is not UTF-8, or a rule of `finish`.
    """
    _check_lines(request)
    try:
        with request.path.open(encoding="utf-8-sig") as file:
            facts, words, skip, has_commas = _text_header(file)
            names = _column_names(request, facts, words)
            unit = facts.get("time_unit", names.pop("unit", None))
            if not (unit or request.time_unit):
                unit = facts.get("usual_unit")
            size = (int(facts[name]) if name in facts else None for name in ("width", "height"))
            request = request.sized(*size)
            file.seek(0)
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "loadtxt: input contained no data")
                columns = [int(names[name]) for name in COLUMNS]
                comma = "," if has_commas else None
                table = np.loadtxt(file, np.float64, delimiter=comma, skiprows=skip, usecols=columns, ndmin=2)
    except UnicodeDecodeError as error:
        raise request.refusal(
            f"is not UTF-8 text ({error.reason} at byte {error.start}); give the format"
        ) from None
    except ValueError as error:
        if str(error).startswith(str(request.path)):
            raise
        raise request.refusal(f"has a line that is no row of numbers ({error}); repair it") from None
    t, x, y, p = table.reshape(-1, 4).T
    return finish(request, "txt", assemble(request, _microseconds(request, t, unit), x, y, p))


def _check_lines(request: Request) -> None:
    """Refuse too many lines or one that is too long, in memory that does not grow."""
    lines, carried = 0, 0
    with request.path.open("rb") as file:
        while chunk := file.read(CHUNK_BYTES):
            ends = np.flatnonzero(np.frombuffer(chunk, np.uint8) == ord("\n"))
            lines += len(ends)
            lengths = np.diff(ends, prepend=-1 - carried, append=len(chunk))
            if lengths.max() > MAX_LINE_BYTES:
                raise request.refusal(
                    f"has a line of more than {MAX_LINE_BYTES} bytes; it is no text of events"
                )
            carried = int(lengths[-1]) - 1
            request.check_count(max(0, lines - MAX_HEADER_LINES))


def _text_header(file: IO[str]) -> tuple[dict[str, str], list[str], int, bool]:
    """Facts of the `#` lines, names in the first other line, lines to skip, and whether commas separate."""
    facts: dict[str, str] = {}
    number = -1
    for number, line in enumerate(file):
        text = line.strip()
        if text.startswith("#") or not text:
            name, _, value = text.lstrip("# ").partition(":")
            facts[name.strip().lower()] = value.strip()
            continue
        words = [word.strip() for word in (text.split(",") if "," in text else text.split())]
        if len(words) == 2 and all(word.isdecimal() for word in words) and "width" not in facts:
            facts |= E2VID | dict(zip(("width", "height"), words, strict=True))
            continue
        is_header = re.match(r"[A-Za-z_]", words[0]) is not None and words[0].lower() not in ("nan", "inf")
        return facts, words if is_header else [], number + is_header, "," in text
    return facts, [], number + 1, False


def _column_names(request: Request, facts: dict[str, str], names: list[str]) -> dict[str, str]:
    """Which column holds t, x, y and p; and the unit of t if its name tells it."""
    words = list(request.columns or names or facts.get("columns", "").replace(",", " ").split())
    places: dict[str, str] = {}
    for place, word in enumerate(words):
        name, unit = re.fullmatch(r"(.*?)(?:[_\[(](s|ms|us|ns)[\])]?)?", word.lower(), re.DOTALL).groups()  # type: ignore[union-attr]
        name = ALIASES.get(name, name)
        if name in COLUMNS and name in places:
            raise request.refusal(f"names the column {name} twice; rename one")
        places[name] = str(place)
        if name == "t" and unit:
            places["unit"] = unit
    missing = [name for name in COLUMNS if name not in places]
    if missing:
        raise request.refusal(
            f"does not name the column {missing[0]!r} (it names {words or 'none'}); "
            "give columns=('t', 'x', 'y', 'p') in the order of the file and time_unit"
        )
    return {name: place for name, place in places.items() if name in (*COLUMNS, "unit")}


def _microseconds(request: Request, t: np.ndarray, said: str | None) -> np.ndarray:
    """Times in microseconds from the unit that the file says, else the caller."""
    given = request.time_unit
    if said and given and said != given:
        raise request.refusal(f"says time_unit={said} and the caller says {given}; leave time_unit out")
    unit = said or given
    if unit not in US_PER:
        raise request.refusal(
            f"does not say the unit of its times; give time_unit as one of {', '.join(US_PER)}"
        )
    return t if unit == "us" else t.astype(np.float64) * US_PER[unit]


def read_nmnist(request: Request) -> EventFile:
    """Events of an N-MNIST or N-Caltech101 file: 40 bits each, x 8, y 8, p 1, t 23 (microseconds).

    Row 240 marks an overflow of the camera's own counter: it is no event, and moves what
    follows by 8,192 us, as the data set's reader has it. The 23-bit clock of 8.4 s is unwrapped.

    Raises:
        ValueError: A truncated file or a rule of `finish`.
    """
    raw = np.fromfile(request.path, np.uint8)
    if len(raw) % 5:
        raise request.refusal(
            f"is truncated: {len(raw)} bytes are no whole number of 5-byte events; copy it again"
        )
    body = raw.reshape(-1, 5)
    request.check_count(len(body))
    if request.width is None and request.height is None:
        request = request.sized(*NMNIST_SIZE)
    counter = (body[:, 2] & 127).astype(np.uint32) << 16 | body[:, 3].astype(np.uint32) << 8 | body[:, 4]
    overflows = body[:, 1] == OVERFLOW_ROW
    t_us = unwrap(counter, 23) + OVERFLOW_US * np.cumsum(overflows)
    kept = ~overflows
    events = assemble(request, t_us[kept], body[kept, 0], body[kept, 1], body[kept, 2] >> 7)
    return finish(request, "nmnist", events, int(np.count_nonzero(overflows)))


def write_npz(
    path: Path, events: np.ndarray, width: int, height: int, is_noise: np.ndarray | None = None
) -> None:
    """Write checked events as compressed arrays t (int64 us), x, y (uint16), p (int8, -1, 1), and labels."""
    with replaced(path) as part, part.open("wb") as file:
        columns = {name: np.ascontiguousarray(events[name]) for name in COLUMNS}
        columns |= {} if is_noise is None else {NOISE: is_noise}
        np.savez_compressed(file, **columns, width=width, height=height, time_unit="us")  # type: ignore[arg-type]


def write_text(path: Path, events: np.ndarray, width: int, height: int, separator: str = " ") -> None:
    """Write checked events as lines, under lines that say columns, unit, polarity code and sensor.

    Separated by commas the first line names the columns and no other is there: what opens CSV
    knows no comments. The sensor's size is not in such a file.
    """
    about = f"# time_unit: us\n# polarity: -1 is OFF (darker), 1 is ON (brighter)\n# width: {width}\n"
    about += f"# height: {height}\n# columns: t x y p\n"
    with replaced(path) as part, part.open("w", encoding="ascii", newline="\n") as file:
        file.write("t_us,x,y,p\n" if separator == "," else about)
        for first in range(0, len(events), CHUNK_BYTES):
            rows = events[first : first + CHUNK_BYTES].tolist()
            file.writelines(separator.join(map(str, row)) + "\n" for row in rows)
