"""Recognise the columns of events by the names that programs use for them."""

import re
from collections.abc import Iterable

import numpy as np

from envs.recordings.event_file import Request

COLUMNS = ("t", "x", "y", "p")
US_PER = {"s": 1_000_000.0, "ms": 1000.0, "us": 1.0, "ns": 0.001}
ALIASES = {
    **dict.fromkeys(("ts", "time", "times", "timestamp", "timestamps"), "t"),
    **dict.fromkeys(("xs", "col", "column"), "x"),
    **dict.fromkeys(("ys", "row"), "y"),
    **dict.fromkeys(("ps", "pol", "pols", "polarity", "polarities", "on", "sign"), "p"),
    **dict.fromkeys(("sec", "secs", "seconds"), "sec"),
    **dict.fromkeys(("nsec", "nsecs", "nanosec", "nanoseconds"), "nsec"),
}
NAME = re.compile(r"(.*?)(?:[_\[( ](s|ms|us|ns)[\])]?)?", re.DOTALL)


def roles(request: Request, names: Iterable[str]) -> tuple[dict[str, int], str | None]:
    """Return the index of each column with a known name, and the unit of t if its name states one.

    Raises:
        ValueError: Two columns have the same name.
    """
    places: dict[str, int] = {}
    told = None
    for place, word in enumerate(names):
        match = NAME.fullmatch(word.strip().lower())
        name, unit = match.groups() if match else (word, None)
        name = ALIASES.get(name, name)
        if name not in (*COLUMNS, "sec", "nsec"):
            continue
        if name in places:
            raise request.refusal(f"names the column {name} twice; give columns= with one")
        places[name] = place
        told = unit if name == "t" else told
    return places, told


def column_of(request: Request, rows: np.ndarray, field: str | int | None) -> np.ndarray:
    """Return a column of rows by its name or number; None: the rows are one column.

    Raises:
        ValueError: The column does not contain real numbers.
    """
    column: np.ndarray = rows[:, field] if isinstance(field, int) else rows if field is None else rows[field]
    if column.dtype.kind not in "iufb":
        name = "a column" if field is None else f"column {field}"
        raise request.refusal(f"{name} has dtype {column.dtype}; save numbers")
    return column


def microseconds(request: Request, t: np.ndarray, said: str | None, usual: str | None = None) -> np.ndarray:
    """Convert times to microseconds from the unit of the file, else of the caller, else of the format.

    Raises:
        ValueError: The file and the caller state different units, or none is known.
    """
    given = request.time_unit
    if said and given and said != given:
        raise request.refusal(f"says time_unit={said} and the caller says {given}; leave time_unit out")
    unit = said or given or usual
    if unit not in US_PER:
        raise request.refusal(
            f"does not say the unit of its times; give time_unit as one of {', '.join(US_PER)}"
        )
    if unit == "us":
        return t
    if unit == "ns" and t.dtype.kind in "iu":
        wide = t if t.dtype.itemsize == 8 else t.astype(np.int64)  # 500 does not fit into every type
        return (wide + wide.dtype.type(500)) // 1000  # to the nearest
    if unit == "ms" and t.dtype.kind in "iu":
        return t.astype(np.int64) * 1000
    return t.astype(np.float64) * US_PER[unit]


def usual_unit(t: np.ndarray) -> str | None:
    """Return "us" for whole numbers, which are microseconds in all known formats, else None."""
    if t.dtype.kind in "iub":
        return "us"
    return "us" if len(t) and bool(np.all(t[np.isfinite(t)] % 1 == 0)) else None
