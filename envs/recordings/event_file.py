"""Define the types that readers and writers of event files share, and check the columns that are read.

A reader gets a `Request` and returns an `Opened` file: the sensor's size, and parts of events in the
order of the file. `envs.recordings.order` sorts the parts by time, by one set of rules for all formats.
A `Tally` counts everything in the file other than good events. Every error is a ValueError that names
the file, the rule and the remedy.
"""

import contextlib
import dataclasses
import itertools
import stat
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from envs.events import EVENT
from envs.events.camera import T_LIMIT_US

MAX_EVENTS = 100_000_000  # 1.3 GB as an EVENT array
SMALL_EVENTS = 10_000_000  # allowed for a file of any size
EVENTS_PER_BYTE = 2  # of dense recordings, five times as many as in a camera's EVT 3.0
MAX_BYTES = 1 << 38  # 275 GB; files are read in parts
MAX_PACKED = 1000  # a file may unpack to this multiple of its size; events pack to a tenth
SMALL_BYTES = 1 << 26  # allowed unpacked size for a file of any size
PART_EVENTS = 1 << 22  # 55 MB
CHUNK_EVENTS = 1 << 18  # events that a writer converts at once

TRIGGER = np.dtype([("t", "<i8"), ("channel", "<i2"), ("p", "i1")])  # us; +1 rising, -1 falling, 0 pulse
NO_TRIGGERS = np.empty(0, TRIGGER)

MAX_SIDE = 1 << 16  # of a sensor [pixels]; coordinates have 16 bits
# Kinds of damage: reasons to leave something out. Keys of `EventFile.damage`.
OUTSIDE = "events outside the sensor"
RESERVED = "words of types that the encoding does not have"
CUT = "bytes of an entry that was cut off"
CUT_TABLE = "tables of contents that were cut off"
CUT_PACKETS = "packets that are damaged or were cut off"
OLD_CLOCK = "events of an older clock at the start"
TORN = "events whose second was not carried"
STRAY_TIMES = "events with a time far from all others"
RESETS = "resets of the clock; later times were moved to follow"
TOO_LATE = "events too late for their part"
ROWS = "rows that are no event"
CUT_LINE = "lines that were cut off"


@dataclasses.dataclass
class Tally:
    """Counts of everything but good events that a reader found; they grow while parts are read.

    Attributes:
        skipped, late, strays, damage, gaps: As in `EventFile`.
        codes: Codes of OFF seen so far, 0 or -1; a file may use only one.
        notes: Choices that the reader made, such as one of two streams.
    """

    skipped: int = 0
    late: int = 0
    strays: int = 0
    damage: Counter[str] = dataclasses.field(default_factory=Counter)
    gaps: list[tuple[int, int]] = dataclasses.field(default_factory=list)
    codes: set[int] = dataclasses.field(default_factory=set)
    notes: list[str] = dataclasses.field(default_factory=list)


class Part(NamedTuple):
    """Some events of a file.

    Attributes:
        events: EVENT array (N,).
        is_noise: bool (N,), labels of the events; None: the file has no labels.
        triggers: TRIGGER array (K,).
    """

    events: np.ndarray
    is_noise: np.ndarray | None = None
    triggers: np.ndarray = NO_TRIGGERS

    def rows(self, which: slice | np.ndarray) -> "Part":
        """Return some of the events, with all triggers."""
        labels = None if self.is_noise is None else self.is_noise[which]
        return self._replace(events=self.events[which], is_noise=labels)


def concatenated(parts: Iterable[Part]) -> Part:
    """Join parts into one, without a copy if there is only one."""
    some = list(parts)
    if len(some) == 1:
        return some[0]
    labels = [part.is_noise for part in some if part.is_noise is not None]
    return Part(
        np.concatenate([np.empty(0, EVENT), *(part.events for part in some)]),
        np.concatenate(labels) if labels else None,
        np.concatenate([NO_TRIGGERS, *(part.triggers for part in some)]),
    )


@dataclasses.dataclass(frozen=True)
class EventFile:
    """Events of a file, in time order, and the sensor that they come from.

    Attributes:
        events: Shape (N,), dtype EVENT, sorted by t; ties keep the order of the file.
        width, height: Pixels of the sensor; None if neither the file nor the caller states them.
        format: Name of the format that was read, such as "evt3".
        late: Number of events that were older than an earlier one in the file, and were sorted in.
        skipped: Number of entries that are no brightness change (triggers, frames, inertial samples,
            padding), or come before the first time or row of an EVT stream.
        dropped: Number of events that the simulated sensor lost to its limit (videos only).
        strays: Number of times of an EVT stream that damage moved by more than a second. They are left
            out: events after one get the previous time, until the next time.
        is_noise: bool (N,), which events were not caused by a change of the light; None: not known.
        missed: Approximate fraction of the scene's events that its frames miss (videos and images only);
            None: too few frames or events to estimate it.
        triggers: TRIGGER array, external triggers: time [us], channel, edge.
        damage: Kind of damage -> number of items that were left out or moved because of it.
        gaps: Pauses of more than a second: times of the last event before and of the first after [us].
        notes: Choices that the reader made.
    """

    events: np.ndarray
    width: int | None
    height: int | None
    format: str
    late: int = 0
    skipped: int = 0
    dropped: int = 0
    strays: int = 0
    is_noise: np.ndarray | None = None
    missed: float | None = None
    triggers: np.ndarray = dataclasses.field(default_factory=lambda: np.empty(0, TRIGGER))
    damage: dict[str, int] = dataclasses.field(default_factory=dict)
    gaps: tuple[tuple[int, int], ...] = ()
    notes: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Request:
    """One file to read, as the caller describes it.

    Attributes:
        path: A regular file, or the folder of a bag.
        width, height: Pixels of the sensor [px]; None: as stated in the file.
        columns: Names of columns, as in `read_events`.
        time_unit: "s", "ms", "us" or "ns", if the file does not state it.
        topic: Topic of a bag.
        group: Group or data set of an HDF5 file, array of an npz file.
        stream: Number of a stream of events in an AEDAT file.
        start_us, end_us: First time to read, and the time before which reading ends [us]; None: all.
        max_events: Maximum number of events to read.
        part_events: Approximate maximum number of events of a part.
        strict: Whether damage is an error.
        tally: Counts of damage and other findings; they grow while parts are read.
    """

    path: Path
    width: int | None = None
    height: int | None = None
    columns: tuple[str, ...] | None = None
    time_unit: str | None = None
    topic: str | None = None
    group: str | None = None
    stream: int | None = None
    start_us: int | None = None
    end_us: int | None = None
    max_events: int = MAX_EVENTS
    part_events: int = PART_EVENTS
    strict: bool = False
    tally: Tally = dataclasses.field(default_factory=Tally)

    def refusal(self, rule: str) -> ValueError:
        """Return the error for a file that breaks a rule."""
        return ValueError(f"{self.path}: {rule}")

    @contextlib.contextmanager
    def refusing(self, errors: tuple[type[Exception], ...], rule: str) -> Iterator[None]:
        """Convert errors of libraries to the error for the file; pass on an error that already names it.

        Args:
            errors: The types of the errors.
            rule: The rule that the file breaks, with `{}` for the text of the error.

        Raises:
            ValueError: There was such an error.
        """
        try:
            yield
        except errors as error:
            if isinstance(error, ValueError) and str(error).startswith(str(self.path)):
                raise
            raise self.refusal(rule.format(error)) from None

    def check_count(self, count: int) -> int:
        """Return the number of events, if it is allowed.

        Raises:
            ValueError: The number is above `max_events`.
        """
        if count > self.max_events:
            raise self.refusal(
                f"contains {count} events or more and at most max_events={self.max_events} are read; raise "
                "max_events, or read a part by start_us and end_us"
            )
        return count

    def check_declared(self, count: int) -> int:
        """Return the number of events that a file declares, if it is allowed.

        Raises:
            ValueError: The number is above `max_events`, and the caller did not ask for a range of times.
        """
        return count if self.is_range else self.check_count(count)

    @property
    def is_range(self) -> bool:
        """Whether the caller asks for a range of times."""
        return self.start_us is not None or self.end_us is not None

    def sized(self, width: int | None, height: int | None) -> "Request":
        """Return the same request with the sensor's size from the file filled in.

        A side outside 1..`MAX_SIDE` is not a size: it counts as not stated.

        Raises:
            ValueError: The file and the caller state different sizes.
        """
        sides = {"width": self.width, "height": self.height}
        for name, said, given in (("width", width, self.width), ("height", height, self.height)):
            if said is None or not 1 <= said <= MAX_SIDE:
                continue
            if given is not None and said != given:
                raise self.refusal(f"says {name}={said} and the caller says {given}; leave {name} out")
            sides[name] = said
        return dataclasses.replace(self, width=sides["width"], height=sides["height"])


@dataclasses.dataclass(frozen=True)
class Opened:
    """A file that is ready to be read.

    Attributes:
        format: Name of the format.
        request: The request, with the sensor's size from the file filled in.
        parts: The events in the order of the file; can be iterated only once.
    """

    format: str
    request: Request
    parts: Iterator[Part]


Reader = Callable[[Request], Opened]
# Adds events to a file that is being written, and labels if the format supports them.
Append = Callable[[np.ndarray, np.ndarray | None], None]


def check_file(path: Path, max_bytes: int) -> int:
    """Return the size of a regular file [bytes] without opening it, so that a FIFO cannot block.

    Raises:
        ValueError: The file does not exist, is a directory, device or pipe, is empty, or is larger
            than `max_bytes`.
    """
    try:
        info = path.stat()
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: cannot be opened ({error}); check the path") from None
    if not stat.S_ISREG(info.st_mode):
        raise ValueError(f"{path}: is no regular file; give the path of one recording")
    if info.st_size == 0:
        raise ValueError(f"{path}: is empty; record or copy it again")
    if info.st_size > max_bytes:
        raise ValueError(
            f"{path}: is {info.st_size} bytes and at most max_bytes={max_bytes} are read; raise max_bytes"
        )
    return info.st_size


def usual_events(size: int) -> int:
    """Return the default limit of events for a file of `size` bytes."""
    return min(MAX_EVENTS, max(SMALL_EVENTS, EVENTS_PER_BYTE * size))


def check_declared(path: Path, name: str, declared_bytes: int) -> None:
    """Raise an error for contents that are far too large for the file, before memory is allocated.

    Raises:
        ValueError: `declared_bytes` is above `MAX_PACKED` times the file's size, and above `SMALL_BYTES`.
    """
    size = path.stat().st_size
    if declared_bytes > max(SMALL_BYTES, MAX_PACKED * size):
        raise ValueError(
            f"{name} declares {declared_bytes} bytes in a file of {size}; copy or record it again"
        )


def whole_entries(request: Request, start: int, entry: int) -> int:
    """Return the number of entries of `entry` bytes from `start` on; count rest bytes in the tally."""
    size = request.path.stat().st_size - start
    if size % entry:
        request.tally.damage[CUT] += size % entry
    return size // entry


def polarity(request: Request, values: np.ndarray) -> np.ndarray:
    """Return polarities in {-1, +1}, int8, from either of the two codes in use; a file may use only one.

    Args:
        request: The file, whose tally contains the codes of OFF seen so far.
        values: Numbers or booleans.

    Raises:
        ValueError: The values are neither all in {0, 1} nor all in {-1, +1}.
    """
    if values.dtype.kind == "u" and values.dtype.itemsize >= 4:  # some writers store -1 like this
        values = np.where(values == np.iinfo(values.dtype).max, np.int64(-1), values.astype(np.int64))
    good = (values == 1) | (values == 0) | (values == -1)
    if not good.all():
        worst = values[~good][0]
        raise request.refusal(f"polarity must be coded as 0 and 1 or as -1 and 1, got {worst}; recode it")
    is_off = values <= 0
    request.tally.codes.update(int(code) for code in np.unique(values[is_off]))
    if len(request.tally.codes) > 1:
        raise request.refusal("polarity is coded as -1, 0 and 1 at once; recode it as 0 and 1")
    return np.where(is_off, np.int8(-1), np.int8(1))


def assemble(
    request: Request,
    t_us: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    p: np.ndarray,
    is_noise: np.ndarray | None = None,
    triggers: np.ndarray = NO_TRIGGERS,
) -> Part:
    """Return a part from columns of numbers of any type; t is already in microseconds.

    An invalid row (a time that is not finite or outside [0, 2**52), a coordinate outside [0, 65536))
    is left out and counted.

    Args:
        request: The file.
        t_us: Times (N,) [us].
        x: Columns of the sensor [px].
        y: Rows of the sensor [px].
        p: Polarities, in either code.
        is_noise: Labels, 0 or 1; None: no labels.
        triggers: TRIGGER array of the part.

    Raises:
        ValueError: More than a tenth of the values of t, x or y are invalid, a coordinate is fractional, a
            polarity is not coded in one of the two ways, or a label is neither 0 nor 1.
    """
    columns, good = {"t": t_us, "x": x, "y": y}, np.ones(len(t_us), bool)
    for name, limit in (("t", T_LIMIT_US), ("x", 65536), ("y", 65536)):
        values = columns[name]
        if values.dtype.kind == "f":
            values = values.astype(np.float64)  # float16 ends at 65504
        fits = (values >= 0) & (values < limit)  # NaN and infinity do not
        bad = len(values) - np.count_nonzero(fits)
        if bad > max(1, len(values) // 10) or bad == len(values) > 0:
            _refuse_column(request, name, values, fits, limit)
        good &= fits
        columns[name] = values
    if not good.all():
        request.tally.damage[ROWS] += int(np.count_nonzero(~good))
        columns = {name: values[good] for name, values in columns.items()}
    events = np.empty(np.count_nonzero(good), EVENT)
    for name, values in columns.items():
        if values.dtype.kind == "f" and name != "t" and np.any(values % 1):
            raise request.refusal(
                f"{name} must be whole pixels, event {int(np.argmax(values % 1 > 0))} is not; round them"
            )
        events[name] = np.rint(values) if values.dtype.kind == "f" else values
    events["p"] = polarity(request, p if good.all() else p[good])
    return Part(events, None if is_noise is None else _labels(request, is_noise)[good], triggers)


def gathered(request: Request, dtype: np.dtype, packets: Iterable[np.ndarray]) -> Iterator[Part]:
    """Yield the contents of packets as parts of about `part_events` events.

    Args:
        request: The file.
        dtype: Type of the events, with the fields t [us], x, y and p.
        packets: Arrays (N,) of this dtype, and TRIGGER arrays.

    Raises:
        ValueError: As in `assemble`.
    """
    some, triggers, count = [np.empty(0, dtype)], [NO_TRIGGERS], 0
    for packet in itertools.chain(packets, (None,)):  # None: the end
        if packet is not None and packet.dtype == TRIGGER:
            triggers.append(packet)
        elif packet is not None:
            some.append(packet)
            count += len(packet)
        if packet is None or count >= request.part_events:
            rows = np.concatenate(some)
            t_us, x, y, p = (rows[name] for name in ("t", "x", "y", "p"))
            yield assemble(request, t_us, x, y, p, triggers=np.concatenate(triggers))
            some, triggers, count = [np.empty(0, dtype)], [NO_TRIGGERS], 0


def _labels(request: Request, is_noise: np.ndarray) -> np.ndarray:
    """Return labels as booleans."""
    if not np.isin(is_noise, (0, 1)).all():
        raise request.refusal("must have one is_noise of 0 or 1 for each event; repair or remove it")
    return is_noise.astype(bool)


def _refuse_column(request: Request, name: str, values: np.ndarray, fits: np.ndarray, limit: int) -> None:
    """Raise the error for a column with too many invalid values."""
    first = int(np.argmin(fits))
    remedy = "coordinates count from 0"
    if name == "t":
        remedy = "shift the times"
        if values[first] >= limit:
            remedy = "give time_unit='ns' if they are nanoseconds, else shift them"
    raise request.refusal(f"{name} must lie in [0, {limit}), event {first} has {values[first]}; {remedy}")


def check_events(events: np.ndarray, width: int, height: int) -> None:
    """Check events before they are written.

    Raises:
        ValueError: The dtype is not EVENT, the events are not sorted by t, a time is outside
            [0, 2**52), a polarity is not -1 or +1, or a coordinate is outside the sensor.
    """
    if getattr(events, "dtype", None) != EVENT or events.ndim != 1:
        raise ValueError(
            f"events must be one array of dtype EVENT {EVENT}, got {getattr(events, 'dtype', type(events))}"
        )
    if not (0 < width <= 65536 and 0 < height <= 65536):
        raise ValueError(f"width and height must lie in [1, 65536], got {width} and {height}")
    if not len(events):
        return
    check_order(events)
    if not (events["t"][0] >= 0 and events["t"][-1] < T_LIMIT_US):
        raise ValueError(
            f"times must lie in [0, 2**52) us, got {events['t'][0]} to {events['t'][-1]}; shift them"
        )
    if not ((events["p"] == 1) | (events["p"] == -1)).all():
        raise ValueError("polarities must be -1 or +1; recode them")
    x, y = int(events["x"].max()), int(events["y"].max())
    if x >= width or y >= height:
        raise ValueError(f"events reach x={x}, y={y}, outside a sensor of {width}x{height}; give its size")


def check_order(events: np.ndarray) -> None:
    """Check that events are sorted by time.

    Raises:
        ValueError: An event is older than the one before it.
    """
    back = events["t"][1:] < events["t"][:-1]
    if back.any():
        first = int(np.argmax(back)) + 1
        raise ValueError(f"events must be sorted by t; event {first} is older than the one before it")


def chunks(events: np.ndarray) -> Iterator[np.ndarray]:
    """Yield events in chunks of at most `CHUNK_EVENTS`."""
    for first in range(0, len(events), CHUNK_EVENTS):
        yield events[first : first + CHUNK_EVENTS]
