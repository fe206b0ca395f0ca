"""Decode pictures of a video file or of image files with the ffmpeg program that imageio-ffmpeg includes.

ffmpeg runs in its own process, so that a damaged file cannot crash the interpreter, and only one picture is
in memory at a time. 8-bit pictures are returned with 8 bits, deeper ones with 16, floating point unchanged.
"""

import queue
import re
import subprocess
import tempfile
import threading
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import IO, NamedTuple

import imageio_ffmpeg
import numpy as np

# Containers of one video. Playlists are excluded, because they can name other files.
CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,ogg,flv,nut,gif"
MAX_PIXELS = 1 << 26
FRAME_TIMEOUT_S = 60.0
FRAME_LINE = re.compile(
    r"\[Parsed_showinfo\S* @ \w+\] n:\s*\d+ pts:\s*(\S+) .*? fmt:(\w+) .*? s:(\d+)x(\d+) "
)
TIME_BASE_LINE = re.compile(r"\[Parsed_showinfo\S* @ \w+\] config in time_base: (\d+)/(\d+)")
DAMAGE_LINE = re.compile(r"\[.*(error|corrupt|mismatch|invalid|ended prematurely)", re.IGNORECASE)


class Layout(NamedTuple):
    """Memory layout of a picture in one of ffmpeg's pixel formats.

    Attributes:
        dtype: Type of a value.
        channels: Names of the channels in their order; "y" is grey and "a" opacity.
        is_planar: Whether each channel is stored as a separate plane.
    """

    dtype: np.dtype
    channels: str
    is_planar: bool


# Formats that ffmpeg may output; it chooses the one that loses nothing. Floating point is never converted,
# since that would clip it to [0, 1].
LAYOUTS = {
    "rgb24": Layout(np.dtype(np.uint8), "rgb", False),
    "rgba": Layout(np.dtype(np.uint8), "rgba", False),
    "rgb48le": Layout(np.dtype("<u2"), "rgb", False),
    "rgba64le": Layout(np.dtype("<u2"), "rgba", False),
} | {
    name + suffix: Layout(np.dtype(dtype), channels, name.startswith("gbr"))
    for suffix, dtype in (("f32le", "<f4"), ("f16le", "<f2"))
    for name, channels in (
        *(("gbrp", "gbr"), ("gbrap", "gbra"), ("rgb", "rgb"), ("rgba", "rgba")),
        *(("gray", "y"), ("ya", "ya")),
    )
}


class Picture(NamedTuple):
    """One decoded picture.

    Attributes:
        t_us: Its time in the file, minus the start time of the file [us].
        values: (H, W, 3) of R, G and B, or (H, W) of grey; uint8, uint16 or float32.
    """

    t_us: int
    values: np.ndarray


def decoded_video(path: Path) -> Iterator[Picture]:
    """Yield the pictures of a video file, in order.

    Raises:
        ValueError: The file is no video, is damaged, or has a frame without time or above 2**26 pixels.
    """
    options = ["-format_whitelist", CONTAINERS, "-i", f"file:{path.resolve()}"]
    return _decoded(path, options, None)


def decoded_images(paths: Sequence[Path]) -> Iterator[Picture]:
    """Yield the pictures of image files, in order, with times as at 25 pictures per second.

    ffmpeg reads them as one stream, through numbered links.

    Raises:
        ValueError: A file is no image of the type that its suffix names, is damaged, or above 2**26 pixels,
            or the images differ in type or size.
    """
    kinds = sorted({path.suffix.lower() for path in paths})
    if len(kinds) != 1:
        raise ValueError(f"{paths[0].parent}: images must be of one kind, got {' '.join(kinds)}; convert one")
    with tempfile.TemporaryDirectory() as folder:
        for number, path in enumerate(paths):
            (Path(folder) / f"{number}{kinds[0]}").symlink_to(path.resolve())
        options = ["-format_whitelist", "image2", "-f", "image2", "-start_number", "0", "-i", f"%d{kinds[0]}"]
        count = 0
        for picture in _decoded(paths[0].parent, options, folder):
            yield picture
            count += 1
        if count != len(paths):
            raise ValueError(f"{paths[count]}: is no image that can be read; copy or convert it again")


def _decoded(path: Path, options: list[str], folder: str | None) -> Iterator[Picture]:
    """Yield the pictures that ffmpeg decodes: one pipe carries the pictures, the other a line for each."""
    # fmt: off
    command = [
        imageio_ffmpeg.get_ffmpeg_exe(), "-nostdin", "-nostats", "-hide_banner", "-threads", "1", "-xerror",
        "-protocol_whitelist", "file", "-max_pixels", str(MAX_PIXELS), *options,
        "-map", "0:v:0", "-fps_mode", "passthrough",
        "-vf", f"format={'|'.join(LAYOUTS)},showinfo=checksum=0", "-f", "rawvideo", "pipe:1",
    ]
    # fmt: on
    with subprocess.Popen(  # noqa: S603  no shell, and every path is a plain file's
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=folder
    ) as program:
        assert program.stdout is not None  # noqa: S101  it is a pipe; for the type checker
        assert program.stderr is not None  # noqa: S101  the same
        lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        thread = threading.Thread(target=_read_lines, args=(program.stderr, lines), daemon=True)
        thread.start()
        try:
            yield from _paired(path, program.stdout, lines)
            if program.wait(FRAME_TIMEOUT_S) != 0:
                raise ValueError(f"{path}: is damaged or truncated; copy or encode it again")
        finally:
            program.kill()  # it has already ended unless the caller stops early
            thread.join()


def _read_lines(pipe: IO[bytes], lines: queue.SimpleQueue) -> None:
    """Put the lines that ffmpeg prints into a queue, and None at the end."""
    is_begun = False
    while line := pipe.readline(1 << 16):
        if not is_begun:  # the rest of a long line could look like any other
            lines.put(line.decode("latin-1").rstrip())
        is_begun = not line.endswith(b"\n")
    lines.put(None)


def _paired(path: Path, pictures: IO[bytes], lines: queue.SimpleQueue) -> Iterator[Picture]:
    """Combine the pictures and the printed lines of ffmpeg's two pipes."""
    second: Fraction | None = None
    first: tuple[str, ...] | None = None
    said = ""
    while (line := _next_line(path, lines)) is not None:
        base = TIME_BASE_LINE.match(line)
        frame = FRAME_LINE.match(line)
        if base:
            second = Fraction(int(base[1]), int(base[2]) or 1)
        elif frame:
            first = first or frame.groups()[1:]
            if frame.groups()[1:] != first:
                raise ValueError(f"{path}: its frames change their size or depth; convert them to one")
            yield Picture(_time_us(path, frame[1], second), _picture(path, pictures, *first))
        elif DAMAGE_LINE.match(line):
            said = said or line
    if first is None:
        raise ValueError(
            f"{path}: is no video that can be read ({said or 'no frames'}); encode it again as mp4, "
            "or as images that are named in docs/recordings.md"
        )
    if said:
        raise ValueError(f"{path}: is damaged or truncated ({said}); copy or encode it again")


def _next_line(path: Path, lines: queue.SimpleQueue[str | None]) -> str | None:
    """Return the next line that ffmpeg prints."""
    try:
        return lines.get(timeout=FRAME_TIMEOUT_S)
    except queue.Empty:
        raise ValueError(f"{path}: no frame came in {FRAME_TIMEOUT_S:.0f} s; encode it again") from None


def _time_us(path: Path, ticks: str, second: Fraction | None) -> int:
    """Return a presentation time in whole microseconds."""
    if second is None or not re.fullmatch(r"-?\d+", ticks):
        raise ValueError(f"{path}: a frame has no time; encode it again at a constant frame rate")
    return round(int(ticks) * second * 1_000_000)


def _picture(path: Path, pictures: IO[bytes], name: str, width: str, height: str) -> np.ndarray:
    """Return the next picture in the form of `Picture.values`."""
    layout, shape = LAYOUTS[name], (int(height), int(width))
    size = shape[0] * shape[1] * len(layout.channels) * layout.dtype.itemsize
    raw = pictures.read(size)
    if len(raw) != size:
        raise ValueError(f"{path}: its last frame is not whole; encode it again")
    values = np.frombuffer(raw, layout.dtype)
    if layout.is_planar:
        values = values.reshape(len(layout.channels), *shape).transpose(1, 2, 0)
    else:
        values = values.reshape(*shape, len(layout.channels))
    if layout.channels[0] == "y":
        values = values[..., 0]
    elif layout.channels != "rgb":
        values = values[..., [layout.channels.index(name) for name in "rgb"]]
    return values.astype(np.float32) if layout.dtype.kind == "f" else values
