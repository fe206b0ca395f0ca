"""A recording and the frames beside it, as files have them."""

import re
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from envs.recordings import read_events
from envs.recordings.event_file import EventFile
from envs.recordings.light import light_of_grey
from jobs.studies.calibrate.estimate import Footage

MAX_PIXELS = 1 << 28  # of all frames together: 1 GiB
BARE_ROW = re.compile(rb"\d+\.\d+\s+\d+\s+\d+\s+[01]\s*")  # of the data set of Mueggler et al. (IJRR 2017)


def read_frames(path: str | Path, delay_us: int) -> Footage:
    """Frames named by a text file with a line "seconds picture" each, as Mueggler et al. (2017) have them.

    Pictures have 8 bits and are decoded from sRGB, which fits the frames of a DAVIS best (docs/camera.md).

    Args:
        path: The text file; pictures are beside it.
        delay_us: From the time of a frame to the light that it shows, half of its exposure [us].

    Raises:
        ValueError: A line, a picture or a time is not as it should be, or there are fewer than two frames.
    """
    greys, times_us = read_greys(path), _frame_rows(Path(path))[0] + delay_us
    return Footage(light_of_grey("srgb")[greys], times_us)


def read_greys(path: str | Path) -> np.ndarray:
    """The pictures of such a text file, uint8 (K, H, W); raises as `read_frames`."""
    path = Path(path)
    pictures = [_picture(path.parent / name) for name in _frame_rows(path)[1]]
    if len({picture.shape for picture in pictures}) > 1:
        raise ValueError(f"{path}: pictures must all have one size")
    if sum(picture.size for picture in pictures) > MAX_PIXELS:
        raise ValueError(f"{path}: must have at most {MAX_PIXELS} pixels in all pictures; leave lines out")
    return np.stack(pictures)


def _frame_rows(path: Path) -> tuple[np.ndarray, list[str]]:
    """Times [us], int64 (K,), and names of the pictures."""
    rows = [line.split() for line in path.read_text().splitlines() if line.strip() and line[0] != "#"]
    if len(rows) < 2 or any(len(row) != 2 for row in rows):
        raise ValueError(f'{path}: must have a line "seconds picture" for each of two frames or more')
    try:
        times_us = np.array([round(1e6 * float(row[0])) for row in rows], np.int64)
    except (ValueError, OverflowError):
        raise ValueError(f'{path}: must have a line "seconds picture" for each frame') from None
    if not (np.diff(times_us) > 0).all():
        raise ValueError(f"{path}: times must increase from line to line")
    return times_us, [row[1] for row in rows]


def _picture(path: Path) -> np.ndarray:
    """Greys of a picture, uint8 (H, W)."""
    try:
        with Image.open(path) as picture:
            return np.asarray(picture.convert("L"))
    except (OSError, UnidentifiedImageError) as error:
        raise ValueError(f"{path}: is no picture that can be read ({error})") from None


def read_recording(path: str | Path, frames: Footage | None) -> EventFile:
    """The events of any format of `envs.recordings`; a text of bare rows is read as "seconds x y polarity".

    Raises:
        ValueError: The file is refused, does not say its sensor's size where there are no frames, or has
            another than these.
    """
    with Path(path).open("rb") as file:
        bare = BARE_ROW.match(file.read(100)) is not None
    size = dict(zip(("height", "width"), frames.luminance.shape[1:], strict=True)) if frames else {}
    if bare:
        return read_events(path, "txt", columns=("t", "x", "y", "p"), time_unit="s", **size)
    found = read_events(path)
    shape = (found.height, found.width) if None not in (found.height, found.width) else None
    if frames is None and shape is None:
        raise ValueError(
            f"{path}: does not say its sensor's size; write it with envs.recordings.write_events"
        )
    if frames is not None and shape not in (None, frames.luminance.shape[1:]):
        raise ValueError(
            f"{path}: has {shape} pixels and its frames {frames.luminance.shape[1:]}; (H, W) must agree"
        )
    return found
