"""The result of every event file reader, and the rules that hold for every format.

A reader checks sizes before it allocates, and passes its raw columns to `finish`, which applies
the same rules to every format. What breaks a rule raises one ValueError that names the file, the
rule and the remedy.
"""

import dataclasses
import stat
from pathlib import Path

import numba
import numpy as np

from envs.events import EVENT
from envs.events.camera import T_LIMIT_US

MAX_EVENTS = 100_000_000  # 1.3 GB in the end, and up to 8 GB on the way
SMALL_EVENTS = 10_000_000  # what any file may hold
EVENTS_PER_BYTE = 2  # of dense recordings, five times as many as a camera's EVT 3.0 has
MAX_BYTES = 8 << 30
MAX_DISORDER_US = 1_000_000
MAX_PACKED = 1000  # times a file's size that it may unpack to; events pack to a tenth
SMALL_BYTES = 1 << 26  # what any file may unpack to


@dataclasses.dataclass(frozen=True)
class EventFile:
    """Events of a file, in time order, and the sensor that they come from.

    Attributes:
        events: Shape (N,), dtype EVENT, sorted by t; ties keep the order of the file.
        width, height: Pixels of the sensor; None where neither the file nor the caller says.
        format: Name of the format that was read, such as "evt3".
        late: Events that were older than one before them in the file, and were sorted in.
        skipped: Entries left out: no brightness change (triggers, frames, inertial samples of an
            AEDAT 2 file), or before the first time or row of an EVT stream.
        dropped: Events that the simulated sensor lost to its limit (videos only).
        strays: Times of an EVT stream that damage moved by more than a second, left out; the
            events after one keep the time before it, until the next.
        is_noise: bool (N,), which events no change of the light fired; None: nobody knows.
        missed: About which share of a scene's events its frames miss (videos and images only); None: too
            few frames or events to tell.
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


@dataclasses.dataclass(frozen=True)
class Request:
    """One file to read, as the caller describes it.

    Attributes:
        path: A regular file.
        width, height: Pixels of the sensor [px], or None: as the file says.
        columns: Names of the columns of a text file, in place of those that it gives.
        time_unit: "s", "ms", "us" or "ns", where the file does not say.
        max_events: Most events that are read.
    """

    path: Path
    width: int | None = None
    height: int | None = None
    columns: tuple[str, ...] | None = None
    time_unit: str | None = None
    max_events: int = MAX_EVENTS

    def refusal(self, rule: str) -> ValueError:
        """The error for a file that breaks a rule."""
        return ValueError(f"{self.path}: {rule}")

    def check_count(self, count: int) -> int:
        """The number of events, if it may be read.

        Raises:
            ValueError: It is more than `max_events`.
        """
        if count > self.max_events:
            raise self.refusal(
                f"holds {count} events and at most max_events={self.max_events} are read; "
                "raise max_events or cut the file"
            )
        return count

    def sized(self, width: int | None, height: int | None) -> "Request":
        """The same request with the sensor's size from the file filled in.

        Raises:
            ValueError: The file and the caller name different sizes.
        """
        for name, said, given in (("width", width, self.width), ("height", height, self.height)):
            if said is not None and given is not None and said != given:
                raise self.refusal(f"says {name}={said} and the caller says {given}; leave {name} out")
        return dataclasses.replace(
            self,
            width=self.width if width is None else width,
            height=self.height if height is None else height,
        )


def check_file(path: Path, max_bytes: int) -> int:
    """The size of a regular file [bytes]; nothing is opened, so a FIFO cannot block.

    Raises:
        ValueError: There is no such file, it is a directory, device or pipe, it is empty,
            or it is larger than `max_bytes`.
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
            f"{path}: is {info.st_size} bytes and at most max_bytes={max_bytes} are read; "
            "raise max_bytes or cut the file"
        )
    return info.st_size


def usual_events(size: int) -> int:
    """Most events that a file of a size [bytes] may hold unless the caller allows more."""
    return min(MAX_EVENTS, max(SMALL_EVENTS, EVENTS_PER_BYTE * size))


def check_declared(path: Path, name: str, declared_bytes: int) -> None:
    """Refuse what a file says it holds if it is far too small for that, before memory is taken.

    Raises:
        ValueError: `declared_bytes` are more than `MAX_PACKED` times the file's size.
    """
    size = path.stat().st_size
    if declared_bytes > max(SMALL_BYTES, MAX_PACKED * size):
        raise ValueError(f"{name} declares {declared_bytes} bytes in a file of {size}; write it again")


def polarity(request: Request, values: np.ndarray) -> np.ndarray:
    """Polarities in {-1, +1}, int8, from either of the two codes in use.

    Raises:
        ValueError: The values are neither all in {0, 1} nor all in {-1, +1}.
    """
    if values.size and not np.isin(values, (-1, 0, 1)).all():
        worst = values[~np.isin(values, (-1, 0, 1))][0]
        raise request.refusal(f"polarity must be coded as 0 and 1 or as -1 and 1, got {worst}; recode it")
    is_off = values <= 0
    if is_off.any() and len(np.unique(values[is_off])) > 1:
        raise request.refusal("polarity is coded as -1, 0 and 1 at once; keep 0 and 1 or -1 and 1")
    return np.where(is_off, np.int8(-1), np.int8(1))


def assemble(request: Request, t_us: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray) -> np.ndarray:
    """An EVENT array from four columns of numbers of any type; t is already in microseconds.

    Raises:
        ValueError: A coordinate is negative, fractional or above 65535, a time is not finite or
            outside [0, 2**52), or a polarity is not coded in one of the two ways.
    """
    events = np.empty(len(t_us), EVENT)
    for name, stored, limit in (("t", t_us, T_LIMIT_US), ("x", x, 65536), ("y", y, 65536)):
        values = stored.astype(np.float64) if stored.dtype.kind == "f" else stored  # half floats end at 65504
        good = (values >= 0) & (values < limit)  # NaN and infinity are not good either
        if not good.all():
            first = int(np.argmin(good))
            remedy = "shift the times" if name == "t" else "coordinates count from 0"
            raise request.refusal(
                f"{name} must lie in [0, {limit}), event {first} has {values[first]}; {remedy}"
            )
        if values.dtype.kind == "f" and name != "t" and np.any(values % 1):
            raise request.refusal(
                f"{name} must be whole pixels, event {int(np.argmax(values % 1 > 0))} is not"
            )
        events[name] = np.rint(values) if values.dtype.kind == "f" else values
    events["p"] = polarity(request, p)
    return events


def finish(
    request: Request,
    format: str,
    events: np.ndarray,
    skipped: int = 0,
    strays: int = 0,
    is_noise: np.ndarray | None = None,
) -> EventFile:
    """Check the rules that hold for every format, and put the events in time order.

    Times that go back by at most one second are sorted in (stable: ties keep the order of
    the file) and counted in `late`; real files hold a little such disorder. A longer way back
    is a clock that was reset or a damaged file, and is refused.

    Args:
        request: Its width and height, where known, bound the coordinates.
        format: Name of the format.
        events: EVENT array in the order of the file.
        skipped: Entries that were left out.
        strays: Times that were left out.
        is_noise: Labels of the events, 0 or 1 of any type, or None.

    Raises:
        ValueError: A coordinate is outside the sensor, a time is outside [0, 2**52), the
            times go back by more than a second, or labels are others or not one for each event.
    """
    labels = None if is_noise is None else _checked_labels(request, is_noise, len(events))
    x_max, y_max, t_min, t_max, late, back_us = _extremes(events)
    for name, size, largest in (("x", request.width, x_max), ("y", request.height, y_max)):
        if size is not None and largest >= size:
            first = int(np.argmax(events[name] >= size))
            raise request.refusal(
                f"event {first} has {name}={events[name][first]} outside the sensor of "
                f"{request.width}x{request.height}; give the right width and height or repair the file"
            )
    if t_min < 0 or t_max >= T_LIMIT_US:
        raise request.refusal("times must lie in [0, 2**52) us; shift them")
    if back_us > MAX_DISORDER_US:
        steps_us = np.maximum.accumulate(events["t"]) - events["t"]
        first = int(np.argmax(steps_us > MAX_DISORDER_US))
        raise request.refusal(
            f"event {first} is {steps_us[first]} us older than one before it; up to {MAX_DISORDER_US} us "
            "are sorted, more is a reset clock or damage: cut the file there"
        )
    if late:
        order = np.argsort(events["t"], kind="stable")
        events, labels = events[order], labels if labels is None else labels[order]
    return EventFile(
        events, request.width, request.height, format, late, skipped, strays=strays, is_noise=labels
    )


def _checked_labels(request: Request, is_noise: np.ndarray, count: int) -> np.ndarray:
    """The labels as bool (count,)."""
    if len(is_noise) != count or not np.isin(is_noise, (0, 1)).all():
        raise request.refusal("must have one is_noise of 0 or 1 for each event; repair or remove it")
    return is_noise.astype(bool)


@numba.njit(cache=True, error_model="numpy")
def _extremes(events: np.ndarray) -> tuple[int, int, int, int, int, int]:
    """Largest x and y, least and largest t, number of late events, and how late the latest is [us].

    One pass, because events take more memory than a processor's caches have.
    """
    x, y, oldest, newest, late, back_us = -1, -1, 0, 0, 0, 0
    for i in range(events.size):
        event = events[i]
        t = event.t
        x, y = max(x, event.x), max(y, event.y)
        oldest, newest = min(oldest, t), max(newest, t)
        late += t < newest
        back_us = max(back_us, newest - t)
    return x, y, oldest, newest, late, back_us


def unwrap(counter: np.ndarray, bits: int) -> np.ndarray:
    """Times [us] from a counter of a few bits that starts again at zero.

    A step of at least half the counter's range backwards is read as a wrap, and so is one that would lead
    before 0; a smaller one is disorder. So after a wrap, gaps of half the range or more cannot be told.

    Args:
        counter: Shape (N,), unsigned integers below 2**bits.
        bits: Width of the counter.

    Returns:
        int64 (N,), beginning with the first value of the counter.
    """
    half = 1 << (bits - 1)
    t_us = counter.astype(np.int64)
    if len(t_us):
        t_us[1:] = (np.diff(t_us) + half) % (2 * half) - half
        np.cumsum(t_us, out=t_us)
        t_us -= np.minimum.accumulate(t_us) // (2 * half) * (2 * half)
    return t_us


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
    if not np.isin(events["p"], (-1, 1)).all():
        raise ValueError("polarities must be -1 or +1; recode them")
    x, y = int(events["x"].max()), int(events["y"].max())
    if x >= width or y >= height:
        raise ValueError(f"events reach x={x}, y={y}, outside a sensor of {width}x{height}; give its size")


def check_order(events: np.ndarray) -> None:
    """Refuse events that are not sorted by time.

    Raises:
        ValueError: An event is older than the one before it.
    """
    back = events["t"][1:] < events["t"][:-1]
    if back.any():
        first = int(np.argmax(back)) + 1
        raise ValueError(f"events must be sorted by t; event {first} is older than the one before it")
