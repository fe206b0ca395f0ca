"""Files of Prophesee cameras: DAT, and RAW with the encodings EVT 2.0, EVT 2.1 and EVT 3.0.

Both begin with lines `% name value`, and what these name tells them apart. From the published
descriptions (docs.prophesee.ai: "DAT File Format", "EVT 2.0 Format", "EVT 2.1 Format", "EVT 3.0
Format"). Every decoder runs twice: once to count, so that the number of events is known and checked
before memory is taken for them, once to fill.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from core.files import replaced
from envs.events import EVENT
from envs.recordings.event_file import EventFile, Request, finish
from envs.recordings.evt_decoders import COLUMNS, decode_dat, decode_evt2, decode_evt3

MAX_HEADER_BYTES = 1 << 16
MAX_WORDS = 1 << 30
DAT_WORD = np.dtype([("t", "<u4"), ("data", "<u4")])
DAT_CD_TYPES = (0x00, 0x0C)  # Event2d, EventCD

# Sensors by the name of the camera plug-in, for files that state no geometry.
SENSORS = (("genx320", 320, 320), ("imx636", 1280, 720), ("gen4", 1280, 720), ("gen3", 640, 480))

# Clock bits and coordinate bits of what is written, and so the first time that does not fit.
LIMITS = {"dat": (32, 14), "evt2": (34, 11), "evt3": (24, 11)}


def read_dat(request: Request) -> EventFile:
    """Events of a DAT file, version 2. The 32-bit clock of 71.6 minutes is unwrapped.

    Raises:
        ValueError: Another version or event type, a truncated body, or a rule of `finish`.
    """
    fields, start = _header(request)
    if fields.get("Version") != "2":
        raise request.refusal(f"is DAT version {fields.get('Version')}; only version 2 is read: convert it")
    kind, size = [*np.fromfile(request.path, np.uint8, 2, offset=start).tolist(), 0, 0][:2]
    if kind not in DAT_CD_TYPES or size != DAT_WORD.itemsize:
        raise request.refusal(
            f"holds entries of type {kind} and {size} bytes, no brightness changes of 8 bytes"
        )
    words = _words(request, start + 2, DAT_WORD)
    request.check_count(len(words))
    request = request.sized(_number(fields.get("Width")), _number(fields.get("Height")))
    events = np.empty(len(words), EVENT)
    decode_dat(words, events)
    return finish(request, "dat", events)


def read_evt(request: Request, format: str | None = None) -> EventFile:
    """Events of a RAW file, in the encoding that its header names or that `format` says.

    External triggers and vendor words are passed over. Words of reserved types are refused. A header
    with a version and without an encoding is that of a DAT file, in whatever order its lines are.

    Raises:
        ValueError: No known encoding, a truncated body, words that the encoding does not have,
            or a rule of `finish`.
    """
    fields, start = _header(request)
    if format is None and "Version" in fields and not fields.keys() & {"evt", "format"}:
        return read_dat(request)
    options = dict(part.partition("=")[::2] for part in fields.get("format", "").split(";")[1:])
    encoding = _encoding(request, fields, format)
    request = request.sized(*_geometry(fields, options))
    if options.get("endianness", "little") not in ("little", "legacy"):
        raise request.refusal(f"has {options['endianness']}-endian words; only little-endian ones are read")
    if encoding == "evt3":
        decoded = _decoded(request, decode_evt3, _words(request, start, np.dtype("<u2")))
    elif encoding == "evt2":
        words = _words(request, start, np.dtype("<u4"))
        decoded = _decoded(request, decode_evt2, words, np.empty(0, "<u4"))
    else:
        pairs = _words(request, start, np.dtype("<u8")).view("<u4").reshape(-1, 2)
        upper = 0 if options.get("endianness") == "legacy" else 1  # IMX636 sends the upper half first
        columns = np.ascontiguousarray(pairs.T)
        decoded = _decoded(request, decode_evt2, columns[upper], columns[1 - upper])
    return finish(request, encoding, *decoded)


def write_prophesee(path: Path, events: np.ndarray, width: int, height: int, format: str) -> None:
    """Write checked events as "dat", "evt2" or "evt3"; reading gives the same events.

    Raises:
        ValueError: The format's clock or address cannot hold them.
    """
    clock_bits, address_bits = LIMITS[format]
    if max(width, height) > 1 << address_bits:
        raise ValueError(f"{format} addresses at most {1 << address_bits} pixels, got {width}x{height}")
    limit_us = 1 << clock_bits
    clocked = events["t"][:1] if format == "evt3" else events["t"][-1:]
    if len(clocked) and clocked[0] >= limit_us:
        which = "first" if format == "evt3" else "last"
        raise ValueError(
            f"{format} has a clock of {clock_bits} bits: the {which} event must be before {limit_us} us, got "
            f"{clocked[0]}; subtract the time of the first event, or choose another format"
        )
    with replaced(path) as part, part.open("wb") as file:
        if format == "dat":
            lines = f"% Data file containing CD events\n% Version 2\n% Width {width}\n% Height {height}\n"
            file.write(lines.encode() + bytes((0x0C, 8)))
            file.write(_dat_words(events).tobytes())
        else:
            version = format[3:] + ".0"
            lines = f"% evt {version}\n% format {format.upper()};height={height};width={width}\n"
            file.write(f"{lines}% geometry {width}x{height}\n% end\n".encode())
            words = _evt2_words(events) if format == "evt2" else _evt3_words(path, events)
            file.write(words.tobytes())


def _dat_words(events: np.ndarray) -> np.ndarray:
    """Entries of DAT."""
    words = np.empty(len(events), DAT_WORD)
    words["t"] = events["t"]
    words["data"] = (
        events["x"] | events["y"].astype(np.uint32) << 14 | (events["p"] > 0).astype(np.uint32) << 28
    )
    return words


def _evt2_words(events: np.ndarray) -> np.ndarray:
    """Words of EVT 2.0: a high part of the time wherever it changes, then the event."""
    t = events["t"]
    words = (events["p"] > 0).astype(np.uint32) << 28 | (t & 63).astype(np.uint32) << 22
    words |= events["x"].astype(np.uint32) << 11 | events["y"]
    changes = np.flatnonzero(np.diff(t >> 6, prepend=-1))
    return np.insert(words, changes, np.uint32(8 << 28) | (t[changes] >> 6).astype(np.uint32)).astype("<u4")


def _evt3_words(path: Path, events: np.ndarray) -> np.ndarray:
    """Words of EVT 3.0 without vectors, with every high part of the time, as a camera sends them."""
    if not len(events):
        return np.empty(0, "<u2")
    high, low, y = events["t"] >> 12, events["t"] & 0xFFF, events["y"].astype(np.int64)
    steps = np.diff(high, prepend=high[0] - 1)
    new_low = (steps > 0) | (np.diff(low, prepend=-1) != 0)
    new_y = np.diff(y, prepend=-1) != 0
    last = np.cumsum(steps + new_low + new_y + 1) - 1  # where the word with x of each event goes
    if last[-1] >= MAX_WORDS:
        raise ValueError(f"{path}: evt3 needs {last[-1] + 1} words for gaps this long; choose npz or hdf5")
    words = np.empty(last[-1] + 1, "<u2")
    is_high = np.ones(len(words), bool)
    for places, values in (
        (last, 0x2000 | (events["p"] > 0).astype(np.int64) << 11 | events["x"]),
        ((last - 1)[new_y], y[new_y]),
        ((last - 1 - new_y)[new_low], 0x6000 | low[new_low]),
    ):
        words[places] = values
        is_high[places] = False
    words[is_high] = 0x8000 | np.arange(high[0], high[-1] + 1) & 0xFFF
    return words


def _header(request: Request) -> tuple[dict[str, str], int]:
    """The fields of the text lines at the beginning, and where the words begin."""
    head = np.fromfile(request.path, np.uint8, MAX_HEADER_BYTES).tobytes()
    fields: dict[str, str] = {}
    start = 0
    while head.startswith(b"% ", start):
        end = head.find(b"\n", start)
        if end < 0:
            raise request.refusal("has a header without end; it is no file of a Prophesee camera, or damaged")
        line = head[start + 2 : end].decode("latin-1").strip()
        start = end + 1
        if line == "end":
            break
        name, _, value = line.partition(" ")
        fields[name] = value.strip()
    return fields, start


def _encoding(request: Request, fields: dict[str, str], format: str | None) -> str:
    """The encoding by the header, else by the caller."""
    names = {"EVT2": "evt2", "2.0": "evt2", "EVT21": "evt21", "2.1": "evt21", "EVT3": "evt3", "3.0": "evt3"}
    said = fields.get("format", fields.get("evt", "")).partition(";")[0]
    encoding = names.get(said)
    if said and encoding is None:
        raise request.refusal(f"is encoded as {said!r}; EVT2, EVT21 and EVT3 are read: convert it")
    if encoding and format and format != encoding:
        raise request.refusal(f"says {encoding} and the caller says {format}; leave format out")
    if not (encoding or format):
        raise request.refusal("names no encoding; give format='evt2', 'evt21', 'evt3' or 'dat'")
    return encoding or str(format)


def _geometry(fields: dict[str, str], options: dict[str, str]) -> tuple[int | None, int | None]:
    """Width and height of the sensor as far as the header knows them."""
    if "width" in options and "height" in options:
        return _number(options["width"]), _number(options["height"])
    width, _, height = fields.get("geometry", "").partition("x")
    if _number(width) and _number(height):
        return _number(width), _number(height)
    plugin = fields.get("plugin_name", "")
    for name, sensor_width, sensor_height in SENSORS:
        if name in plugin:
            return sensor_width, sensor_height
    return None, None


def _number(text: str | None) -> int | None:
    """A size of a sensor in decimal digits, or None."""
    return int(text) if text and text.isascii() and text.isdigit() and 0 < len(text) < 6 else None


def _words(request: Request, start: int, word: np.dtype) -> np.ndarray:
    """The body as an array of words."""
    size = request.path.stat().st_size - start
    if size % word.itemsize:
        raise request.refusal(
            f"is truncated: {size} bytes after the header are no whole number of {word.itemsize}-byte words; "
            f"copy it again, or cut its last {size % word.itemsize} bytes"
        )
    return np.fromfile(request.path, word, offset=start)


def _decoded(
    request: Request, decode: Callable[..., tuple[int, int, int, int]], *words: np.ndarray
) -> tuple[np.ndarray, int, int]:
    """Events, the number of entries skipped and the number of stray times."""
    count, skipped, strays, bad = decode(*words, np.empty(0, EVENT))
    events = np.empty(request.check_count(count), EVENT)
    if bad < 0:
        _, _, strays, bad = decode(*words, events)
    if bad >= 0:
        raise request.refusal(
            f"word {bad} is of no type that this encoding has, or lies beyond its {COLUMNS} columns; "
            "the file is damaged or of another encoding"
        )
    return events, skipped, strays
