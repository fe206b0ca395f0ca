import numpy as np
import pytest

from envs.recordings import read_events
from jobs.config.config import ConfigError, parse
from jobs.tools import video_events
from tests.support.configs import compose
from tests.support.image_folders import quietly, random_frames, save

SMALL = ("camera.width=16", "camera.height=12")


def converted(tmp_path, *words):
    config = parse(compose("+exp=video_events", f"runs_dir={tmp_path / 'runs'}", *SMALL, *words))
    return config, video_events.run(config)


@pytest.fixture
def folder(tmp_path):
    return save(tmp_path / "images", random_frames(), ".png")


def test_the_file_has_the_events_and_labels_that_the_camera_of_the_command_line_gives(tmp_path, folder):
    words = "camera=dvs128", *SMALL, "light=night", "seed=5", "video_events.fps=50"
    config, path = converted(tmp_path, *words, f"video_events.path={folder}")
    assert path.name == "events.npz"
    assert config.env.faults.shot_noise_hz > 0
    camera, faults, rng = config.env.camera, config.env.faults, np.random.default_rng(config.seed)
    expected = quietly(folder, camera, faults, fps=50.0, rng=rng)
    written = read_events(path)
    assert expected.events.size > 1000
    assert expected.is_noise.any()
    assert (written.width, written.height) == (16, 12)
    assert written.events.tobytes() == expected.events.tobytes()
    assert written.is_noise.tobytes() == expected.is_noise.tobytes()


def test_a_format_without_labels_is_written_and_the_job_says_so(tmp_path, folder, capsys):
    output = tmp_path / "made" / "ride.aedat4"
    words = "video_events.fps=50", f"video_events.path={folder}", f"video_events.output={output}"
    config, path = converted(tmp_path, *words)
    assert "npz" in capsys.readouterr().out
    written = read_events(path)
    assert written.events.tobytes() == quietly(folder, config.env.camera, fps=50.0).events.tobytes()
    assert written.is_noise is None


def test_a_grey_step_in_black_fires_no_event_unless_the_floor_of_the_video_is_low(tmp_path):
    """Frames of 8 bits that are linear in light, where grey 1 may be noise."""
    black = np.zeros((2, 12, 16, 3), np.uint8)
    black[1] = 1
    words = "video_events.fps=50", "video_events.transfer=linear"
    path = f"video_events.path={save(tmp_path / 'black', black, '.png')}"
    for floor, fired in (
        ("camera.luminance_floor=1e-4", 0),
        ("video_events.luminance_floor=1e-3", 7 * 12 * 16),
    ):
        output = f"video_events.output={tmp_path / f'{fired}.npz'}"
        assert read_events(converted(tmp_path, *words, path, floor, output)[1]).events.size == fired


@pytest.mark.parametrize(
    ("words", "key"),
    [
        (("video_events.output=ride.mp4",), "video_events.output"),
        (("video_events.path=nowhere.mp4",), "video_events.path"),
        ((), "video_events.path"),  # the folder has no times, and no fps is given
    ],
)
def test_what_cannot_be_read_or_written_is_refused_with_its_key_and_leaves_no_file(
    tmp_path, folder, words, key
):
    with pytest.raises(ConfigError, match=f"^{key}: "):
        converted(tmp_path, f"video_events.path={folder}", *words)
    assert not list(tmp_path.rglob("*.npz"))
