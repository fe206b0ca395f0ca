import numpy as np
import pytest
from PIL import Image

from envs.config import CameraConfig, EnvConfig, FaultsConfig
from envs.events import EVENT
from envs.recordings import write_events
from jobs.tools.calibrate.footage import Footage
from research.probe.dataset import SECTORS, ProbeData
from research.sliding.depth import Lens, distorted, inverse_depth, straightened
from research.sliding.sliding import Truth, read_folder, read_lens, score, undistorted, windows_of
from research.sliding.world import Slide, record_slides
from tests.support.configs import compose

LENS = Lens(335.4, 335.4, 129.9, 99.2, -0.139, 0.093, -0.0003, 0.0002, 0.0)


def card_pictures(inverse, ways_m, focal, side=64):
    """Pictures of a textured wall at one depth, seen from places to the right."""
    rng = np.random.default_rng(0)
    wall = rng.uniform(0, 255, (side, 4 * side))
    wall = 0.25 * (wall + np.roll(wall, 1, 1) + np.roll(wall, 2, 1) + np.roll(wall, 3, 1))
    columns = np.arange(side) + 1.5 * side
    return np.stack([
        np.stack([np.interp(columns + focal * way * inverse, np.arange(4 * side), row) for row in wall])
        for way in ways_m
    ])  # fmt: skip


@pytest.mark.parametrize("inverse", [0.5, 1.0, 2.5])
def test_depth_of_a_wall_is_read_from_how_far_it_moves(inverse):
    ways_m = np.linspace(0.0, 0.08, 5)
    found, sure = inverse_depth(card_pictures(inverse, ways_m, 100.0), ways_m, 2, 100.0)
    middle = found[10:-10, 24:-24]
    assert np.median(middle) == pytest.approx(inverse, abs=0.1)
    assert (np.abs(middle - inverse) < 0.15).mean() > 0.95
    assert np.median(sure) > 2.0
    blank, unsure = inverse_depth(np.full((5, 32, 32), 7.0), ways_m, 2, 100.0)
    assert np.isfinite(blank).all()
    assert not (unsure > 2.0).any()


def test_a_lens_without_distortion_leaves_a_picture_and_one_with_it_is_undone():
    picture = np.random.default_rng(1).uniform(0, 255, (18, 24))
    assert straightened(picture, Lens(20.0, 20.0, 12.0, 9.0)) == pytest.approx(picture)
    down, across = distorted(LENS, (180, 240))
    row, column = undistorted(LENS, (180, 240))
    back = np.hypot(down[row, column] - np.arange(180)[:, None], across[row, column] - np.arange(240))
    assert back[5:-5, 5:-5].max() < 2.0


@pytest.mark.parametrize("words", ["1 2 3", "1 2 3 4 5 6 7 8 9 10", "1 2 3 four", "1 2 3 nan", ""])
def test_a_lens_of_other_than_four_to_nine_numbers_is_refused(tmp_path, words):
    path = tmp_path / "calib.txt"
    path.write_text("335.4 335.4 129.9 99.2\n")
    assert read_lens(path) == Lens(335.4, 335.4, 129.9, 99.2)
    path.write_text(words)
    with pytest.raises(
        ValueError, match=rf"calib\.txt: must have 4 to 9 numbers, .*got {len(words.split())} "
    ):
        read_folder(tmp_path, "events.h5", 0)


def test_a_recording_without_events_is_refused(tmp_path):
    (tmp_path / "calib.txt").write_text("20 20 8 6")
    np.savetxt(tmp_path / "groundtruth.txt", np.zeros((2, 8)))
    for name in "ab":
        Image.fromarray(np.zeros((12, 16), np.uint8)).save(tmp_path / f"{name}.png")
    (tmp_path / "images.txt").write_text("0.0 a.png\n0.1 b.png\n")
    write_events(tmp_path / "events.h5", np.zeros(0, EVENT), 16, 12)
    with pytest.raises(ValueError, match=r"events\.h5: must have events, got 0"):
        read_folder(tmp_path, "events.h5", 0)


def test_a_nearer_pole_moves_faster_and_makes_more_events():
    camera = CameraConfig(width=32, height=32, fov_deg=30.0)
    slide = Slide(camera, FaultsConfig(), 3.0, 200.0, 8)
    data = record_slides(slide, 6, 0)
    assert data.proximity.shape == (48, SECTORS)
    assert len(data.windows) == 48
    assert ((data.proximity >= 0) & (data.proximity < 1)).all()
    for events, start_us, duration_us in data.windows:
        assert ((events["t"] > start_us) & (events["t"] <= start_us + duration_us)).all()
    still = record_slides(Slide(camera, FaultsConfig(), 1e-6, 200.0, 8), 1, 0)
    assert sum(len(window[0]) for window in still.windows) == 0
    again = record_slides(slide, 6, 0)
    assert np.array_equal(again.proximity, data.proximity)


def test_proximity_of_a_recording_is_that_of_its_depth():
    env = EnvConfig(camera=CameraConfig(width=24, height=24))
    shape = (24, 48)
    inverse = np.full((2, *shape), np.nan)
    inverse[:, :, 12:24], inverse[:, 4, 24:36] = 1.0, 2.0
    footage = Footage(np.zeros((2, *shape), np.float32), np.array([0, 20_000]))
    events = np.zeros(0, [("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "i1")])
    data = windows_of(events, Truth(inverse, footage.times_us, 0.3, 40.0), footage, env)
    assert data.proximity.shape == (4, SECTORS)
    assert data.proximity[:, :12] == pytest.approx(np.exp(-1.0))
    assert data.proximity[:, 12:] == pytest.approx(np.exp(-0.5))


def probe_data(truth, episodes):
    steps = len(truth) // episodes
    return ProbeData([], np.repeat(np.arange(episodes), steps), truth, np.zeros(SECTORS))


@pytest.mark.parametrize("single", [True, False])
def test_scores_are_one_of_the_truth_and_none_of_noise(single):
    rng = np.random.default_rng(2)
    truth = rng.random((40, SECTORS)) + np.linspace(0, 1, SECTORS)
    data = probe_data(truth, 1 if single else 8)
    train = probe_data(np.tile(truth.mean(axis=0), (4, 1)), 4)
    perfect = score(data, truth, train, single)
    assert perfect.together[0] == pytest.approx(1.0)
    assert perfect.over_time[0] == pytest.approx(1.0)
    assert perfect.error[0] == pytest.approx(0.0)
    noise = score(data, rng.random(truth.shape), train, single)
    assert noise.together[1] < 0.0 < noise.together[2]
    usual = score(data, np.broadcast_to(truth.mean(axis=0), truth.shape), train, single)
    assert usual.error[0] == pytest.approx(1.0)
    assert compose("+exp=sliding")["job"] == "sliding"
