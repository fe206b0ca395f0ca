"""Read and write text and CSV files of events, one event per line."""

import contextlib
import io
import re
import warnings
from collections.abc import Callable, Iterable, Iterator
from itertools import chain, islice
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from core.files import replaced
from envs.recordings.event_file import CUT_LINE, Append, Opened, Part, Request, assemble, chunks
from envs.recordings.names import COLUMNS, microseconds, roles

E2VID = {"columns": "t x y p", "usual_unit": "s"}  # for files whose first line is the sensor's size
MAX_LINE_BYTES = 1000
MAX_HEADER_LINES = 1000
CHUNK_BYTES = 1 << 20
PART_LINES = 1 << 18
WORD = re.compile(r"[A-Za-z_]")
NUMBERS = re.compile(r"nan|[+-]?inf|true|false", re.IGNORECASE)
TRUTH = {"true": "1", "false": "0"}


class Table(NamedTuple):
    """Layout of the events in a text file.

    Attributes:
        facts: Values from comment lines: columns, time_unit, width, height.
        names: Names of the columns in the first line that is no comment, if there are any.
        skip: Number of lines before the first event.
        separator: Separator of columns; None: spaces.
        has_words: Whether truth values are written as words.
    """

    facts: dict[str, str]
    names: list[str]
    skip: int
    separator: str | None
    has_words: bool


def read_text(request: Request, open_bytes: Callable[[], IO[bytes]] | None = None) -> Opened:
    """Open a text or CSV file.

    Lines that start with `#` or `%` may state `columns`, `time_unit`, `width` and `height`, or name the
    columns; or the first line names the columns, the time with its unit, such as `t_us,x,y,p` or
    `timestamp[s] x y polarity`. The caller must supply anything that the file does not state. Columns are
    separated by commas, semicolons, tabs or spaces. Other columns are ignored. A first line of two numbers
    is E2VID's format: width and height, then `t x y p` in seconds.

    Args:
        request: The file.
        open_bytes: Function that opens the text; None: the file itself is the text.

    Raises:
        ValueError: Columns or unit are unknown, a line is no row of numbers or longer than
            1,000 bytes, or the text is not UTF-8.
    """
    open_bytes = open_bytes or (lambda: request.path.open("rb"))
    _check_lines(request, open_bytes)
    with _refusing(request), open_bytes() as raw:
        table = _table(io.TextIOWrapper(raw, "utf-8-sig"))
        size = [int(table.facts[name]) if name in table.facts else None for name in ("width", "height")]
    words = list(request.columns or table.names or table.facts.get("columns", "").split())
    places, told = roles(request, words)
    if "t" not in places and {"sec", "nsec"} <= places.keys():
        places["t"] = places["sec"]
        told = "us"
    missing = [name for name in COLUMNS if name not in places]
    if missing:
        raise request.refusal(
            f"does not name the column {missing[0]!r} (it names {words or 'none'}); "
            "give columns=('t', 'x', 'y', 'p') in the order of the file and time_unit"
        )
    unit = table.facts.get("time_unit", told)
    request = request.sized(*size)
    microseconds(request, np.zeros(1), unit, table.facts.get("usual_unit"))  # raises if the unit is missing
    return Opened("txt", request, _parts(request, open_bytes, table, places, unit))


def _parts(
    request: Request,
    open_bytes: Callable[[], IO[bytes]],
    table: Table,
    places: dict[str, int],
    unit: str | None,
) -> Iterator[Part]:
    """Yield the events of the lines."""
    columns = [places[name] for name in COLUMNS]
    if "nsec" in places and places["t"] == places.get("sec"):
        columns.append(places["nsec"])
    with _refusing(request), open_bytes() as raw:
        lines = io.TextIOWrapper(raw, "utf-8-sig")
        for _ in islice(lines, table.skip):
            pass
        whole = _whole_lines(request, lines, table, columns)
        for line in whole:  # the first line of each part; the others are read one by one
            part = chain([line], islice(whole, min(request.part_events, PART_LINES) - 1))
            t, x, y, p, *nanoseconds = _numbers(part, table, columns).T
            if nanoseconds:
                t_us = np.rint(t * 1e6 + nanoseconds[0] * 1e-3)
            else:
                t_us = microseconds(request, t, unit, table.facts.get("usual_unit"))
            yield assemble(request, t_us, x, y, p)


def _whole_lines(request: Request, lines: IO[str], table: Table, columns: list[int]) -> Iterator[str]:
    """Yield the complete lines of a file; count a truncated last line as damage."""
    for line in lines:
        if line.endswith("\n") or _is_whole(line, table, columns):
            yield line
        else:
            request.tally.damage[CUT_LINE] += 1


def _numbers(lines: Iterable[str], table: Table, columns: list[int]) -> np.ndarray:
    """Return the numbers of some columns of lines, float64 (N, columns)."""
    if table.has_words:
        lines = (
            re.sub("true|false", lambda word: TRUTH[word[0].lower()], line, flags=re.I) for line in lines
        )
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "loadtxt: input contained no data")
        return np.loadtxt(
            lines, np.float64, "#", table.separator, usecols=columns, ndmin=2, quotechar='"'
        ).reshape(-1, len(columns))


def _is_whole(line: str, table: Table, columns: list[int]) -> bool:
    """Whether the last line of a file, which has no newline, is a row of numbers, a comment or empty."""
    try:
        return line.lstrip().startswith(("#", "%")) or len(_numbers([line], table, columns)) == 1
    except ValueError:
        return not line.strip()


@contextlib.contextmanager
def _refusing(request: Request) -> Iterator[None]:
    """Convert errors of numpy and of the text decoder to the error for the file."""
    rows, text = "has a line that is no row of numbers ({}); repair or remove it", (UnicodeDecodeError,)
    with (
        request.refusing((ValueError,), rows),
        request.refusing(text, "is not UTF-8 text ({}); give the format"),
    ):
        yield


def _check_lines(request: Request, open_bytes: Callable[[], IO[bytes]]) -> None:
    """Raise ValueError for too many lines or a line that is too long, in constant memory."""
    lines, carried = 0, 0
    with open_bytes() as file:
        while chunk := file.read(CHUNK_BYTES):
            ends = np.flatnonzero(np.frombuffer(chunk, np.uint8) == ord("\n"))
            lines += len(ends)
            lengths = np.diff(ends, prepend=-1 - carried, append=len(chunk))
            if lengths.max() > MAX_LINE_BYTES:
                raise request.refusal(
                    f"has a line of more than {MAX_LINE_BYTES} bytes, so it is no text; give its format"
                )
            carried = int(lengths[-1]) - 1
            request.check_declared(max(0, lines - MAX_HEADER_LINES))


def _table(lines: IO[str]) -> Table:
    """Determine the layout from the first lines."""
    facts: dict[str, str] = {}
    number = -1
    for number, line in enumerate(lines):
        text = line.strip()
        if text.startswith(("#", "%")) or not text:
            facts |= _facts(text)
            continue
        separator = next((mark for mark in ";,\t" if mark in text), None)
        words = [word.strip().strip('"') for word in text.split(separator)]
        if len(words) == 2 and all(word.isdecimal() for word in words) and "width" not in facts:
            facts |= E2VID | dict(zip(("width", "height"), words, strict=True))
            continue
        is_header = any(WORD.match(word) and not NUMBERS.fullmatch(word) for word in words)
        row = next(lines, "") if is_header else text
        has_words = re.search("true|false", row, re.IGNORECASE) is not None
        return Table(facts, words if is_header else [], number + is_header, separator, has_words)
    return Table(facts, [], number + 1, None, False)


def _facts(text: str) -> dict[str, str]:
    """Parse a comment line: `name: value`, `%geometry:W,H` (Metavision), or names of columns."""
    text = text.lstrip("#% ")
    name, _, value = (part.strip() for part in text.partition(":"))
    if name == "geometry" and (size := re.fullmatch(r"(\d{1,5})[,x ]+(\d{1,5})", value)):
        return {"width": size[1], "height": size[2]}
    words = [word.lower().partition("(")[0].partition("[")[0] for word in re.split(r"[\s,;]+", text)]
    if {"x", "y"} <= set(words) and not value:
        return {"columns": " ".join(re.split(r"[\s,;]+", text))}
    if name.lower() in ("columns", "time_unit", "width", "height"):
        return {name.lower(): value.replace(",", " ").strip()}
    return {}


@contextlib.contextmanager
def text_writer(path: Path, width: int, height: int, separator: str = " ") -> Iterator[Append]:
    """Yield a function that adds lines, after comment lines with columns, unit, polarity code and sensor.

    With commas as separator the only header is a first line with the names of the columns, because
    readers of CSV do not support comments. Such a file does not contain the sensor's size.
    """
    about = f"# time_unit: us\n# polarity: -1 is OFF (darker), 1 is ON (brighter)\n# width: {width}\n"
    about += f"# height: {height}\n# columns: t x y p\n"
    with replaced(path) as part, part.open("w", encoding="ascii", newline="\n") as file:
        file.write("t_us,x,y,p\n" if separator == "," else about)

        def append(events: np.ndarray, _: np.ndarray | None) -> None:
            for some in chunks(events):
                file.writelines(separator.join(map(str, row)) + "\n" for row in some.tolist())

        yield append
