"""Sort the events of a file by time, by the same rules for every format.

Real files contain a little disorder and some damage. Late events are sorted in. An event outside the
sensor, of an older clock, or with a time far from all others is left out and counted. Gaps are reported.
"""

import dataclasses
import itertools
from collections.abc import Iterator, Mapping

import numba
import numpy as np

from envs.events import EVENT
from envs.recordings.event_file import (
    NO_TRIGGERS,
    OLD_CLOCK,
    OUTSIDE,
    RESETS,
    STRAY_TIMES,
    TOO_LATE,
    TORN,
    Opened,
    Part,
    Request,
    concatenated,
)

FAR_US = 1_000_000  # a longer step is a gap or a reset of the clock
TORN_US = 990_000  # an event as late as this lacks the carry into the seconds (jAER drops such events too)
FEW_STRAYS = 100  # maximum number of successive events with damaged times
FEW_OLD = 10_000  # maximum number of events that a camera sends on its old clock after a reset
MOST_RESETS = 16

GOOD, IS_OUTSIDE, IS_TORN, IS_LEFT_OUT = range(4)  # marks of events


@dataclasses.dataclass
class Clock:
    """State of the time that carries over from part to part.

    Attributes:
        newest_us: Newest time of accepted events [us]; -1: none.
        shift_us: Offset of the times of the file after a reset [us].
        taken: Number of accepted events.
        seen: Number of events of the file so far.
        delivered_us: Newest time of yielded events [us]; -1: none.
    """

    newest_us: int = -1
    shift_us: int = 0
    taken: int = 0
    seen: int = 0
    delivered_us: int = -1


def in_order(opened: Opened, hold: int | None) -> Iterator[Part]:
    """Yield the events of a file in order of time.

    Args:
        opened: The file.
        hold: Maximum number of events held back until later events are known; they are the newest second of
            events. None: the whole file is one part.

    Raises:
        ValueError: More than a tenth of the events are outside the sensor, the clock goes back more than 16
            times, or the request is strict and the file is damaged.
    """
    request, clock, held = opened.request, Clock(), Part(np.empty(0, EVENT))
    for part in opened.parts if hold is not None else (joined(opened.parts, request),):
        good, is_old = _taken(part, request, clock)
        merged = _merged(Part(held.events[:0]) if is_old else held, good, request, clock)
        check_strict(request)
        cut = len(merged.events)
        if hold is not None and cut:
            recent = int(np.searchsorted(merged.events["t"], merged.events["t"][-1] - FAR_US))
            cut = max(recent, cut - hold)
        held = merged.rows(slice(cut, None))._replace(triggers=NO_TRIGGERS)
        yield _delivered(merged.rows(slice(0, cut)), clock)
    check_strict(request)
    if len(held.events):
        yield _delivered(held, clock)


def joined(parts: Iterator[Part], request: Request) -> Part:
    """Join all parts into one.

    Raises:
        ValueError: The parts have more than `max_events` events.
    """
    some: list[Part] = []
    count = 0
    for part in parts:
        some.append(part)
        count = request.check_count(count + len(part.events))
    return concatenated(some)


def check_strict(request: Request) -> None:
    """Raise an error for a damaged file if the request is strict.

    Raises:
        ValueError: The request is strict and the tally counts damage.
    """
    if request.strict and (request.tally.damage or request.tally.strays):
        raise request.refusal(
            f"is damaged ({'; '.join(damage_lines(request.tally.damage, request.tally.strays))}); "
            "read it without strict, which leaves this out"
        )


def damage_lines(damage: Mapping[str, int], strays: int) -> list[str]:
    """Return a line for each kind of damage with its count."""
    lines = [f"{count:,} {name}" for name, count in damage.items()]
    return lines + ([f"{strays:,} stray times of the stream"] if strays else [])


@numba.njit(cache=True, error_model="numpy")
def walk(
    events: np.ndarray, width: int, height: int, newest: int, marks: np.ndarray, breaks: np.ndarray
) -> tuple[int, int, int]:
    """Mark events that are outside the sensor or torn, and find long steps of the time.

    Args:
        events: EVENT array (N,) in the order of the file.
        width: Columns of the sensor [px].
        height: Rows of the sensor [px].
        newest: Newest time before these events [us]; -1: none.
        marks: uint8 (N,), filled with marks.
        breaks: int64 (N,), filled with the first event after each step of more than a second.

    Returns:
        Number of events outside, number of torn events, number of breaks.
    """
    outside, torn, count = 0, 0, 0
    is_begun = newest >= 0
    for i in range(events.size):
        event = events[i]
        if event.x >= width or event.y >= height:
            marks[i] = IS_OUTSIDE
            outside += 1
            continue
        marks[i] = GOOD
        step = event.t - newest
        if is_begun and (step > FAR_US or step < -FAR_US):
            breaks[count] = i
            count += 1
            newest = event.t
        elif is_begun and step < -TORN_US:
            marks[i] = IS_TORN
            torn += 1
        elif step > 0 or not is_begun:
            newest = event.t
        is_begun = True
    return outside, torn, count


@numba.njit(cache=True, error_model="numpy")
def count_late(events: np.ndarray, newest: int) -> tuple[int, int]:
    """Return the number of events that are older than an earlier one, and the newest time [us]."""
    late = 0
    for i in range(events.size):
        t = events[i].t
        late += t < newest
        newest = max(newest, t)
    return late, newest


def _taken(part: Part, request: Request, clock: Clock) -> tuple[Part, bool]:
    """Return the good events of a part, and whether all events before the part are of an older clock."""
    events = part.events
    marks, breaks = np.empty(len(events), np.uint8), np.empty(len(events), np.int64)
    size = request.width or 65536, request.height or 65536
    newest = clock.newest_us - clock.shift_us if clock.newest_us >= 0 else -1
    outside, torn, count = walk(events, *size, newest, marks, breaks)
    clock.seen += len(events)
    _count_outside(request, clock, events, outside)
    if torn:
        request.tally.damage[TORN] += torn
    is_old = False
    if count:
        events, is_old = _without_jumps(request, events, marks, breaks[:count].copy(), clock)
    elif clock.shift_us:
        events = events.copy()
        events["t"] += clock.shift_us
    part = part._replace(events=events)
    if marks.any():
        part = part.rows(marks == GOOD)
    late, clock.newest_us = count_late(part.events, -1 if is_old else clock.newest_us)
    request.tally.late += late
    clock.taken += len(part.events)
    return part, is_old


def _count_outside(request: Request, clock: Clock, events: np.ndarray, outside: int) -> None:
    """Count events outside the sensor; raise ValueError if there are too many."""
    if not outside:
        return
    beyond = request.tally.damage[OUTSIDE] = request.tally.damage[OUTSIDE] + outside
    if beyond > max(1, clock.seen // 10) or beyond == clock.seen:
        raise request.refusal(
            f"has events up to x={events['x'].max()}, y={events['y'].max()}, {beyond:,} of {clock.seen:,} "
            f"outside the sensor of {request.width}x{request.height}; give the right width and height"
        )


def _without_jumps(
    request: Request, events: np.ndarray, marks: np.ndarray, breaks: np.ndarray, clock: Clock
) -> tuple[np.ndarray, bool]:
    """Classify each long step of the time as a gap, stray times, an older clock or a reset.

    Marks the events to leave out in `marks`.

    Returns:
        The events on one clock, and whether all events before the part are of an older clock.
    """
    events, is_old = events.copy(), False
    bounds = [0, *breaks.tolist(), len(events)]
    runs = [(a, b) for a, b in itertools.pairwise(bounds) if (marks[a:b] == GOOD).any()]
    firsts = [int(events["t"][a:b][marks[a:b] == GOOD][0]) for a, b in runs] + [-1]
    now = clock.newest_us
    for (a, b), first, later in zip(runs, firsts, firsts[1:], strict=False):
        run, size = slice(a, b), int(np.count_nonzero(marks[a:b] == GOOD))
        shown, follows = first + clock.shift_us, later + clock.shift_us >= now - FAR_US and later >= 0
        is_back = now >= 0 and shown < now - FAR_US
        is_gap = now >= 0 and shown > now + FAR_US
        if size <= FEW_STRAYS and follows and (is_back or (is_gap and later < first)):
            request.tally.damage[STRAY_TIMES] += size
            marks[run][marks[run] == GOOD] = IS_LEFT_OUT
            continue
        if is_back and _is_old(marks[:a], clock, size):
            request.tally.damage[OLD_CLOCK] += clock.taken + int(np.count_nonzero(marks[:a] == GOOD))
            marks[:a] = np.where(marks[:a] == GOOD, IS_LEFT_OUT, marks[:a])
            clock.taken, clock.shift_us, is_old = 0, 0, True
            request.tally.gaps.clear()
        elif is_back:
            request.tally.damage[RESETS] += 1
            clock.shift_us += now + 1 - shown
            if request.tally.damage[RESETS] > MOST_RESETS:
                raise request.refusal(
                    f"goes back in time more than {MOST_RESETS} times by more than a second; check format, "
                    "columns and time_unit, or sort its events"
                )
        elif is_gap:
            request.tally.gaps.append((now, shown))
        events["t"][run] += clock.shift_us
        now = int(events["t"][run][marks[run] == GOOD].max())
    return events, is_old


def _is_old(marks: np.ndarray, clock: Clock, size: int) -> bool:
    """Whether the events before a run are few enough to be leftovers of an older clock."""
    before = clock.taken + int(np.count_nonzero(marks == GOOD))
    return clock.delivered_us < 0 and before <= min(FEW_OLD, size // 10)


def _merged(held: Part, part: Part, request: Request, clock: Clock) -> Part:
    """Sort the events that were held back together with the events of a part; ties keep their order."""
    if len(held.events):
        part = concatenated((held, part))
    t_us = part.events["t"]
    if len(t_us) and (t_us[1:] < t_us[:-1]).any():
        part = part.rows(np.argsort(t_us, kind="stable"))
    if len(t_us) and part.events["t"][0] < clock.delivered_us:
        first = int(np.searchsorted(part.events["t"], clock.delivered_us))
        request.tally.damage[TOO_LATE] += first
        part = part.rows(slice(first, None))
    return part


def _delivered(part: Part, clock: Clock) -> Part:
    """Record the newest time of a part that is about to be yielded; return the part."""
    if len(part.events):
        clock.delivered_us = int(part.events["t"][-1])
    return part
