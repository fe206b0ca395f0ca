"""Read events of any format: a whole file, a range of times, or part by part."""

import copy
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from envs.events import EVENT
from envs.recordings.event_file import (
    MAX_BYTES,
    PART_EVENTS,
    EventFile,
    Opened,
    Part,
    Request,
    Tally,
    check_file,
    usual_events,
)
from envs.recordings.formats import FORMATS, TABLE, check_options, recognised
from envs.recordings.names import US_PER
from envs.recordings.order import damage_lines, in_order, joined
from envs.recordings.ros_storage import is_bag_folder

MOST_GAPS = 3  # gaps that a warning lists


def read_events(  # noqa: PLR0913  files may lack any of this
    path: str | Path,
    format: str | None = None,
    *,
    width: int | None = None,
    height: int | None = None,
    columns: Sequence[str] | None = None,
    time_unit: str | None = None,
    topic: str | None = None,
    group: str | None = None,
    stream: int | None = None,
    start_us: int | None = None,
    end_us: int | None = None,
    strict: bool = False,
    max_events: int | None = None,
    max_bytes: int = MAX_BYTES,
) -> EventFile:
    """Read an event file of any known format.

    Damaged data is left out and counted in `damage`. One warning reports damage and gaps.

    Args:
        path: A regular file, or the folder of a rosbag2.
        format: One of `FORMATS`; None: recognised by its first bytes, else by its suffix.
        width: Columns of the sensor [px], if the file does not state them.
        height: Rows of the sensor [px], if the file does not state them.
        columns: Text, and rows without names: all columns in their order, such as ("t", "x", "y", "p");
            columns with other names are ignored. npz and HDF5: names of the arrays of t, x, y and p.
        time_unit: "s", "ms", "us" or "ns", if the file does not state it.
        topic: Topic of events in a ROS bag.
        group: Group or data set of an HDF5 file, or array of an npz file, that contains the events.
        stream: Number of a stream or source of an AEDAT file.
        start_us: First time to read [us], on the clock of the file.
        end_us: Time before which reading ends [us].
        strict: Whether damage is an error.
        max_events: Maximum number of events. Each takes 13 bytes in the result and up to 80 while
            reading (50 for a camera's own format). None: two for each byte of the file, but at least
            ten million and at most a hundred million.
        max_bytes: Maximum size of the file [bytes].

    Returns:
        The events sorted by t (ties keep the order of the file), p in {-1, +1}, with the sensor's size.

    Raises:
        ValueError: The file is no regular file, has no known format, is too large, is too damaged, or
            breaks a rule of its format; the message names the file, the rule and the remedy.
    """
    opened = _opened(**locals())
    request = opened.request
    try:
        if request.is_range:
            ordered: Iterator[Part] = _within(in_order(opened, request.part_events), request)
        else:
            ordered = in_order(opened, None)
        part = joined(ordered, request)
    except MemoryError:
        raise ValueError(
            f"{path}: does not fit into memory; read a part by start_us and end_us, or lower max_events"
        ) from None
    file = _file(opened, part, Tally())
    tell(request.path, file)
    return file


def read_parts(  # noqa: PLR0913  as above
    path: str | Path,
    format: str | None = None,
    *,
    width: int | None = None,
    height: int | None = None,
    columns: Sequence[str] | None = None,
    time_unit: str | None = None,
    topic: str | None = None,
    group: str | None = None,
    stream: int | None = None,
    start_us: int | None = None,
    end_us: int | None = None,
    strict: bool = False,
    part_events: int = PART_EVENTS,
    max_bytes: int = MAX_BYTES,
) -> Iterator[EventFile]:
    """Yield the events of a file in parts, in order of time, with memory for about one part.

    Events that are late by less than a second are sorted in, if that second has no more events than a part;
    events that are later are counted in `damage`.

    Args:
        path: As in `read_events`.
        format: As in `read_events`.
        width: As in `read_events`.
        height: As in `read_events`.
        columns: As in `read_events`.
        time_unit: As in `read_events`.
        topic: As in `read_events`.
        group: As in `read_events`.
        stream: As in `read_events`.
        start_us: As in `read_events`.
        end_us: As in `read_events`.
        strict: As in `read_events`.
        part_events: Approximate maximum number of events of a part.
        max_bytes: As in `read_events`.

    Yields:
        Parts, each with the counts since the previous part. A file without events gives one empty part.

    Raises:
        ValueError: As in `read_events`.
    """
    if part_events < 1:
        raise ValueError(f"part_events must be at least 1, got {part_events}")
    return _parts(_opened(**locals(), max_events=1 << 62))


def _parts(opened: Opened) -> Iterator[EventFile]:
    """Yield parts as `EventFile`s."""
    is_first, tally = True, Tally()
    ordered = in_order(opened, opened.request.part_events)
    empty = None
    for part in _within(ordered, opened.request) if opened.request.is_range else ordered:
        file = _file(opened, part, tally)
        tally = copy.deepcopy(opened.request.tally)
        tell(opened.request.path, file)
        if len(file.events) or len(file.triggers):
            yield file
            is_first = False
        else:
            empty = file
    if is_first:
        yield empty or _file(opened, Part(np.empty(0, EVENT)), tally)


def _opened(
    path: str | Path,
    format: str | None,
    *,
    max_events: int | None,
    max_bytes: int = MAX_BYTES,
    columns: Sequence[str] | None = None,
    **options: Any,
) -> Opened:
    """Open the file that the arguments of `read_events` describe."""
    path = Path(path)
    if is_bag_folder(path):
        size, kind = sum(one.stat().st_size for one in path.iterdir() if one.is_file()), format or "ros"
        if kind != "ros":
            raise ValueError(f"{path}: is the folder of a ROS bag and no {kind} file; leave format out")
    else:
        size = check_file(path, max_bytes)
        kind = format or recognised(path)
    if kind not in TABLE or (read := TABLE[kind].read) is None:
        raise ValueError(f"{path}: format must be one of {', '.join(FORMATS)}, got {format!r}")
    unit = options.get("time_unit")
    if unit is not None and unit not in US_PER:
        raise ValueError(f"time_unit must be one of {', '.join(US_PER)}, got {unit!r}")
    check_options(path, kind, {"columns": columns, **options})
    request = Request(
        path,
        columns=None if columns is None else tuple(columns),
        max_events=usual_events(size) if max_events is None else max_events,
        **options,
    )
    return read(request)


def _within(parts: Iterator[Part], request: Request) -> Iterator[Part]:
    """Yield the events and triggers within the request's range of times, and stop after it."""
    start = np.iinfo(np.int64).min if request.start_us is None else request.start_us
    end = np.iinfo(np.int64).max if request.end_us is None else request.end_us
    for part in parts:
        t_us, triggers = part.events["t"], part.triggers
        first, last = int(np.searchsorted(t_us, start)), int(np.searchsorted(t_us, end))
        inside = (triggers["t"] >= start) & (triggers["t"] < end)
        some = part.rows(slice(first, last))
        yield Part(some.events.copy(), some.is_noise, triggers[inside])
        if last < len(t_us):
            return


def _file(opened: Opened, part: Part, before: Tally) -> EventFile:
    """Return a part as an `EventFile`, with the counts since the tally `before`."""
    request, tally = opened.request, opened.request.tally
    return EventFile(
        part.events,
        request.width,
        request.height,
        opened.format,
        tally.late - before.late,
        tally.skipped - before.skipped,
        strays=tally.strays - before.strays,
        is_noise=part.is_noise,
        triggers=part.triggers,
        damage=dict(tally.damage - before.damage),
        gaps=tuple(tally.gaps[len(before.gaps) :]),
        notes=tuple(tally.notes[len(before.notes) :]),
    )


def tell(path: Path, file: EventFile) -> None:
    """Issue one warning about a reader's choices, damage and gaps, if any."""
    lines = list(file.notes)
    lost = damage_lines(file.damage, file.strays)
    if lost:
        lines.append(f"left out or moved: {'; '.join(lost)}. strict=True refuses such a file")
    if file.gaps:
        shown = ", ".join(
            f"{(b - a) / 1e6:,.1f} s from {a / 1e6:,.3f} s on" for a, b in file.gaps[:MOST_GAPS]
        )
        more = f" and {len(file.gaps) - MOST_GAPS:,} more" if len(file.gaps) > MOST_GAPS else ""
        lines.append(f"no events for {shown}{more}")
    if lines:
        warnings.warn(f"{path}: {'. '.join(lines)}.", stacklevel=3)
