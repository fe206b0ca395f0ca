import os
import subprocess
import threading
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest

from envs.config import CameraConfig
from envs.events import EventCamera
from envs.recordings import video_to_events
from envs.recordings.light import area_average
from envs.recordings.video import video_steps

DATA = Path(os.environ.get("EVADE_DATA", Path(__file__).resolve().parents[4] / "shared" / "data"))
VIDEOS = DATA / "videos"
needs_videos = pytest.mark.skipif(not VIDEOS.is_dir(), reason=f"no {VIDEOS}; set EVADE_DATA")
FFMPEG = imageio_ffmpeg.get_ffmpeg_exe()
pytestmark = pytest.mark.filterwarnings("ignore:.*events are missing:UserWarning")  # most frames are noise


def encode(path: Path, frames: np.ndarray, *options: str, fps: str = "25") -> Path:
    """A video without loss, from uint8 (N, H, W, 3)."""
    rows, columns = frames.shape[1:3]
    command = [FFMPEG, "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24", "-r", fps]
    command += ["-s", f"{columns}x{rows}", "-i", "-", "-c:v", "ffv1", "-pix_fmt", "bgr0", *options, str(path)]
    subprocess.run(command, input=frames.tobytes(), check=True)
    return path


def some_frames(count: int = 8, rows: int = 12, columns: int = 16) -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.integers(0, 256, (count, rows, columns, 3), dtype=np.uint8)


def retimed(milliseconds: str) -> list[str]:
    """Options that give frame N its own time."""
    clock = ["-enc_time_base", "1/1000", "-fps_mode", "passthrough"]
    return ["-vf", f"settb=1/1000,setpts={milliseconds}", *clock]


def light(frames: np.ndarray) -> np.ndarray:
    """Luminance by IEC 61966-2-1, in float64, written out anew."""
    value = frames / 255.0
    linear = np.where(value > 0.04045, ((value + 0.055) / 1.055) ** 2.4, value / 12.92)
    return 0.2126 * linear[..., 0] + 0.7152 * linear[..., 1] + 0.0722 * linear[..., 2]


def test_the_events_are_those_of_a_camera_that_sees_the_frames_in_linear_light(tmp_path):
    frames = some_frames()
    camera = CameraConfig(width=16, height=12, contrast_threshold=0.3)
    steps = list(video_steps(encode(tmp_path / "a.mkv", frames), camera))
    expected = EventCamera(camera)
    expected.reset(light(frames[0]).astype(np.float32), 0)
    assert len(steps) == 7
    for number, step in enumerate(steps, start=1):
        events = expected.step(light(frames[number]).astype(np.float32), 40_000 * number)
        assert step.t_us == 40_000 * number
        assert abs(len(step.events) - len(events)) <= 2  # a rounding of float32 may move one event
        assert step.events["t"].min() > step.t_us - 40_000
        assert step.events["t"].max() <= step.t_us
    file = video_to_events(tmp_path / "a.mkv")  # without a camera the sensor has the size of the video
    assert (file.width, file.height, file.format, file.dropped) == (16, 12, "video", 0)
    assert (file.events["x"].max(), file.events["y"].max()) == (15, 11)
    assert np.all(np.diff(file.events["t"]) >= 0)


def test_grey_is_read_exactly_and_linear_light_can_be_asked_for(tmp_path):
    frames = np.repeat(some_frames()[..., :1], 3, axis=3)
    frames[:] = np.maximum(frames, 30)
    path = encode(tmp_path / "a.mkv", frames)
    camera = CameraConfig(width=16, height=12)
    found = video_to_events(path, camera, transfer="linear")
    expected = EventCamera(camera, luminance_floor=10 / 255)
    grey = (frames[..., 0] / 255.0).astype(np.float32)
    expected.reset(grey[0], 0)
    count = sum(len(expected.step(picture, 40_000 * (n + 1))) for n, picture in enumerate(grey[1:]))
    assert abs(len(found.events) - count) <= 2
    assert len(video_to_events(path, camera).events) > 1.5 * count  # sRGB has more contrast
    with pytest.raises(ValueError, match="transfer must be"):
        video_to_events(path, camera, transfer="rec2020")


def test_times_are_those_of_the_video_less_the_time_at_which_it_begins(tmp_path):
    """Also when frames are not evenly spaced; `fps` takes their place."""
    uneven = encode(tmp_path / "a.mkv", some_frames(6), *retimed("N*N*10"))
    assert [step.t_us for step in video_steps(uneven)] == [10_000 * n * n for n in range(1, 6)]
    assert [step.t_us for step in video_steps(uneven, fps=1000.0)] == [1000 * n for n in range(1, 6)]
    broadcast = encode(tmp_path / "b.avi", some_frames(31), fps="30000/1001")
    assert [step.t_us for step in video_steps(broadcast)] == [round(n * 1_001_000 / 30) for n in range(1, 31)]
    late = encode(tmp_path / "late.mkv", some_frames(4), "-output_ts_offset", "5")
    assert [step.t_us for step in video_steps(late)] == [40_000, 80_000, 120_000]


def test_a_larger_video_is_averaged_in_linear_light(tmp_path):
    """Black and white in turn, in every larger pixel alike: nothing moves in the mean."""
    board = (np.indices((12, 16)).sum(axis=0) % 2 * 255).astype(np.uint8)
    frames = np.stack([board, 255 - board, board])[..., None].repeat(3, axis=3)
    path = encode(tmp_path / "a.mkv", frames)
    assert len(video_to_events(path).events) > 12 * 16
    assert len(video_to_events(path, CameraConfig(width=4, height=3)).events) == 0


def test_events_that_the_camera_drops_are_counted(tmp_path):
    path = encode(tmp_path / "a.mkv", some_frames())
    camera = CameraConfig(width=16, height=12, max_events_per_pixel=1)
    every, kept = video_to_events(path), video_to_events(path, camera)
    assert len(kept.events) + kept.dropped == len(every.events)
    assert kept.dropped > 0


def test_a_stream_that_is_left_early_leaves_nothing_running(tmp_path):
    running = set(threading.enumerate())
    path = encode(tmp_path / "a.mkv", some_frames(100, 120, 160))
    steps = video_steps(path)
    assert next(steps).t_us == 40_000
    assert len(set(threading.enumerate()) - running) == 1
    steps.close()
    assert set(threading.enumerate()) <= running
    with pytest.raises(ValueError, match="more than max_events=10 events"):
        video_to_events(path, max_events=10)
    assert set(threading.enumerate()) <= running


@needs_videos
def test_a_real_video_has_its_published_frames_and_rate():
    steps = list(video_steps(VIDEOS / "carphone_pristine.mp4", CameraConfig(width=32, height=24)))
    assert len(steps) == 120 - 1
    assert steps[-1].t_us == 3_970_633
    assert sum(len(step.events) for step in steps) > 5000


def test_a_video_that_breaks_off_or_is_damaged_inside_is_refused(tmp_path):
    path = encode(tmp_path / "a.mkv", some_frames(20))
    raw = path.read_bytes()
    half = len(raw) // 2
    for bad in (raw[:half], raw[:half] + bytes(50) + raw[half + 50 :]):
        path.write_bytes(bad)
        with pytest.raises(ValueError, match="is damaged or truncated"):
            video_to_events(path)


def test_what_points_to_another_video_and_what_is_no_file_are_refused(tmp_path):
    encode(tmp_path / "good.mkv", some_frames())
    for text in ("#EXTM3U\n#EXTINF:1,\ngood.mkv\n#EXT-X-ENDLIST\n", "ffconcat version 1.0\nfile good.mkv\n"):
        (tmp_path / "a.mp4").write_text(text)
        with pytest.raises(ValueError, match=r"a\.mp4: is no video"):
            video_to_events(tmp_path / "a.mp4")
    with pytest.raises(ValueError, match="is no regular file"):
        video_to_events("/dev/zero")


def test_frames_too_large_for_memory_are_refused(tmp_path, monkeypatch):
    path = encode(tmp_path / "a.mkv", some_frames())
    monkeypatch.setattr("envs.recordings.decoder.MAX_PIXELS", 100)
    with pytest.raises(ValueError, match="is no video that can be read"):
        video_to_events(path)


@pytest.mark.parametrize(
    ("old", "new"), [((12, 16), (3, 4)), ((7, 5), (5, 3)), ((7, 5), (1, 1)), ((3, 3), (9, 11))]
)
def test_averaging_keeps_the_mean_and_a_flat_picture_flat(old, new):
    picture = np.random.default_rng(0).random(old).astype(np.float32)
    average = area_average(old, new)
    small = average(picture)
    assert (small.shape, small.dtype) == (new, np.float32)
    assert small.mean() == pytest.approx(picture.mean(), rel=1e-5)
    assert average(np.full(old, 0.25, np.float32)) == pytest.approx(0.25, rel=1e-6)
    assert small.min() >= picture.min() - 1e-6
    assert small.max() <= picture.max() + 1e-6
    assert area_average(old, old)(picture) is picture


def test_averaging_sums_in_one_order_whatever_the_processor_and_its_threads():
    picture = np.random.default_rng(0).random((90, 160)).astype(np.float32)
    rows = picture.astype(float).reshape(9, 10, 160) * 0.1
    lines = np.add.accumulate(rows, axis=1)[:, -1]
    blocks = np.add.accumulate(lines.reshape(9, 16, 10) * 0.1, axis=2)[..., -1].astype(np.float32)
    assert area_average((90, 160), (9, 16))(picture).tobytes() == blocks.tobytes()
