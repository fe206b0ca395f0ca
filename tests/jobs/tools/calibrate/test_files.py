import dataclasses
import shutil

import hydra
import numpy as np
import pytest
import yaml
from omegaconf import OmegaConf
from PIL import Image

from envs.config import CameraConfig, FaultsConfig
from envs.events import EVENT
from envs.recordings import write_events
from envs.recordings.light import light_of_grey
from jobs.config.config import ConfigError, parse
from jobs.config.schema import RecordingConfig
from jobs.tools.calibrate import calibrate, sources
from jobs.tools.calibrate.camera_file import camera_text
from jobs.tools.calibrate.estimate import DEAD, LEAK, NAMES, OFF, ON, Calibration
from jobs.tools.calibrate.footage import Footage
from jobs.tools.calibrate.found import Found, missing
from jobs.tools.calibrate.likeness import likeness, net_images
from jobs.tools.calibrate.sources import read_frames, read_source
from tests.support.configs import CONF, compose
from tests.support.planted import moving_footage, planted, still_planted


def composed(conf, *words):
    with hydra.initialize_config_dir(str(conf), version_base="1.3"):
        return OmegaConf.to_container(hydra.compose("config", list(words)), resolve=True)


# Of which a calibration takes how light becomes a response, and nothing else.
CONFIGURED = CameraConfig(
    response="lin_log", luminance_floor=0.02, cutoff_hz=300.0, threshold_mismatch=0.15, readout_hz=3000.0
)


def test_a_still_scene_takes_its_thresholds_and_refractory_period_from_the_command_line():
    camera = dataclasses.replace(CONFIGURED, contrast_threshold=0.3, refractory_us=500)
    moving, still = (calibrate.assumed(camera, still) for still in (False, True))
    usual = CameraConfig(response="lin_log", luminance_floor=0.02)
    assert moving == usual
    assert still == dataclasses.replace(usual, contrast_threshold=0.3, refractory_us=500)
    nothing = Calibration({name: missing("still") for name in NAMES}, np.zeros((36, 48), bool))
    written = yaml.safe_load(camera_text(nothing, "x.raw", still))["camera"]
    assert written == {
        **{"width": 48, "height": 36, "response": "lin_log", "luminance_floor": 0.02},
        **{"contrast_threshold": 0.3, "contrast_threshold_off": None, "refractory_us": 500},
    }


def test_what_was_found_is_a_camera_that_others_can_take(tmp_path):
    conf = shutil.copytree(CONF, tmp_path / "conf")
    found = {name: missing("nothing told it") for name in NAMES}
    found |= {ON: Found(0.31, 0.3, 0.32), DEAD: Found(499.7, 480.0, 510.0), LEAK: Found(0.125, 0.1, 0.2)}
    calibration = Calibration(found, np.zeros((36, 48), bool))
    text = camera_text(calibration, "x.raw", calibrate.assumed(CONFIGURED, still=False))
    (conf / "camera" / "mine.yaml").write_text(text)
    config = parse(composed(conf, "+exp=train", "camera=mine"))
    camera = config.env.camera
    assert (camera.width, camera.height, camera.contrast_threshold) == (48, 36, 0.31)
    assert (camera.refractory_us, config.env.faults.leak_hz) == (500, 0.125)
    compared = calibrate.compared(calibration, CONFIGURED, FaultsConfig())
    assert set(compared) == {"ideal", "as configured", "calibrated"}
    assert (config.env.camera, config.env.faults) == compared["calibrated"]
    usual = parse(compose("+exp=calibrate")).env
    assert set(calibrate.compared(calibration, usual.camera, usual.faults)) == {"ideal", "calibrated"}
    absent = {name for name in NAMES if name not in (ON, DEAD, LEAK)}
    groups = {name: keys for name, keys in yaml.safe_load(text).items() if name != "defaults"}
    assert not absent & {f"{group}.{key}" for group, keys in groups.items() for key in keys}
    assert all(f"# {name}: not found, nothing told it" in text for name in absent)
    later = parse(composed(conf, "+exp=train", "camera=mine", "camera.refractory_us=7", "light=night"))
    assert (later.env.camera.refractory_us, later.env.faults.shot_noise_hz) == (7, 5.0)


def written_frames(folder, footage):
    """The frames as eight-bit pictures beside their list, and as they are read again."""
    levels = light_of_grey("srgb")
    (folder / "images").mkdir()
    lines = []
    for k, (light, t_us) in enumerate(zip(footage.luminance, footage.times_us, strict=True)):
        grey = np.abs(light[..., None] - levels).argmin(axis=-1).astype(np.uint8)
        Image.fromarray(grey).save(folder / "images" / f"{k}.png")
        lines.append(f"{1e-6 * t_us:.6f} images/{k}.png")
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    return read_frames(folder / "images.txt", 0)


def test_frames_and_bare_rows_are_read_as_they_were_written(tmp_path):
    footage = moving_footage(width=8, waving=4, flickering=2, still=2)
    footage = Footage(footage.luminance[:20], footage.times_us[:20])
    frames = written_frames(tmp_path, footage)
    assert frames.times_us.tolist() == footage.times_us.tolist()
    assert np.abs(frames.luminance - footage.luminance).max() < 0.005
    assert read_frames(tmp_path / "images.txt", 250).times_us[0] == 250
    events = planted(footage)
    rows = zip(events["t"], events["x"], events["y"], events["p"] > 0, strict=True)
    (tmp_path / "events.txt").write_text("".join(f"{1e-6 * t:.6f} {x} {y} {int(p)}\n" for t, x, y, p in rows))
    read = read_source(tmp_path / "events.txt", frames, RecordingConfig())
    assert np.array_equal(read.events, events)
    assert (read.width, read.height) == (8, 8)


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("0.0 a.png\n", "two frames or more"),
        ("0.0 a.png\n0.1\n", "seconds picture"),
        ("0.1 a.png\n0.1 a.png\n", "times must increase"),
        ("0.0 a.png\n0.1 none.png\n", "is no picture"),
        ("0.0 a.png\n0.1 b.png\n", "one size"),
    ],
)
def test_frames_that_are_none_are_refused(tmp_path, text, rule):
    for name, side in (("a", 4), ("b", 5)):
        Image.fromarray(np.zeros((side, side), np.uint8)).save(tmp_path / f"{name}.png")
    (tmp_path / "images.txt").write_text(text)
    with pytest.raises(ValueError, match=rule):
        read_frames(tmp_path / "images.txt", 0)


def test_pictures_that_cannot_be_decoded_to_eight_bits_are_refused(tmp_path, monkeypatch):
    grey = Image.fromarray(np.arange(16, dtype=np.uint8).reshape(4, 4))
    grey.save(tmp_path / "a.png")
    (tmp_path / "images.txt").write_text("0.0 a.png\n0.1 b.png\n")
    whole = (tmp_path / "a.png").read_bytes()
    for broken in (whole[:33] + b"\xff" * 40, whole[:20], whole[:33] + b"\0\0\0\4IDAT" + bytes(8)):
        (tmp_path / "b.png").write_bytes(broken)
        with pytest.raises(ValueError, match=r"b.png: is no picture .*; save it again"):
            read_frames(tmp_path / "images.txt", 0)
    Image.fromarray(np.full((4, 4), 300, np.uint16)).save(tmp_path / "b.png")
    with pytest.raises(ValueError, match=r"b\.png: must have 8 bits a value, got mode I;16"):
        read_frames(tmp_path / "images.txt", 0)
    grey.save(tmp_path / "b.png")
    with monkeypatch.context() as patch:
        patch.setattr(sources, "MAX_PIXELS", 31)
        with pytest.raises(ValueError, match=r"b\.png: must leave all pictures at 31 pixels .* 4x4 after 16"):
            read_frames(tmp_path / "images.txt", 0)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 4)
    with pytest.raises(ValueError, match=r"a\.png: is no picture .*exceeds limit"):
        read_frames(tmp_path / "images.txt", 0)


@pytest.mark.parametrize("suffix", ["npz", "csv"])
def test_events_beside_the_frames_are_refused_where_the_recording_names_no_size(tmp_path, suffix):
    frames = Footage(np.zeros((2, 4, 6), np.float32), np.array([0, 1000]))
    inside, beside = (tmp_path / f"{x}.{suffix}" for x in (5, 6))
    for x, path in ((5, inside), (6, beside)):
        if suffix == "npz":
            np.savez(path, t=np.array([10]), x=np.array([x]), y=np.array([3]), p=np.array([1]), unit="us")
        else:
            path.write_text(f"t_us,x,y,p\n10,{x},3,1\n")
    found = read_source(inside, frames, RecordingConfig())
    assert (found.width, found.height) == (6, 4)
    with pytest.raises(ValueError, match=str(beside)):
        read_source(beside, frames, RecordingConfig())


def run(tmp_path, *words):
    return calibrate.run(parse(compose("+exp=calibrate", f"runs_dir={tmp_path / 'runs'}", *words)))


def test_a_job_writes_camera_hot_pixels_and_figure(tmp_path):
    footage = moving_footage(width=24, waving=10, flickering=0, still=20)
    footage = Footage(footage.luminance[:200], footage.times_us[:200])
    frames = written_frames(tmp_path, footage)
    camera = {"contrast_threshold": 0.3, "contrast_threshold_off": 0.4}
    faults = {"hot_pixel_share": 0.003, "hot_pixel_hz": 300.0}
    write_events(tmp_path / "events.h5", planted(frames, camera, faults), 24, 30)
    words = [f"calibrate.recording={tmp_path / 'events.h5'}", f"calibrate.frames={tmp_path / 'images.txt'}"]
    found = run(tmp_path, *words)
    assert found.found[ON].value == pytest.approx(0.3, rel=0.1)
    assert found.found[OFF].value == pytest.approx(0.4, rel=0.1)
    (folder,) = (tmp_path / "runs").glob("*/calibrate")
    assert yaml.safe_load((folder / "camera.yaml").read_text())["camera"]["width"] == 24
    hot = [tuple(map(int, row.split(","))) for row in (folder / "hot_pixels.csv").read_text().split()[1:]]
    assert len(hot) == 2
    assert all(found.hot[y, x] for x, y in hot)
    assert (folder / "likeness.png").stat().st_size > 10_000


def test_a_job_refuses_what_it_cannot_use_in_one_line(tmp_path):
    events, _ = still_planted(8, 0.3, faults={"leak_hz": 0.2})
    write_events(tmp_path / "few.h5", events, 8, 8)
    for recording, more, rule in (
        ("few.h5", [], "at least 1000 events"),
        ("none.h5", [], "none.h5"),
        ("few.h5", [f"calibrate.frames={tmp_path / 'no.txt'}"], "no.txt"),
    ):
        with pytest.raises(ConfigError, match=rule) as caught:
            run(tmp_path, f"calibrate.recording={tmp_path / recording}", *more)
        assert str(caught.value).startswith("calibrate.recording: ")
        assert "\n" not in str(caught.value)


def test_likeness_counts_what_it_says():
    rows = [(10, 0, 1), (20, 0, 1), (50, 0, -1), (60, 1, -1), (150, 1, -1), (190, 2, 1)]
    events = np.zeros(len(rows), EVENT)
    events["t"], events["x"], events["p"] = np.array(rows).T
    times = np.array([0, 100, 200])
    found = likeness(events, events, times, (1, 3))
    assert found.rate_hz == pytest.approx(6 / 3 / 200e-6)
    assert found.on_share == 0.5
    assert found.same_share == pytest.approx(2 / 3)
    assert found.median_ms == pytest.approx(0.03)
    assert found.real == pytest.approx(1.0)
    images = net_images(events, times, (1, 3))
    assert images[:, 0].tolist() == [[1, -1, 0], [0, -1, 1]]
