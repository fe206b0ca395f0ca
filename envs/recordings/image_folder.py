"""Find the images of a folder and their times, from the lists of known data sets or a frame rate."""

import math
import re
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

from envs.recordings.event_file import check_file

LIST_NAME = "images.txt"
KINDS = (".bmp", ".exr", ".hdr", ".jpeg", ".jpg", ".pfm", ".pgm", ".png", ".ppm", ".tif", ".tiff")
SUBFOLDERS = ("imgs", "images", "frames", "rgb")  # where images may be, if the folder has none
MAX_IMAGES = 1_000_000
MAX_LIST_BYTES = 1 << 28


class List(NamedTuple):
    """A text file with a line for each image.

    Attributes:
        name: Name of the file.
        users: Data set or program that writes it.
        columns: Columns of a line, "time" and "name"; without names, images are sorted by their numbers.
        unit_us: Unit of the times [us].
    """

    name: str
    users: str
    columns: tuple[str, ...]
    unit_us: Decimal


LISTS = (
    List(LIST_NAME, "Event Camera Dataset", ("time", "name"), Decimal(1_000_000)),
    List("images.csv", "ESIM", ("time", "name"), Decimal("0.001")),
    List("timestamps.txt", "vid2e", ("time",), Decimal(1_000_000)),
    List("info.txt", "DVS-Voltmeter", ("name", "time"), Decimal(1)),
    List("rgb.txt", "TUM RGB-D", ("time", "name"), Decimal(1_000_000)),
)
NUMBER = re.compile(r"\d+(\.\d*)?([eE][+-]?\d+)?")


def find_images(folder: Path, fps: float | None, max_bytes: int) -> tuple[list[Path], list[int]]:
    """Return the images of a folder in the order of their times, and their times [us].

    If the folder has a list (`LISTS`), these are the images of the list. Otherwise they are all images of the
    folder, or of a subfolder, sorted by name, with numbers in names sorted by value.

    Args:
        folder: The folder.
        fps: Images per second, replaces the times of a list.
        max_bytes: Maximum size of all images together [bytes].

    Raises:
        ValueError: There are no images or no times, a line of a list is invalid, or an image is no regular
            file or outside the folder.
    """
    known = next((one for one in LISTS if (folder / one.name).exists()), None)
    images, times = _read_list(folder / known.name, known) if known else ([], [])
    paths = images or _images(folder)
    if fps is None and not times:
        listed = ", ".join(f"{one.name} ({one.users})" for one in LISTS)
        raise ValueError(
            f"{folder}: has no list of times ({listed}); write {LIST_NAME} with lines 'time name', or give "
            "fps"
        )
    if not 2 <= len(paths) <= MAX_IMAGES:
        found = ", ".join(sorted(path.name for path in folder.iterdir())[:8]) or "nothing"
        raise ValueError(
            f"{folder}: has {len(paths)} images, and contains {found}; give 2 to {MAX_IMAGES} of "
            f"{', '.join(KINDS)}"
        )
    if fps is None and len(times) != len(paths):
        raise ValueError(
            f"{folder}: has {len(paths)} images and {len(times)} times; write one line an image, or give fps"
        )
    left = max_bytes
    for path in paths:
        if path.suffix.lower() not in KINDS:
            raise ValueError(f"{path}: is no image of the kinds {', '.join(KINDS)}; convert it")
        left -= check_file(path, left)
    return paths, times if fps is None else [even_time_us(number, fps) for number in range(len(paths))]


def _images(folder: Path) -> list[Path]:
    """Return the images of a folder, or of the first subfolder that has some."""
    for place in (folder, *(folder / name for name in SUBFOLDERS)):
        if place.is_dir():
            found = [path for path in place.iterdir() if path.suffix.lower() in KINDS]
            if found:
                return sorted(found, key=_by_number)
    return []


def even_time_us(number: int, fps: float) -> int:
    """Return the time [us] of frame `number` at a constant rate; frame 0 is at 0."""
    return round(1_000_000 * number / Fraction(fps))


def check_fps(fps: float | None) -> None:
    """Raise ValueError unless the rate is positive and frames are at least a microsecond apart."""
    if fps is not None and not (math.isfinite(fps) and 0.0 < fps <= 1e6):
        raise ValueError(f"fps must lie in (0, 1e6], got {fps}")


def _read_list(path: Path, known: List) -> tuple[list[Path], list[int]]:
    """Return the images and the times [us] of a list; no images if it names none."""
    check_file(path, MAX_LIST_BYTES)
    images, times = [], []
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: is not UTF-8 text at byte {error.start}; write it again") from None
    for number, line in enumerate(lines, 1):
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        name, time_us = _row(text, known)
        if time_us is None or (name is None and len(known.columns) > 1):
            raise ValueError(
                f"{path}: line {number} must be {' and '.join(known.columns)}, the time from 0 to 2**32 s, "
                f"got {line[:80]!r}; repair it, or give fps"
            )
        times.append(time_us)
        images += [] if name is None else [_inside(path, name)]
    return images, times


def _row(text: str, known: List) -> tuple[str | None, int | None]:
    """Return name and time [us] of a line."""
    mark = "," if known.name.endswith(".csv") else None
    words = text.rsplit(mark, 1) if known.columns[0] == "name" else text.split(mark, len(known.columns) - 1)
    words = [word.strip() for word in words]
    if len(words) != len(known.columns):
        return None, None
    facts = dict(zip(known.columns, words, strict=True))
    try:
        time_us = Decimal(facts["time"]) * known.unit_us if NUMBER.fullmatch(facts["time"]) else Decimal(-1)
    except ArithmeticError:
        time_us = Decimal(-1)
    return facts.get("name"), round(time_us) if 0 <= time_us < 1_000_000 << 32 else None


def _inside(listed: Path, name: str) -> Path:
    """Return the path of an image of a list, whose names are relative to the folder of the list.

    Raises:
        ValueError: The path is outside the folder; a list may come from an untrusted source.
    """
    path, folder = Path(name), listed.parent
    if path.is_absolute() and path.parent.name == folder.resolve().name:
        path = Path(path.name)  # as DVS-Voltmeter writes them; the folder may have moved
    if path.is_absolute() or ".." in path.parts:
        raise ValueError(f"{listed}: names {name!r}, which is not inside its folder; copy it there")
    return folder / path


def _by_number(path: Path) -> list[tuple[int, int, str]]:
    """Return a key for natural sorting of names: frame_2 before frame_10."""
    parts = re.findall(r"(\d+)|(\D+)", path.name)
    return [(0, int(digits), digits) if digits else (1, 0, text) for digits, text in parts]
