"""Folders of images with their times: the Event Camera Dataset's `images.txt`, or a frame rate."""

import math
import re
from decimal import Decimal, InvalidOperation
from fractions import Fraction
from pathlib import Path

from envs.recordings.event_file import check_file

LIST_NAME = "images.txt"
KINDS = (".bmp", ".exr", ".hdr", ".jpeg", ".jpg", ".pfm", ".pgm", ".png", ".ppm", ".tif", ".tiff")
MAX_IMAGES = 1_000_000
MAX_LIST_BYTES = 1 << 28


def find_images(folder: Path, fps: float | None, max_bytes: int) -> tuple[list[Path], list[int]]:
    """The images of a folder in the order of their times, and their times [us].

    With an `images.txt`, a line for each image, its time [s] and its path in the folder, they are those of
    the list; else all images of the folder, by their names, numbers in them by their value.

    Args:
        folder: The folder.
        fps: Images per second, in place of the times of a list.
        max_bytes: Most bytes of all images together.

    Raises:
        ValueError: There are no images, or no times; a line is not as above; an image is no regular file, or
            outside the folder.
    """
    listed = folder / LIST_NAME
    if listed.exists():
        names, times = _read_list(listed)
        _check_inside(folder, names)
        paths = [folder / name for name in names]
    else:
        kinds = (path for path in folder.iterdir() if path.suffix.lower() in KINDS)
        paths, times = sorted(kinds, key=_by_number), []
        if fps is None:
            raise ValueError(f"{folder}: has no {LIST_NAME} with lines 'time name'; write it, or give fps")
    if not 2 <= len(paths) <= MAX_IMAGES:
        raise ValueError(f"{folder}: has {len(paths)} images; give 2 to {MAX_IMAGES} of {', '.join(KINDS)}")
    left = max_bytes
    for path in paths:
        if path.suffix.lower() not in KINDS:
            raise ValueError(f"{path}: is no image of the kinds {', '.join(KINDS)}; convert it")
        left -= check_file(path, left)
    return paths, times if fps is None else [even_time_us(number, fps) for number in range(len(paths))]


def even_time_us(number: int, fps: float) -> int:
    """The time [us] of a frame by its number at a rate; frame 0 has 0."""
    return round(1_000_000 * number / Fraction(fps))


def check_fps(fps: float | None) -> None:
    """Raise ValueError for a rate at which frames are not a microsecond or more apart."""
    if fps is not None and not (math.isfinite(fps) and 0.0 < fps <= 1e6):
        raise ValueError(f"fps must lie in (0, 1e6], got {fps}")


def _read_list(path: Path) -> tuple[list[str], list[int]]:
    """Names and times [us] of an `images.txt`."""
    check_file(path, MAX_LIST_BYTES)
    names, times = [], []
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: is not UTF-8 text at byte {error.start}; write it again") from None
    for number, line in enumerate(lines, 1):
        words = line.split(maxsplit=1)
        if not words or line.startswith("#"):
            continue
        try:
            time_s = Decimal(words[0])
            if len(words) < 2 or not 0 <= time_s < 1 << 32:
                raise InvalidOperation
        except InvalidOperation:
            raise ValueError(
                f"{path}: line {number} must be a time from 0 to 2**32 s and a name, got {line[:80]!r}"
            ) from None
        times.append(round(time_s * 1_000_000))
        names.append(words[1].strip())
    return names, times


def _check_inside(folder: Path, names: list[str]) -> None:
    """Refuse images outside the folder: a list may come from elsewhere."""
    for name in names:
        if Path(name).is_absolute() or ".." in Path(name).parts:
            raise ValueError(f"{folder / LIST_NAME}: names {name!r}, which is not inside its folder; copy it")


def _by_number(path: Path) -> list[tuple[int, int, str]]:
    """A key that sorts names as people count: frame_2 before frame_10."""
    parts = re.findall(r"(\d+)|(\D+)", path.name)
    return [(0, int(digits), digits) if digits else (1, 0, text) for digits, text in parts]
