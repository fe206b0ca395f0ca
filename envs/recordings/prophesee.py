"""Read files of Prophesee cameras: DAT, and RAW with the encodings EVT 2.0, EVT 2.1 and EVT 3.0.

Both begin with lines `% name value`, and the names tell them apart. From the published descriptions
(docs.prophesee.ai: "DAT File Format", "EVT 2.0 Format", "EVT 2.1 Format", "EVT 3.0 Format").
"""

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from envs.events import EVENT
from envs.recordings.event_file import OUTSIDE, RESERVED, TRIGGER, Opened, Part, Request, whole_entries
from envs.recordings.evt_decoders import State, decode_dat, decode_evt2, decode_evt3, new_state
from envs.recordings.mapped import Mapped, mapped_parts

MAX_HEADER_BYTES = 1 << 16
DAT_WORD = np.dtype([("t", "<u4"), ("data", "<u4")])
DAT_CD_TYPES = (0x00, 0x0C)  # Event2d, EventCD
FEW_RESERVED = 16  # words of types that do not exist; more than an eighth of all words is another encoding
MAX_TRIGGERS = 1 << 16  # of a part
NAMES = {"EVT2": "evt2", "2.0": "evt2", "EVT21": "evt21", "2.1": "evt21", "EVT3": "evt3", "3.0": "evt3"}

# Sensors by the name of the camera plug-in, for files that state no geometry.
SENSORS = (("genx320", 320, 320), ("imx636", 1280, 720), ("gen4", 1280, 720), ("gen3", 640, 480))


def read_dat(request: Request) -> Opened:
    """Open a DAT file, version 2. The 32-bit clock of 71.6 minutes is unwrapped.

    Raises:
        ValueError: Another version or event type.
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
    """Open a RAW file of EVT 2.0, 2.1 or 3.0, as its header says, else as the caller says.

    Triggers are read; padding is passed over and counted. A header with a version and without an
    encoding is that of a DAT file, in whatever order its lines are.

    Raises:
        ValueError: No known encoding, or words that the encoding does not have.
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
    word = np.dtype({"evt3": "<u2", "evt2": "<u4", "evt21": "<u8"}[encoding])
    count = whole_entries(request, start, word.itemsize)
    mapped = Mapped(request, start, word, count)
    parts = evt_parts(request, encoding, mapped.values, endianness, mapped.forget)
    return Opened(encoding, request, parts)


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
        states: State by encoding, of the words before these; it is moved on. None: nothing was before.
    """
    states = {} if states is None else states
    state = states.setdefault(encoding, new_state())
    state[State.WORD], before = 0, state.copy()
    decode = decoder(encoding, words, endianness)
    # About as many as such words usually encode; denser ones take several arrays.
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

    It returns how many there are of each, as the functions of `evt_decoders`.
    """
    if encoding == "evt3":
        return partial(decode_evt3, words)
    if encoding == "evt2":
        return partial(decode_evt2, words, np.empty(0, "<u4"))
    pairs = words.view("<u4").reshape(-1, 2)
    upper = 0 if endianness == "legacy" else 1  # IMX636 sends the upper half first
    return partial(decode_evt2, pairs[:, upper], pairs[:, 1 - upper])


def _count(request: Request, state: np.ndarray, before: np.ndarray, events: int) -> None:
    """Add to the tally what a decoder counted since `before`, and refuse words of another encoding.

    Raises:
        ValueError: More than an eighth of the words are of types that the encoding does not have, or more
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
    """Return the fields of the text lines at the beginning, and the place of the first word."""
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
    """Return the encoding by the header, else by the caller."""
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
    """Return width and height of the sensor as far as the header knows them."""
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
    """Return a size of a sensor in decimal digits, or None."""
    return int(text) if text and text.isascii() and text.isdigit() and 0 < len(text) < 6 else None
