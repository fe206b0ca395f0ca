"""Read files of Prophesee cameras, DAT and RAW with EVT 2.0, EVT 2.1 and EVT 3.0; write all but EVT 2.1.

DAT and RAW both start with lines `% name value`; the names distinguish them. Source: docs.prophesee.ai, "DAT
File Format", "EVT 2.0 Format", "EVT 2.1 Format", "EVT 3.0 Format".
"""

import contextlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path

import numpy as np

from core.files import replaced
from envs.events import EVENT
from envs.recordings.event_file import (
    OUTSIDE,
    RESERVED,
    TRIGGER,
    Append,
    Opened,
    Part,
    Request,
    chunks,
    whole_entries,
)
from envs.recordings.evt_decoders import State, decode_dat, decode_evt2, decode_evt3, new_state
from envs.recordings.mapped import mapped, mapped_parts

MAX_HEADER_BYTES = 1 << 16
DAT_WORD = np.dtype([("t", "<u4"), ("data", "<u4")])
DAT_CD_TYPES = (0x00, 0x0C)  # Event2d, EventCD
FEW_RESERVED = 16  # words of unknown types that are always allowed; above it, at most an eighth of all words
MAX_TRIGGERS = 1 << 16  # limit of a part
NAMES = {"EVT2": "evt2", "2.0": "evt2", "EVT21": "evt21", "2.1": "evt21", "EVT3": "evt3", "3.0": "evt3"}

# Type of the words of each encoding.
WORDS: dict[str, np.dtype] = {"evt2": np.dtype("<u4"), "evt21": np.dtype("<u8"), "evt3": np.dtype("<u2")}
# Bits of the clock and of a coordinate.
LIMITS = {"dat": (32, 14), "evt2": (34, 11), "evt3": (24, 11)}
MAX_WORDS = 1 << 26  # limit of a part: a gap of 76 hours in EVT 3.0
# Name of the camera plug-in and sensor size, for files that state no geometry.
SENSORS = (("genx320", 320, 320), ("imx636", 1280, 720), ("gen4", 1280, 720), ("gen3", 640, 480))


def read_dat(request: Request) -> Opened:
    """Open a DAT file, version 2. The 32-bit clock of 71.6 minutes is unwrapped.

    Raises:
        ValueError: The file has another version or event type.
    """
    fields, start = _header(request)
    if fields.get("Version") != "2":
        raise request.refusal(f"is DAT version {fields.get('Version')}; version 2 is read: write it again")
    kind, size = [*np.fromfile(request.path, np.uint8, 2, offset=start).tolist(), 0, 0][:2]
    if kind not in DAT_CD_TYPES or size != DAT_WORD.itemsize:
        raise request.refusal(
            f"contains entries of type {kind} and {size} bytes, no brightness changes of 8 bytes; "
            "give the DAT file of brightness changes (CD)"
        )
    request = request.sized(_number(fields.get("Width")), _number(fields.get("Height")))
    count = request.check_declared(whole_entries(request, start + 2, DAT_WORD.itemsize))
    return Opened("dat", request, _dat_parts(request, start + 2, count))


def _dat_parts(request: Request, start: int, count: int) -> Iterator[Part]:
    """Yield the events of a DAT file."""
    last_us = -1
    for words in mapped_parts(request, start, DAT_WORD, count):
        events = np.empty(len(words), EVENT)
        decode_dat(words, last_us, events)
        last_us = int(events["t"][-1])
        yield Part(events)


def read_evt(request: Request, format: str | None = None) -> Opened:
    """Open a RAW file of EVT 2.0, 2.1 or 3.0, as stated in its header or else by the caller.

    Triggers are read; padding is skipped and counted. A header with a version and without an encoding
    belongs to a DAT file, in whatever order its lines are.

    Raises:
        ValueError: The encoding is unknown, or words have types that the encoding does not have.
    """
    fields, start = _header(request)
    if format is None and "Version" in fields and not fields.keys() & {"evt", "format"}:
        return read_dat(request)
    options = dict(part.partition("=")[::2] for part in fields.get("format", "").split(";")[1:])
    encoding = _encoding(request, fields, format)
    request = request.sized(*_geometry(fields, options))
    endianness = options.get("endianness", "little")
    if endianness not in ("little", "legacy"):
        raise request.refusal(f"has {endianness}-endian words; little-endian ones are read: write it again")
    word = WORDS[encoding]
    count = whole_entries(request, start, word.itemsize)
    words, forget = mapped(request, start, word, count)
    return Opened(encoding, request, evt_parts(request, encoding, words, endianness, forget))


def evt_parts(
    request: Request,
    encoding: str,
    words: np.ndarray,
    endianness: str = "little",
    forget: Callable[[int], None] = lambda stop: None,
    states: dict[str, np.ndarray] | None = None,
) -> Iterator[Part]:
    """Yield the events of words of an EVT encoding.

    Args:
        request: The file.
        encoding: "evt2", "evt21" or "evt3".
        words: uint16, uint32 or uint64.
        endianness: "legacy": the lower half of a word of EVT 2.1 comes second.
        forget: Called with the number of words that have been decoded.
        states: Encoding -> decoder state after the previous words; updated in place. None: no previous words.
    """
    states = {} if states is None else states
    state = states.setdefault(encoding, new_state())
    state[State.WORD], before = 0, state.copy()
    decode = decoder(encoding, words, endianness)
    # About the number of events that such words usually encode; denser words take several arrays.
    usual = len(words) * {"evt2": 2, "evt21": 4, "evt3": 1}[encoding] // 2
    while state[State.WORD] < len(words):
        events = np.empty(min(request.part_events, usual) + 32, EVENT)
        triggers = np.empty(min(MAX_TRIGGERS, len(words)), TRIGGER)
        n, k = decode(state, events, triggers)
        _count(request, state, before, n)
        yield Part(events[:n] if n > len(events) // 2 else events[:n].copy(), None, triggers[:k].copy())
        forget(int(state[State.WORD]))


def decoder(
    encoding: str, words: np.ndarray, endianness: str
) -> Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[int, int]]:
    """Return a function of state, events and triggers that fills the last two from words of an encoding.

    The function returns the numbers of events and triggers, like the functions of `evt_decoders`.
    """
    if encoding == "evt3":
        return partial(decode_evt3, words)
    if encoding == "evt2":
        return partial(decode_evt2, words, np.empty(0, "<u4"))
    pairs = words.view("<u4").reshape(-1, 2)
    upper = 0 if endianness == "legacy" else 1  # IMX636 sends the upper half first
    return partial(decode_evt2, pairs[:, upper], pairs[:, 1 - upper])


def _count(request: Request, state: np.ndarray, before: np.ndarray, events: int) -> None:
    """Add a decoder's counts since `before` to the tally, and check that the encoding is right.

    Raises:
        ValueError: More than an eighth of the words have types that the encoding does not have, or more
            events lie beyond its last column than within it.
    """
    new = state - before
    request.tally.skipped += int(new[State.SKIPPED])
    request.tally.strays += int(new[State.STRAYS])
    for place, name in ((State.RESERVED, RESERVED), (State.BEYOND, OUTSIDE)):
        if new[place]:
            request.tally.damage[name] += int(new[place])
    before[:] = state
    if new[State.RESERVED] > max(FEW_RESERVED, new[State.WORD] // 8):
        raise request.refusal(
            f"has {new[State.RESERVED]} of {new[State.WORD]} words of types that this encoding does not "
            "have; the file is damaged or of another encoding: give format as evt2, evt21 or evt3"
        )
    if new[State.BEYOND] > max(FEW_RESERVED, events):
        raise request.refusal(
            f"has {new[State.BEYOND]} events beyond the last column of this encoding and {events} within it; "
            "the file is damaged or of another encoding: give format as evt2, evt21 or evt3"
        )


def _header(request: Request) -> tuple[dict[str, str], int]:
    """Return the fields of the text lines at the start, and the position of the first word."""
    head = np.fromfile(request.path, np.uint8, MAX_HEADER_BYTES).tobytes()
    fields: dict[str, str] = {}
    start = 0
    while head.startswith(b"% ", start):
        end = head.find(b"\n", start)
        if end < 0:
            raise request.refusal(
                "has a header without end; it is no file of a Prophesee camera, or damaged: give its format"
            )
        line = head[start + 2 : end].decode("latin-1").strip()
        start = end + 1
        if line == "end":
            break
        name, _, value = line.partition(" ")
        fields[name] = value.strip()
    return fields, start


def _encoding(request: Request, fields: dict[str, str], format: str | None) -> str:
    """Return the encoding that the header states, else the caller's."""
    said = fields.get("format", fields.get("evt", "")).partition(";")[0]
    encoding = NAMES.get(said)
    if said and encoding is None:
        raise request.refusal(
            f"is encoded as {said!r}; EVT2, EVT21 and EVT3 are read: write it again with one"
        )
    if encoding and format and format != encoding:
        raise request.refusal(f"says {encoding} and the caller says {format}; leave format out")
    if not (encoding or format):
        raise request.refusal("names no encoding; give format='evt2', 'evt21', 'evt3' or 'dat'")
    return encoding or str(format)


def _geometry(fields: dict[str, str], options: dict[str, str]) -> tuple[int | None, int | None]:
    """Return width and height of the sensor from the header; None if it does not state them."""
    if "width" in options and "height" in options:
        return _number(options["width"]), _number(options["height"])
    width, _, height = fields.get("geometry", "").partition("x")
    if _number(width) and _number(height):
        return _number(width), _number(height)
    plugin = fields.get("plugin_name", "")
    return next(((width, height) for name, width, height in SENSORS if name in plugin), (None, None))


def _number(text: str | None) -> int | None:
    """Return a size of a sensor in decimal digits, or None."""
    return int(text) if text and text.isascii() and text.isdigit() and 0 < len(text) < 6 else None


def dat_writer(path: Path, width: int, height: int) -> AbstractContextManager[Append]:
    """Yield a function that adds events to a DAT file.

    Raises:
        ValueError: The format's clock or address cannot represent the events.
    """
    lines = f"% Data file containing CD events\n% Version 2\n% Width {width}\n% Height {height}\n"
    return _writer(path, width, height, "dat", lines.encode() + bytes((0x0C, 8)), _dat_words)


def evt2_writer(path: Path, width: int, height: int) -> AbstractContextManager[Append]:
    """Yield a function that adds events to a RAW file of EVT 2.0; raises as in `dat_writer`."""
    return _writer(path, width, height, "evt2", _evt_header("2.0", width, height), _Evt2())


def evt3_writer(path: Path, width: int, height: int) -> AbstractContextManager[Append]:
    """Yield a function that adds events to a RAW file of EVT 3.0; raises as in `dat_writer`."""
    return _writer(path, width, height, "evt3", _evt_header("3.0", width, height), _Evt3(path))


@contextlib.contextmanager
def _writer(
    path: Path,
    width: int,
    height: int,
    format: str,
    header: bytes,
    words: Callable[[np.ndarray], np.ndarray],
) -> Iterator[Append]:
    """Write a header and yield a function that appends the words of events."""
    clock_bits, address_bits = LIMITS[format]
    if max(width, height) > 1 << address_bits:
        raise ValueError(f"{format} addresses at most {1 << address_bits} pixels, got {width}x{height}")
    with replaced(path) as part, part.open("wb") as file:
        file.write(header)
        is_first = True

        def append(events: np.ndarray, _: np.ndarray | None) -> None:
            nonlocal is_first
            _check_clock(events, format, clock_bits, is_first)
            is_first = is_first and not len(events)
            for some in chunks(events):
                file.write(words(some).tobytes())

        yield append


def _check_clock(events: np.ndarray, format: str, bits: int, is_first: bool) -> None:
    """Raise ValueError for times that the clock cannot represent. EVT 3.0 may wrap after its first event."""
    which = "first" if format == "evt3" else "last"
    if not len(events) or (which == "first" and not is_first):
        return
    clocked = int(events["t"][0 if which == "first" else -1])
    if clocked >= 1 << bits:
        raise ValueError(
            f"{format} has a clock of {bits} bits: the {which} event must be before {1 << bits} us, got "
            f"{clocked}; subtract the time of the first event, or choose another format"
        )


def _evt_header(version: str, width: int, height: int) -> bytes:
    """Return the header of a RAW file."""
    name = "EVT" + version[0]
    lines = f"% evt {version}\n% format {name};height={height};width={width}\n"
    return f"{lines}% geometry {width}x{height}\n% end\n".encode()


def _dat_words(events: np.ndarray) -> np.ndarray:
    """Return events as DAT entries."""
    words = np.empty(len(events), DAT_WORD)
    words["t"] = events["t"]
    words["data"] = (
        events["x"] | events["y"].astype(np.uint32) << 14 | (events["p"] > 0).astype(np.uint32) << 28
    )
    return words


class _Evt2:
    """Encode EVT 2.0: a word with the high part of the time whenever it changes, then the event."""

    def __init__(self) -> None:
        self._high = -1

    def __call__(self, events: np.ndarray) -> np.ndarray:
        """Return the words of the next events, uint32."""
        t = events["t"]
        words = (events["p"] > 0).astype(np.uint32) << 28 | (t & 63).astype(np.uint32) << 22
        words |= events["x"].astype(np.uint32) << 11 | events["y"]
        changes = np.flatnonzero(np.diff(t >> 6, prepend=self._high))
        self._high = int(t[-1]) >> 6
        return np.insert(words, changes, np.uint32(8 << 28) | (t[changes] >> 6).astype(np.uint32)).astype(
            "<u4"
        )


class _Evt3:
    """Encode EVT 3.0 without vectors, with every high part of the time, as a camera sends them."""

    def __init__(self, path: Path) -> None:
        self._path, self._high, self._low, self._y = path, -1, -1, -1

    def __call__(self, events: np.ndarray) -> np.ndarray:
        """Return the words of the next events, uint16."""
        high, low, y = events["t"] >> 12, events["t"] & 0xFFF, events["y"].astype(np.int64)
        before = self._high if self._high >= 0 else int(high[0]) - 1
        steps = np.diff(high, prepend=before)
        new_low = (steps > 0) | (np.diff(low, prepend=self._low) != 0)
        new_y = np.diff(y, prepend=self._y) != 0
        last = np.cumsum(steps + new_low + new_y + 1) - 1  # index of the word with x of each event
        if last[-1] >= MAX_WORDS:
            raise ValueError(
                f"{self._path}: evt3 needs {last[-1] + 1} words for gaps this long; choose npz or hdf5"
            )
        words = np.empty(last[-1] + 1, "<u2")
        is_high = np.ones(len(words), bool)
        for places, values in (
            (last, 0x2000 | (events["p"] > 0).astype(np.int64) << 11 | events["x"]),
            ((last - 1)[new_y], y[new_y]),
            ((last - 1 - new_y)[new_low], 0x6000 | low[new_low]),
        ):
            words[places] = values
            is_high[places] = False
        words[is_high] = 0x8000 | np.arange(before + 1, high[-1] + 1) & 0xFFF
        self._high, self._low, self._y = int(high[-1]), int(low[-1]), int(y[-1])
        return words
