"""Folders of images for tests of video and frames."""

import subprocess
import warnings
from pathlib import Path

import imageio_ffmpeg
import numpy as np

from envs.recordings import video_to_events

SHAPE = (12, 16)
PIXEL_FORMATS = {"u1": "rgb24", "u2": "rgb48le", "f4": "gbrpf32le"}


def save(folder: Path, frames: np.ndarray, suffix: str) -> Path:
    """(N, H, W, 3) of uint8, uint16 or float32 as images frame_0, frame_1 and so on, by ffmpeg."""
    folder.mkdir(exist_ok=True)
    kind, (rows, columns) = frames.dtype.str[1:], frames.shape[1:3]
    if kind == "f4":
        frames = frames[..., [1, 2, 0]].transpose(0, 3, 1, 2)  # planes of G, B and R
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-f", "rawvideo"]
    command += ["-pix_fmt", PIXEL_FORMATS[kind], "-s", f"{columns}x{rows}", "-i", "-", "-start_number", "0"]
    subprocess.run([*command, str(folder / f"frame_%d{suffix}")], input=frames.tobytes(), check=True)
    return folder


def random_frames(count: int = 6, dtype: type = np.uint8) -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.integers(0, np.iinfo(dtype).max, (count, *SHAPE, 3), dtype=dtype, endpoint=True)


def quietly(folder: Path, *arguments: object, **options: object):
    """The events of a folder whose frames are noise, so that they seem to be too few."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return video_to_events(folder, *arguments, **options)
