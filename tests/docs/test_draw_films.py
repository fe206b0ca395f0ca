"""A film is made small at the speed that its title names, and keeps its last frame."""

import subprocess

import imageio_ffmpeg
import numpy as np
import pytest

from docs.draw_films import SMALL


@pytest.mark.parametrize(("fps", "frames"), [(10, 21), (50, 108)])
def test_a_small_film_lasts_as_long_and_ends_as_its_source(tmp_path, fps, frames):
    grey = np.linspace(20, 235, frames).astype(np.uint8)
    source = imageio_ffmpeg.write_frames(str(tmp_path / "a.mp4"), (64, 64), fps=fps, macro_block_size=1)
    source.send(None)
    for value in grey:
        source.send(np.full((64, 64, 3), value, np.uint8).tobytes())
    source.close()
    ffmpeg = imageio_ffmpeg.get_ffmpeg_exe()
    words = [ffmpeg, "-v", "error", "-y", "-i", str(tmp_path / "a.mp4"), *SMALL, str(tmp_path / "b.mp4")]
    subprocess.run(words, check=True)
    reader = imageio_ffmpeg.read_frames(str(tmp_path / "b.mp4"))
    about = next(reader)
    shown = [np.frombuffer(frame, np.uint8).mean() for frame in reader]
    assert about["fps"] == 10
    assert frames / fps <= len(shown) / 10 <= frames / fps + 0.45
    assert abs(shown[-1] - grey[-1]) < 6
