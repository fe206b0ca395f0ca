"""Read AEDAT 2.0, jAER's files, as described in "AEDAT file formats" (inivation.github.io)."""

from collections.abc import Iterator

import numpy as np

from envs.recordings.clocks import unwrap
from envs.recordings.event_file import TRIGGER, Opened, Part, Request, assemble, whole_entries
from envs.recordings.mapped import mapped_parts

MAGIC_2 = b"#!AER-DAT2"
MAX_HEADER_BYTES = 1 << 20
ENTRY = np.dtype([("address", ">u4"), ("t", ">u4")])
CONTROL = bytes(set(range(32)) - {9, 10, 13}) + b"\x7f"  # bytes that no line of text has

DVS128_SIZE = (128, 128)
DAVIS_SIZES = {"DAVIS240": (240, 180), "DAVIS346": (346, 260), "DAVIS640": (640, 480), "DAVIS128": (128, 128)}
DVS128_SPECIAL = 0x8000  # an external event
DAVIS_SPECIAL = 0x80000400  # a sample of a frame or the inertial sensor (bit 31), an external event (bit 10)


def read_aedat2(request: Request) -> Opened:
    """Open an AEDAT 2.0 file of a DVS128 or of a DAVIS.

    The header (`AEChip`) determines the camera, else the size that the caller gives, else it is a DVS128
    if all addresses fit into 16 bits. jAER counts rows from below and mirrors columns; here x points
    right and y down. The 32-bit clock is unwrapped.

    Raises:
        ValueError: The camera is unknown.
    """
    start, chip = _header(request)
    count = request.check_declared(whole_entries(request, start, ENTRY.itemsize))
    width, height, is_davis = _camera(request, chip, start, count)
    request = request.sized(width, height)
    return Opened("aedat2", request, _parts(request, start, count, is_davis))


def _parts(request: Request, start: int, count: int, is_davis: bool) -> Iterator[Part]:
    """Yield the events of the 8-byte entries."""
    last_us, width, height = -1, request.width or 0, request.height or 0
    for body in mapped_parts(request, start, ENTRY, count):
        address, t_us = body["address"].astype(np.uint32), unwrap(body["t"].astype(np.uint32), 32, last_us)
        last_us = int(t_us[-1])
        is_event = address & (DAVIS_SPECIAL if is_davis else DVS128_SPECIAL) == 0
        external = address & DAVIS_SPECIAL == 0x400 if is_davis else ~is_event
        triggers = np.zeros(np.count_nonzero(external), TRIGGER)
        triggers["t"] = t_us[external]
        request.tally.skipped += int(np.count_nonzero(~is_event))
        address, t_us = address[is_event], t_us[is_event]
        if is_davis:
            x, y, p = address >> 12 & 1023, address >> 22 & 511, address >> 11 & 1
        else:
            x, y, p = address >> 1 & 127, address >> 8 & 127, 1 - (address & 1)
        x, y = (width - 1 - x.astype(np.int64)) & 0xFFFF, (height - 1 - y.astype(np.int64)) & 0xFFFF
        yield assemble(request, t_us, x, y, p, triggers=triggers)


def _header(request: Request) -> tuple[int, str]:
    """Return the position of the first entry, and the name of the camera's chip or an empty string.

    Header lines are text, so an entry whose first byte happens to be `#` is not taken for one.
    """
    with request.path.open("rb") as file:
        head = file.read(MAX_HEADER_BYTES)
    start, chip = 0, ""
    while head.startswith(b"#", start):
        end = head.find(b"\n", start)
        line = head[start:end]
        if start and (end < 0 or line.translate(None, CONTROL) != line):
            break
        if end < 0:
            raise request.refusal(
                "has a header without end; it is no AEDAT 2.0 file, or damaged: give its format"
            )
        start = end + 1
        if line.startswith(b"# AEChip:"):
            chip = line.partition(b":")[2].strip().decode("latin-1")
        if line.startswith(b"#End Of ASCII Header"):
            break
    return start, chip


def _camera(request: Request, chip: str, start: int, count: int) -> tuple[int | None, int | None, bool]:
    """Return width, height and whether the camera is a DAVIS."""
    for name, size in DAVIS_SIZES.items():
        if name in chip.upper():
            return *size, True
    given = (request.width, request.height)
    if chip.endswith("DVS128") or given == DVS128_SIZE:
        return *DVS128_SIZE, False
    if not chip and given in DAVIS_SIZES.values():
        return *given, True
    is_wide = not chip and any(
        part["address"].max() >= 1 << 16 for part in mapped_parts(request, start, ENTRY, count)
    )
    if chip or given != (None, None) or is_wide:
        sizes = ", ".join(f"{width}x{height}" for width, height in DAVIS_SIZES.values())
        remedy = (
            "write it again with jAER as one of these cameras" if chip else "give width and height of one"
        )
        raise request.refusal(f"is of {chip or 'an unknown camera'}, no DVS128 or DAVIS ({sizes}); {remedy}")
    return *DVS128_SIZE, False
