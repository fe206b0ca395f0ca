"""Write events as Prophesee's DAT, EVT 2.0 and EVT 3.0, in parts."""

import contextlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np

from core.files import replaced
from envs.recordings.prophesee import DAT_WORD
from envs.recordings.writing import Append, chunks

# Clock bits and coordinate bits, and so the first time that does not fit.
LIMITS = {"dat": (32, 14), "evt2": (34, 11), "evt3": (24, 11)}
MAX_WORDS = 1 << 26  # of a part: a gap of 76 hours in EVT 3.0


def dat_writer(path: Path, width: int, height: int) -> AbstractContextManager[Append]:
    """Yield a function that adds events to a DAT file.

    Raises:
        ValueError: The format's clock or address cannot represent them.
    """
    lines = f"% Data file containing CD events\n% Version 2\n% Width {width}\n% Height {height}\n"
    return _writer(path, width, height, "dat", lines.encode() + bytes((0x0C, 8)), _dat_words)


def evt2_writer(path: Path, width: int, height: int) -> AbstractContextManager[Append]:
    """Yield a function that adds events to a RAW file of EVT 2.0; raises as `dat_writer`."""
    return _writer(path, width, height, "evt2", _evt_header("2.0", width, height), _Evt2())


def evt3_writer(path: Path, width: int, height: int) -> AbstractContextManager[Append]:
    """Yield a function that adds events to a RAW file of EVT 3.0; raises as `dat_writer`."""
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
    """Yield a function that adds the words of events behind a header."""
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
    """Refuse times that the clock cannot represent: EVT 3.0 counts its turns, but has none for the first."""
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
    """Return entries of DAT."""
    words = np.empty(len(events), DAT_WORD)
    words["t"] = events["t"]
    words["data"] = (
        events["x"] | events["y"].astype(np.uint32) << 14 | (events["p"] > 0).astype(np.uint32) << 28
    )
    return words


class _Evt2:
    """Words of EVT 2.0: a high part of the time wherever it changes, then the event."""

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
    """Words of EVT 3.0 without vectors, with every high part of the time, as a camera sends them."""

    def __init__(self, path: Path) -> None:
        self._path, self._high, self._low, self._y = path, -1, -1, -1

    def __call__(self, events: np.ndarray) -> np.ndarray:
        """Return the words of the next events, uint16."""
        high, low, y = events["t"] >> 12, events["t"] & 0xFFF, events["y"].astype(np.int64)
        before = self._high if self._high >= 0 else int(high[0]) - 1
        steps = np.diff(high, prepend=before)
        new_low = (steps > 0) | (np.diff(low, prepend=self._low) != 0)
        new_y = np.diff(y, prepend=self._y) != 0
        last = np.cumsum(steps + new_low + new_y + 1) - 1  # where the word with x of each event goes
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
