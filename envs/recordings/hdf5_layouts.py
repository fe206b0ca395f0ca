"""Read events from HDF5 files in known layouts (`LAYOUTS`), or in any other by `group` and `columns`."""

import json
import re
from collections.abc import Iterator
from typing import Any, NamedTuple

import h5py
import numpy as np

from envs.recordings.ecf import metavision_parts
from envs.recordings.event_file import Opened, Part, Request, assemble
from envs.recordings.hdf5_checks import (
    CUT_ERRORS,
    ERRORS,
    attribute,
    check_plain,
    data_sets,
    declared_length,
    is_cut,
    listing,
    opened,
    row_parts,
    time_offset,
    two_numbers,
)
from envs.recordings.names import COLUMNS, column_of, microseconds, roles, usual_unit
from envs.recordings.npz import FIRST_ROWS, table_order

NOISE = "events/is_noise"  # labels, optional
UNREADABLE = "is no readable HDF5 event file ({}); copy or write it again"


class Layout(NamedTuple):
    """Location and form of the events in the files of some data sets and programs.

    Attributes:
        users: Data sets and programs that use the layout.
        group: Path of the group or of the one data set of rows.
        columns: Data sets of t, x, y and p in the group, or the columns of the rows in their order.
        time_unit: Unit of fractional times; whole times are microseconds.
        size: Width and height, if all files have the same size and do not state it.
    """

    users: str
    group: str
    columns: tuple[str, ...] = COLUMNS
    time_unit: str | None = None
    size: tuple[int, int] | None = None


LAYOUTS = (
    Layout("DSEC, TUM-VIE, VECtor, RVT, eTraM, vid2e, v2e", "events"),
    Layout("event_utils, EVREAL, E2VID+", "events", ("ts", "xs", "ys", "ps"), "s"),
    Layout("M3ED, EvTTC", "prophesee/left"),
    Layout("M3ED, EvTTC", "prophesee/right"),
    Layout("MVSEC", "davis/left/events", ("x", "y", "t", "p"), "s", (346, 260)),
    Layout("MVSEC", "davis/right/events", ("x", "y", "t", "p"), "s", (346, 260)),
    Layout("event-vision-library", "raw_events", COLUMNS, "s"),
    Layout("EDS", ""),
    Layout("RPEFlow", "", ("events_t", "events_x", "events_y", "events_p")),
)
# Files with these types, an offset and an index of milliseconds are DSEC's and have this size.
DSEC_TYPES, DSEC_SIZE = {"t": "u4", "x": "u2", "y": "u2", "p": "u1"}, (640, 480)


class Found(NamedTuple):
    """Location of the events in a file.

    Attributes:
        group: As in `Layout`.
        paths: Data sets of t, x, y and p; or the one data set of rows, four times.
        fields: Fields or columns of the rows, or None four times.
        layout: The matching row of `LAYOUTS`, or None.
    """

    group: str
    paths: tuple[str, ...]
    fields: tuple[str | int | None, ...] = (None,) * 4
    layout: Layout | None = None


def read_hdf5(request: Request) -> Opened:
    """Open an HDF5 file.

    Raises:
        ValueError: The file has no known layout, is damaged, links to other files, or declares more than
            `max_events` events.
    """
    with request.refusing(ERRORS, UNREADABLE), opened(request.path) as file:
        if "CD" in file and request.group is None:
            request = request.sized(*_said_size(file, "CD"))
            return Opened("hdf5", request, _metavision(request))
        found, others = find(request, file)
        count = request.check_declared(len(file[found.paths[0]]))
        for path in dict.fromkeys(found.paths):
            if found.fields[0] is None and declared_length(file, path) != count:
                raise ValueError(f"{path} and {found.paths[0]} differ in length")
        request = _sized(request, file, found)
    if others:
        request.tally.notes.append(
            f"events of {found.group} are read; group= chooses another of {', '.join(others)}"
        )
    return Opened("hdf5", request, _parts(request, found, count))


def find(request: Request, file: h5py.File) -> tuple[Found, list[str]]:
    """Return the location of the events, and all groups with events if there are several.

    Raises:
        ValueError: The file has no known layout; the message lists the contents of the file.
    """
    sets = data_sets(file)
    if request.group is not None or request.columns is not None:
        return _named(request, file, sets), []
    matches = ((layout, _matched(request, file, sets, layout)) for layout in LAYOUTS)
    found = [match._replace(layout=layout) for layout, match in matches if match]
    if not found:
        groups = sorted({path.rpartition("/")[0] for path in sets})
        found = [one for group in groups if (one := _by_roles(request, sets, group))]
    if not found:
        if "events" in file and not sets:  # raises an error about the expected data set
            check_plain(file, "events/t", 1)
        known = "; ".join(f"{row.users}: {row.group or '/'}" for row in LAYOUTS)
        raise request.refusal(
            f"has no events in a layout that is known ({known}); {listing(file)}: give group= with the path "
            "of the group or data set of the events, and columns= with the names of its t, x, y and p"
        )
    names = list(dict.fromkeys(one.group or "/" for one in found))
    return found[0], names if len(names) > 1 else []


def _matched(
    request: Request, file: h5py.File, sets: dict[str, h5py.Dataset], layout: Layout
) -> Found | None:
    """Return the location of the events if the file has this layout, else None."""
    if layout.group in sets:
        data = sets[layout.group]
        if data.dtype.names:
            return _fields(request, layout.group, data, None)
        if data.ndim == 2 and data.shape[1] == len(COLUMNS):
            return _table(layout.group, layout.columns)
        return None
    paths = tuple(_join(layout.group, name) for name in layout.columns)
    return Found(layout.group, paths) if all(_has(file, path) for path in paths) else None


def _has(file: h5py.File, path: str) -> bool:
    """Whether a path exists in the file, up to the first link; links are checked later."""
    parts = path.split("/")
    group: Any = file
    for part in parts[:-1]:
        if not isinstance(group.get(part, getlink=True), h5py.HardLink):
            return group.get(part, getlink=True) is not None
        group = group[part]
        if not isinstance(group, h5py.Group):
            return False
    return group.get(parts[-1], getlink=True) is not None


def _named(request: Request, file: h5py.File, sets: dict[str, h5py.Dataset]) -> Found:
    """Return the location of the events that the caller names by `group` and `columns`."""
    group = (request.group or "").strip("/")
    if request.group is None and "events" in sets:
        group = "events"
    if group in sets:
        data = sets[group]
        if data.dtype.names:
            found = _fields(request, group, data, request.columns)
        else:
            columns = request.columns or table_order(request, group, _first_rows(file, group))
            found = _table(group, columns)
    elif request.columns is not None:
        paths = tuple(_join(group, name) for name in request.columns)
        missing = [path for path in paths if path not in sets]
        if missing and request.group is None:
            paths = tuple(_join("events", name) for name in request.columns)
            missing = missing if any(path not in sets for path in paths) else []
        found = None if missing or len(paths) != len(COLUMNS) else Found(group, paths)
    else:
        found = _by_roles(request, sets, group)
    if found is None:
        raise request.refusal(
            f"has no events at group={request.group!r}, columns={request.columns!r}; {listing(file)}: give "
            "group= with the path of a group or data set, and columns= with the names of its t, x, y and p"
        )
    return found


def _by_roles(request: Request, sets: dict[str, h5py.Dataset], group: str) -> Found | None:
    """Return the location of the events in a group by any known names of its data sets, or None."""
    paths = [path for path, data in sets.items() if path.rpartition("/")[0] == group and data.ndim == 1]
    places, _ = roles(request, [path.rpartition("/")[2].removeprefix("events_") for path in paths])
    if not set(COLUMNS) <= places.keys():
        return None
    return Found(group, tuple(paths[places[name]] for name in COLUMNS))


def _fields(request: Request, path: str, data: h5py.Dataset, columns: tuple[str, ...] | None) -> Found | None:
    """Return the location of the events in a data set of rows with named fields, or None."""
    names = data.dtype.names or ()
    if columns is None:
        places, _ = roles(request, names)
        columns = tuple(names[places[name]] if name in places else "" for name in COLUMNS)
    if not set(columns) <= set(names) or len(columns) != len(COLUMNS):
        return None
    return Found(path, (path,) * 4, columns)


def _table(path: str, columns: tuple[str, ...]) -> Found | None:
    """Return the location of the events in a data set of rows without names, or None."""
    if not set(COLUMNS) <= set(columns):
        return None
    return Found(path, (path,) * 4, tuple(columns.index(name) for name in COLUMNS))


def _join(group: str, name: str) -> str:
    """Return the path of a name in a group."""
    return f"{group}/{name}" if group else name


def _first_rows(file: h5py.File, path: str) -> np.ndarray:
    """Return the first rows of a table."""
    check_plain(file, path, 2)
    return np.asarray(file[path][:FIRST_ROWS])


def _metavision(request: Request) -> Iterator[Part]:
    """Yield the events of a file in Metavision's layout."""
    with request.refusing(ERRORS, UNREADABLE), opened(request.path) as file:
        yield from metavision_parts(request, file)


def _parts(request: Request, found: Found, count: int) -> Iterator[Part]:
    """Yield the events from the location that was found."""
    with request.refusing(ERRORS, UNREADABLE), opened(request.path) as file:
        paths = list(dict.fromkeys(found.paths))
        for path in paths:
            check_plain(file, path, 2 if isinstance(found.fields[0], int) else 1)
        offset = time_offset(file) if found.group == "events" else 0
        has_labels = found.group == "events" and file.get(NOISE, getlink=True) is not None
        if has_labels and declared_length(file, NOISE) != count:
            raise ValueError("it must have one is_noise of 0 or 1 for each event")
        for rows in row_parts(request, [file[path] for path in paths]):
            labels = np.asarray(file[NOISE][rows]) if has_labels else None
            yield _part(request, file, found, rows, offset, labels)


def _part(
    request: Request, file: h5py.File, found: Found, rows: slice, offset: int, labels: np.ndarray | None
) -> Part:
    """Return some rows as events."""
    blocks = {path: file[path][rows] for path in dict.fromkeys(found.paths)}
    columns = zip(found.paths, found.fields, strict=True)
    t, x, y, p = (column_of(request, blocks[path], field) for path, field in columns)
    usual = usual_unit(t)
    if t.dtype.kind == "f" and found.layout and found.layout.time_unit:
        usual = found.layout.time_unit
    if usual is None and request.time_unit is None:
        raise ValueError(f"{found.paths[0]} are no whole microseconds; give time_unit")
    t_us = microseconds(request, t, None, usual)
    if t_us.dtype.kind in "iu" and len(t_us) and not 0 <= int(t_us.max()) + abs(offset) < 1 << 62:
        raise ValueError(f"{found.paths[0]} are not below 2**62 with their offset; shift them")
    t_us = t_us.astype(np.int64, copy=False) + offset if t_us.dtype.kind in "iu" else t_us + offset
    return assemble(request, t_us, x, y, p, labels)


def _sized(request: Request, file: h5py.File, found: Found) -> Request:
    """Return the request with the sensor's size from the file, or else the usual size of its layout."""
    width, height = _said_size(file, found.group)
    if (width, height) == (None, None) and (request.width, request.height) == (None, None):
        usual = found.layout.size if found.layout else None
        types = {name: file[path].dtype.str[1:] for name, path in zip(COLUMNS, found.paths, strict=True)}
        if types == DSEC_TYPES and {"t_offset", "ms_to_idx"} <= set(file):
            usual = DSEC_SIZE
        return request.sized(*(usual or (None, None)))
    return request.sized(width, height)


def _said_size(file: h5py.File, group: str) -> tuple[int | None, int | None]:
    """Return width and height as stated in the file; None if not stated, or lost in a truncated file."""
    try:
        return _size_of(file, group)
    except CUT_ERRORS:
        if not is_cut(file):
            raise
        return None, None


def _size_of(file: h5py.File, group: str) -> tuple[int | None, int | None]:
    """Return width and height from attributes, data sets next to the events, or a recording's settings."""
    given = file.attrs
    if "width" in given and "height" in given:
        return int(attribute(file, "width")), int(attribute(file, "height"))
    geometry = str(attribute(file, "geometry")) if "geometry" in given else ""
    if found := re.fullmatch(r"(\d{1,5})x(\d{1,5})", geometry, re.ASCII):
        return int(found[1]), int(found[2])
    shape = two_numbers(file, "sensor_resolution") if "sensor_resolution" in given else None  # event_utils
    if shape:
        return shape[1], shape[0]
    for name, ndim in ((_join(group, "width"), 0), (_join(group, "calib/resolution"), 1)):
        size = _size_set(file, name, ndim)
        if size:
            return size
    about = json.loads(attribute(file, "about")) if "about" in given else {}
    sensor = about.get("sensor") if isinstance(about, dict) else None
    if not isinstance(sensor, dict) or not all(type(sensor.get(name)) is int for name in ("width", "height")):
        return None, None
    return sensor["width"], sensor["height"]


def _size_set(file: h5py.File, name: str, ndim: int) -> tuple[int, int] | None:
    """Return width and height from data sets: RVT's two numbers, or M3ED's one pair."""
    try:
        check_plain(file, name, ndim)
        if ndim:
            values = file[name][:] if file[name].shape == (2,) else []
            return (int(values[0]), int(values[1])) if len(values) == 2 else None
        other = name.removesuffix("width") + "height"
        check_plain(file, other, 0)
        return int(file[name][()]), int(file[other][()])
    except (KeyError, ValueError, TypeError):
        return None
