"""The formats of event files that the field uses: which one a file has, and who reads and writes it."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from envs.recordings.aedat import MAGIC_2, MAGIC_4, read_aedat2, read_aedat4
from envs.recordings.aedat_writer import write_aedat4
from envs.recordings.event_file import MAX_BYTES, EventFile, Request, check_events, check_file, usual_events
from envs.recordings.event_stream import MAGIC_ES, read_es
from envs.recordings.hdf5 import read_hdf5, write_hdf5
from envs.recordings.plain import US_PER, read_nmnist, read_npz, read_text, write_npz, write_text
from envs.recordings.prophesee import read_dat, read_evt, write_prophesee

READERS: dict[str, Callable[[Request], EventFile]] = {
    "aedat2": read_aedat2,
    "aedat4": read_aedat4,
    "dat": read_dat,
    "es": read_es,
    "evt": read_evt,
    "evt2": lambda request: read_evt(request, "evt2"),
    "evt21": lambda request: read_evt(request, "evt21"),
    "evt3": lambda request: read_evt(request, "evt3"),
    "hdf5": read_hdf5,
    "nmnist": read_nmnist,
    "npz": read_npz,
    "txt": read_text,
}
FORMATS = tuple(name for name in READERS if name != "evt")
WRITERS: dict[str, Callable[[Path, np.ndarray, int, int], None]] = {
    "aedat4": write_aedat4,
    "csv": lambda path, events, width, height: write_text(path, events, width, height, ","),
    "dat": lambda path, events, width, height: write_prophesee(path, events, width, height, "dat"),
    "evt2": lambda path, events, width, height: write_prophesee(path, events, width, height, "evt2"),
    "evt3": lambda path, events, width, height: write_prophesee(path, events, width, height, "evt3"),
    "hdf5": write_hdf5,
    "npz": write_npz,
    "txt": write_text,
}

LABELLED: dict[str, Callable[[Path, np.ndarray, int, int, np.ndarray], None]] = {
    "hdf5": write_hdf5,
    "npz": write_npz,
}

# How a file begins; the first that fits names the format.
BEGINNINGS = (
    (MAGIC_2, "aedat2"),
    (MAGIC_4, "aedat4"),
    (b"\x89HDF\r\n\x1a\n", "hdf5"),
    (b"PK\x03\x04", "npz"),
    (b"% Data file containing", "dat"),
    (b"% ", "evt"),  # or DAT, as its header says
    (MAGIC_ES, "es"),
)
SUFFIXES = {
    ".aedat4": "aedat4",
    ".bin": "nmnist",
    ".csv": "txt",
    ".dat": "dat",
    ".es": "es",
    ".h5": "hdf5",
    ".hdf5": "hdf5",
    ".npz": "npz",
    ".raw": "evt",
    ".txt": "txt",
}
WRITTEN_SUFFIXES = {**SUFFIXES, ".csv": "csv", ".raw": "evt3"}


def read_events(
    path: str | Path,
    format: str | None = None,
    *,
    width: int | None = None,
    height: int | None = None,
    columns: Sequence[str] | None = None,
    time_unit: str | None = None,
    max_events: int | None = None,
    max_bytes: int = MAX_BYTES,
) -> EventFile:
    """Read an event file of any known format.

    Sizes are checked before memory is taken: of the file, of what it declares, and of the
    number of events.

    Args:
        path: A regular file.
        format: One of `FORMATS`; None: by how the file begins, else by its suffix.
        width: Columns of the sensor [px], where the file does not say.
        height: Its rows [px].
        columns: Names of the columns of a text file, in place of those that it gives, such as
            ("t", "x", "y", "p"); others than these four are passed over.
        time_unit: "s", "ms", "us" or "ns", for text and npz files that do not say.
        max_events: Most events that are read; each takes 13 bytes in the end and up to 80 on the way
            (a camera's own format: 50). None: two for each byte of the file, but ten million
            of any file and at most a hundred million.
        max_bytes: Largest file that is opened [bytes].

    Returns:
        The events sorted by t (ties keep the order of the file; up to one second of disorder
        is sorted and counted in `late`), p in {-1, +1}, with the sensor's size.

    Raises:
        ValueError: The file is no regular file, of no known format, damaged, too large, or
            breaks a rule of its format; the message names the file, the rule and the remedy.
    """
    path = Path(path)
    size = check_file(path, max_bytes)
    kind = format or _guessed(path)
    if kind not in READERS:
        raise ValueError(f"{path}: format must be one of {', '.join(FORMATS)}, got {format!r}")
    if time_unit is not None and time_unit not in US_PER:
        raise ValueError(f"time_unit must be one of {', '.join(US_PER)}, got {time_unit!r}")
    names = None if columns is None else tuple(columns)
    most = usual_events(size) if max_events is None else max_events
    try:
        return READERS[kind](Request(path, width, height, names, time_unit, most))
    except MemoryError:
        raise ValueError(
            f"{path}: does not fit into memory; cut the file, or lower max_events to be told earlier"
        ) from None


def write_events(
    path: str | Path,
    events: np.ndarray,
    width: int,
    height: int,
    format: str | None = None,
    *,
    is_noise: np.ndarray | None = None,
) -> None:
    """Write events to a file, which appears whole or not at all; `read_events` gives the same events.

    Formats: "npz", "hdf5" (the layout of DSEC), "txt" and "csv" (a header names columns and unit),
    and what the cameras' own tools open: iniVation's "aedat4", Prophesee's "dat", "evt2" and "evt3".

    Args:
        path: The file; its folder is made. A file of that name is replaced.
        events: EVENT array (N,), sorted by t.
        width: Columns of the sensor [px].
        height: Its rows [px].
        format: One of the above; None: by the suffix (`.raw` is "evt3").
        is_noise: bool (N,), which events are noise, as `video_to_events` labels them; for "npz" and "hdf5".

    Raises:
        ValueError: The format is unknown, the events or labels are not valid, or the format cannot hold
            them: its clock ends before the last event (dat 2**32 us, evt2 2**34 us), or before
            the first (evt3 2**24 us), or it has fewer pixels.
    """
    path = Path(path)
    kind = format or WRITTEN_SUFFIXES.get(path.suffix.lower(), "")
    if kind not in WRITERS:
        raise ValueError(f"{path}: format must be one of {', '.join(WRITERS)}, got {format or path.suffix!r}")
    check_events(events, width, height)
    if is_noise is None:
        WRITERS[kind](path, events, width, height)
        return
    if kind not in LABELLED:
        raise ValueError(f"{path}: {kind} holds no labels of noise; choose {' or '.join(LABELLED)}")
    if getattr(is_noise, "dtype", None) != np.dtype(bool) or is_noise.shape != events.shape:
        raise ValueError(f"{path}: is_noise must be bool {events.shape}, got {is_noise!r:.80}")
    LABELLED[kind](path, events, width, height, is_noise)


def _guessed(path: Path) -> str:
    """The format by how the file begins, else by its suffix."""
    with path.open("rb") as file:
        head = file.read(32)
    if head.startswith(b"#!AER-DAT") and not head.startswith((MAGIC_2, MAGIC_4)):
        raise ValueError(
            f"{path}: is of another AEDAT version than 2.0 and 4.0; convert it with dv-processing"
        )
    for beginning, name in BEGINNINGS:
        if head.startswith(beginning):
            return name
    name = SUFFIXES.get(path.suffix.lower(), "")
    # These formats always begin as above, so a file that does not is another one or damaged.
    if not name or name in ("aedat4", "dat", "es", "hdf5", "npz"):
        raise ValueError(
            f"{path}: begins like no known event file; give format as one of {', '.join(FORMATS)}"
        )
    return name
