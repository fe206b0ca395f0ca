import imageio_ffmpeg
import numpy as np
import pytest

from envs.events import EVENT
from jobs.analysis.video import coloured, last_polarity, open_film

EVENTS = np.array([(1, 2, 0, -1), (2, 2, 0, 1), (3, 3, 1, -1)], EVENT)


def show(film, steps):
    for _ in range(steps):
        film.step(np.ones((6, 7), np.float32), EVENTS, np.zeros((1, 4), np.int32), "caption")


@pytest.mark.parametrize(("steps", "expected"), [(12, 3), (13, 4), (1, 1)])
def test_a_film_has_a_frame_for_each_fiftieth_of_a_second_and_the_last_step_and_even_sizes(
    tmp_path, steps, expected
):
    with open_film(tmp_path / "a" / "film.mp4", 200.0, None) as film:
        show(film, steps)
    frames = imageio_ffmpeg.read_frames(str(tmp_path / "a" / "film.mp4"))
    about = next(frames)
    assert (about["fps"], about["duration"]) == (25.0, pytest.approx(expected / 25.0))
    assert len(list(frames)) == expected
    assert [side % 2 for side in about["source_size"]] == [0, 0]


def test_an_error_leaves_no_film(tmp_path):
    with pytest.raises(TypeError), open_film(tmp_path / "film.mp4", 50.0, None) as film:
        film.step(None, EVENTS, None, "caption")
    assert not list(tmp_path.iterdir())


def test_the_last_event_of_a_pixel_gives_its_colour():
    image = last_polarity(EVENTS, (6, 7))
    assert (image[0, 2], image[1, 3], np.abs(image).sum()) == (1, -1, 2)
    off, none, on = coloured(np.array([[-1.0, 0.0, 1.0]]))[0].astype(int)
    assert off[0] > off[2]
    assert on[2] > on[0]
    assert none.max() < 50
