"""List the formats of event files, with how to recognise, read and write each."""

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from envs.recordings.aedat2 import MAGIC_2, read_aedat2
from envs.recordings.aedat3 import MAGIC_3, read_aedat3
from envs.recordings.aedat4 import MAGIC_4, aedat4_writer, read_aedat4
from envs.recordings.event_file import Append, Reader
from envs.recordings.event_stream import MAGIC_ES, read_es
from envs.recordings.hdf5_layouts import read_hdf5
from envs.recordings.hdf5_writer import hdf5_writer
from envs.recordings.nmnist import read_nmnist
from envs.recordings.npz import npz_writer, read_npy, read_npz
from envs.recordings.prophesee import dat_writer, evt2_writer, evt3_writer, read_dat, read_evt
from envs.recordings.ros import read_ros
from envs.recordings.ros_storage import MAGIC_BAG, MAGIC_DB3, MAGIC_MCAP
from envs.recordings.text import read_text, text_writer

Writer = Callable[..., AbstractContextManager[Append]]


class Format(NamedTuple):
    """One format.

    Attributes:
        read: Function that opens a file; None: the format can only be written.
        write: Function that creates a file from path, width and height, and, if `has_labels`, whether there
            are labels; None: the format can only be read.
        beginnings: First bytes of its files. Without these and `suffixes`, the caller must name the format.
        suffixes: Suffixes of files without such first bytes.
        written_suffixes: Suffixes for which `write_events` chooses this format.
        options: Arguments of `read_events` that it supports, of those that only some formats have.
        has_labels: Whether it stores labels of noise.
    """

    read: Reader | None = None
    write: Writer | None = None
    beginnings: tuple[bytes, ...] = ()
    suffixes: tuple[str, ...] = ()
    written_suffixes: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    has_labels: bool = False


NAMED = ("columns", "time_unit")
EVT_SUFFIXES = (".raw",)
TABLE: Mapping[str, Format] = {
    "aedat2": Format(read_aedat2, beginnings=(MAGIC_2,)),
    "aedat3": Format(read_aedat3, beginnings=(MAGIC_3,), options=("stream",)),
    "aedat4": Format(
        read_aedat4, aedat4_writer, (MAGIC_4,), written_suffixes=(".aedat4",), options=("stream",)
    ),
    "csv": Format(write=partial(text_writer, separator=","), written_suffixes=(".csv",)),
    "dat": Format(read_dat, dat_writer, (b"% Data file containing",), written_suffixes=(".dat",)),
    "es": Format(read_es, beginnings=(MAGIC_ES,)),
    "evt": Format(read_evt, beginnings=(b"% ",), suffixes=EVT_SUFFIXES),  # or DAT, depending on its header
    "evt2": Format(partial(read_evt, format="evt2"), evt2_writer),
    "evt21": Format(partial(read_evt, format="evt21")),
    "evt3": Format(partial(read_evt, format="evt3"), evt3_writer, written_suffixes=EVT_SUFFIXES),
    "hdf5": Format(
        read_hdf5,
        hdf5_writer,
        (b"\x89HDF\r\n\x1a\n",),
        written_suffixes=(".h5", ".hdf5"),
        options=(*NAMED, "group"),
        has_labels=True,
    ),
    "nmnist": Format(read_nmnist, suffixes=(".bin", ".bs2")),
    "npy": Format(read_npy, beginnings=(b"\x93NUMPY",), options=NAMED),
    "npz": Format(
        read_npz,
        npz_writer,
        (b"PK\x03\x04",),
        written_suffixes=(".npz",),
        options=(*NAMED, "group"),
        has_labels=True,
    ),
    "ros": Format(read_ros, beginnings=(MAGIC_BAG, MAGIC_DB3, MAGIC_MCAP), options=("topic",)),
    "txt": Format(
        read_text,
        text_writer,
        suffixes=(".csv", ".txt"),
        written_suffixes=(".txt",),
        options=NAMED,
    ),
}
FORMATS = tuple(name for name, row in TABLE.items() if row.read and name != "evt")
WRITERS = tuple(name for name, row in TABLE.items() if row.write)
LABELLED = tuple(name for name, row in TABLE.items() if row.has_labels)
WRITTEN_SUFFIXES = {suffix: name for name, row in TABLE.items() for suffix in row.written_suffixes}
OPTIONS = tuple(dict.fromkeys(option for row in TABLE.values() for option in row.options))
BEGINNING_BYTES = 32


def recognised(path: Path) -> str:
    """Return the format of a file by its first bytes, else by its suffix.

    Raises:
        ValueError: Neither is known.
    """
    with path.open("rb") as file:
        head = file.read(BEGINNING_BYTES)
    fits = [(len(b), name) for name, row in TABLE.items() for b in row.beginnings if head.startswith(b)]
    if fits:
        return max(fits)[1]
    for name, row in TABLE.items():
        if path.suffix.lower() in row.suffixes:
            return name
    raise ValueError(
        f"{path}: begins like no known event file ({head[:12]!r}); give format as one of {', '.join(FORMATS)}"
    )


def check_options(path: Path, format: str, given: Mapping[str, Any]) -> None:
    """Raise an error for options that have no effect on a format.

    Raises:
        ValueError: An option that the format does not have is not None.
    """
    for name in OPTIONS:
        if given.get(name) is not None and name not in TABLE[format].options:
            raise ValueError(f"{path}: {name} has no effect on {format} files; leave {name} out")
