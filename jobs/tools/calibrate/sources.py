"""Read a recording and its frames from files."""

import dataclasses
import struct
from pathlib import Path

import numpy as np
from PIL import Image

from envs.recordings.beside import NoFramesError, has_frames
from envs.recordings.beside import read_frames as event_file_frames
from envs.recordings.event_file import EventFile
from envs.recordings.light import light_of_grey, luminance
from jobs.config.schema import RecordingConfig
from jobs.run.recordings import read_recording
from jobs.tools.calibrate.footage import Footage

MAX_PIXELS = 1 << 28  # of all frames together: 1 GiB
EIGHT_BITS = ("L", "LA", "P", "RGB", "RGBA")  # Pillow's modes with 8 bits a value
# Errors that Pillow raises for files that are damaged, or too large to decode.
BROKEN = (OSError, SyntaxError, ValueError, struct.error, Image.DecompressionBombError)


def read_frames(path: str | Path, delay_us: int) -> Footage:
    """Read frames listed in a text file, one line "seconds picture" each, as in Mueggler et al. (2017).

    Pictures have 8 bits and are decoded from sRGB, which fits the frames of a DAVIS best (docs/camera.md).

    Args:
        path: The text file; paths of pictures are relative to its folder.
        delay_us: Delay from the time of a frame to the middle of its exposure [us].

    Raises:
        ValueError: A line, a picture or a time is invalid, or there are fewer than two frames.
    """
    greys, times_us = read_greys(path), _frame_rows(Path(path))[0] + delay_us
    return Footage(light_of_grey("srgb")[greys], times_us)


def read_greys(path: str | Path) -> np.ndarray:
    """Read the pictures listed in a text file, uint8 (K, H, W); arguments and errors as in `read_frames`."""
    path, left, pictures = Path(path), MAX_PIXELS, []
    for name in _frame_rows(path)[1]:
        pictures.append(_picture(path.parent / name, left))
        left -= pictures[-1].size
    if len({picture.shape for picture in pictures}) > 1:
        raise ValueError(f"{path}: pictures must all have one size")
    return np.stack(pictures)


def _frame_rows(path: Path) -> tuple[np.ndarray, list[str]]:
    """Read the times [us], int64 (K,), and the names of the pictures."""
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


def _picture(path: Path, left: int) -> np.ndarray:
    """Read a picture of at most `left` pixels as grey values, uint8 (H, W)."""
    try:
        with Image.open(path) as picture:
            unfit = _unfit(picture, left)
            grey = np.empty(0, np.uint8) if unfit else np.asarray(picture.convert("L"))
    except BROKEN as error:
        raise ValueError(
            f"{path}: is no picture that can be read ({error}); save it again, as a PNG of 8 bits"
        ) from None
    if unfit:
        raise ValueError(f"{path}: {unfit}")
    return grey


def _unfit(picture: Image.Image, left: int) -> str:
    """Return why a picture is rejected by its header, before decoding; "" if it is valid."""
    if picture.mode not in EIGHT_BITS:
        return f"must have 8 bits a value, got mode {picture.mode}; convert it to a grey picture of 8 bits"
    width, height = picture.size
    if width * height > left:
        return (
            f"must leave all pictures at {MAX_PIXELS} pixels or fewer together, got {width}x{height} after "
            f"{MAX_PIXELS - left}; leave lines out"
        )
    return ""


def read_source(path: str | Path, frames: Footage | None, settings: RecordingConfig) -> EventFile:
    """Read the events of a file of any format; `recording.*` and the frames supply facts that it lacks.

    Raises:
        ValueError: The file is invalid, lacks its sensor's size if there are no frames, or has another size
            than the frames.
    """
    size = dict(zip(("height", "width"), frames.luminance.shape[1:], strict=True)) if frames else {}
    found = read_recording(path, settings)
    if frames is not None and (found.height, found.width) == (None, None):
        return read_recording(path, dataclasses.replace(settings, **size))  # raises for events outside
    if frames is None and None in (found.height, found.width):
        raise ValueError(f"{path}: does not say its sensor's size; give width and height")
    if frames is not None and (found.height, found.width) != frames.luminance.shape[1:]:
        shape = (found.height, found.width)
        raise ValueError(
            f"{path}: has {shape} pixels and its frames {frames.luminance.shape[1:]}; (H, W) must agree: "
            "give the frames of the same sensor"
        )
    return found


def frames_beside(path: str | Path, delay_us: int, settings: RecordingConfig) -> Footage | None:
    """Read the frames stored in the event file itself; None if it has fewer than two.

    Args:
        path: The event file, such as an AEDAT 4 file of a DAVIS.
        delay_us: As in `read_frames`, for files without exposure times.
        settings: Supplies the group and the span of time to read.

    Raises:
        ValueError: The frames are damaged, or have more than `MAX_PIXELS` pixels together.
    """
    if not has_frames(path):
        return None
    chosen = {"group": settings.group} if settings.group else {}
    found, left = [], MAX_PIXELS
    try:
        for frame in event_file_frames(path, **chosen):
            if not (settings.start_us or 0) <= frame.t_us < (settings.end_us or 1 << 62):
                continue
            left -= frame.values.shape[0] * frame.values.shape[1]
            if left < 0:
                raise ValueError(
                    f"{path}: has frames of more than {MAX_PIXELS} pixels together; give start_us and end_us"
                )
            found.append(frame)
    except NoFramesError:
        return None
    if len(found) < 2:
        return None
    light = np.stack([luminance(frame.values, "srgb") for frame in found])
    times_us = np.array([frame.t_us + (0 if frame.exposure_us else delay_us) for frame in found], np.int64)
    increases = np.concatenate(([True], np.diff(times_us) > 0))
    return Footage(light[increases], times_us[increases])
