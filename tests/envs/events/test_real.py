import itertools
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from envs.config import CameraConfig
from envs.events import EventCamera
from envs.recordings import video_to_events

ROOT = Path(__file__).resolve().parents[3]
FOLDER = Path(os.environ.get("EVADE_DATA", ROOT.parent / "shared" / "data")) / "rpg_slider_depth"
SHAPE = (180, 240)
GREY = 1 / 255  # one level of the recorded frames

pytestmark = pytest.mark.skipif(
    not FOLDER.is_dir(), reason=f"no recording in {FOLDER}; set EVADE_DATA to the folder that holds it"
)


def net(x, y, p):
    """Signed event image: sum of polarities of each pixel."""
    image = np.zeros(SHAPE)
    np.add.at(image, (y, x), p)
    return image


@pytest.fixture(scope="module")
def recording():
    """Frames 1 to 4 of a DAVIS240C on a slider, their times, the net events between them, and all."""
    rows = [line.split() for line in (FOLDER / "images.txt").read_text().splitlines()[1:5]]
    times = [round(float(row[0]) * 1e6) for row in rows]
    frames = [np.float32(Image.open(FOLDER / row[1]).convert("L")) / np.float32(255) for row in rows]
    t, x, y, p = np.loadtxt(FOLDER / "events_chunk.txt").T
    t, x, y, p = np.rint(t * 1e6), x.astype(int), y.astype(int), 2 * p - 1
    assert ((t > times[0]) & (t <= times[3])).sum() == 37_142
    return frames, times, between((t, x, y, p), times), (t, x, y, p)


def between(events, times):
    """Net images of the events between these times."""
    t, x, y, p = events
    return [net(x[i], y[i], p[i]) for i in ((t > a) & (t <= b) for a, b in itertools.pairwise(times))]


def simulated(recording, **fields):
    frames, times = recording[:2]
    camera = EventCamera(SHAPE[1], SHAPE[0], **fields)
    camera.reset(frames[0], times[0])
    return [camera.step(frame, t) for frame, t in zip(frames[1:], times[1:], strict=True)]


def likeness(recording, events):
    """Means over the intervals: correlation, the same blurred, equal signs, active pixels shared."""
    figures = []
    for real, batch in zip(recording[2], events, strict=True):
        ours = net(batch["x"], batch["y"], batch["p"])
        both, any_ = (real != 0) & (ours != 0), (real != 0) | (ours != 0)
        pair = (gaussian_filter(real, 1).ravel(), gaussian_filter(ours, 1).ravel())
        signs = (np.sign(real) == np.sign(ours))[both].mean()
        plain = np.corrcoef(real.ravel(), ours.ravel())[0, 1]
        figures.append((plain, np.corrcoef(*pair)[0, 1], signs, both.sum() / any_.sum()))
    return np.mean(figures, axis=0)


def matched(recording, folder):
    """Events of the default camera, of which only the thresholds are fitted, to the real numbers."""
    times, real = recording[1:3]
    wanted = {sign: sum(np.abs(image[image * sign > 0]).sum() for image in real) for sign in (1, -1)}
    on = off = 0.5
    for _ in range(10):
        camera = CameraConfig(
            width=SHAPE[1], height=SHAPE[0], contrast_threshold=on, contrast_threshold_off=off
        )
        events = video_to_events(folder, camera).events
        cuts = np.searchsorted(events["t"], times, side="right")
        parts = [events[a:b] for a, b in itertools.pairwise(cuts)]
        images = [net(part["x"], part["y"], part["p"]) for part in parts]
        made = {sign: sum(np.abs(image[image * sign > 0]).sum() for image in images) for sign in (1, -1)}
        on, off = on * (made[1] / wanted[1]) ** 0.5, off * (made[-1] / wanted[-1]) ** 0.5
    return parts


@pytest.mark.filterwarnings("ignore:.*events are missing:UserWarning")  # 26 frames per second
def test_simulated_events_are_like_those_of_a_real_sensor(recording, tmp_path):
    """With all defaults; a frame is of the middle of its exposure, some milliseconds after its time."""
    lines = (FOLDER / "images.txt").read_text().splitlines()[1:5]
    (tmp_path / "images").mkdir()
    (tmp_path / "images.txt").write_text("\n".join(lines))
    for line in lines:
        shutil.copy(FOLDER / line.split()[1], tmp_path / "images")
    for exposed_us in (4000, 8000):
        later = (*recording[:2], between(recording[3], [t + exposed_us for t in recording[1]]))
        _, blurred, signs, shared = likeness(later, matched(later, tmp_path))
        assert blurred >= 0.90
        assert signs >= 0.97
        assert shared >= 0.45


@pytest.mark.parametrize(
    ("threshold", "count", "figures"),
    [
        (0.2, 115_027, (0.669, 0.804, 0.950, 0.450)),
        (0.75, 14_925, (0.592, 0.709, 0.974, 0.253)),
    ],
)
def test_memory_legacy_makes_the_events_of_the_published_code(recording, threshold, count, figures):
    fields = {"luminance_floor": GREY, "max_events_per_pixel": 10, "memory": "legacy"}
    events = simulated(recording, contrast_threshold=threshold, **fields)
    assert sum(map(len, events)) == count
    assert likeness(recording, events) == pytest.approx(figures, abs=6e-4)
