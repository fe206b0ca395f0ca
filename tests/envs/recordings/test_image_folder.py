"""Events of folders of images: 8 and 16 bits, floating point, and the times of the images."""

import base64
import zlib

import numpy as np
import pytest
from PIL import Image

from envs.config import CameraConfig
from envs.events import EventCamera
from envs.recordings import video_to_events
from envs.recordings.decoder import decoded_images
from envs.recordings.image_folder import find_images
from envs.recordings.light import LUMA, light_of_grey, usual_floor
from envs.recordings.video import video_steps
from tests.support.damaged_files import damaged
from tests.support.image_folders import SHAPE, quietly, random_frames, save

# Written by OpenEXR 3.5.3 with ZIP compression: `EXR_VALUES` in half and in single precision (base 85).
EXR_FILES = (
    "c-kw|H)LdDU|>kjNX*Mi%_#;lax#lc7|elUP7I6;5Won<?ieCL7$OYG`MCu}sl~;a`FSX8kR)?TVo73nW?o8uIYUx@g;6Gh00ROr1"
    "2M=kDVfCuIf<17)#YU7rTQ18q!uBuz)mR0tVqpqEG|e*E(uC3$;@X+%gIkHVPFC4Zm=&-E=o<!gBb6enpXnUR%VpOz=321vXb!3l#"
    "&cIBT6a@QW=U%iZb)k8F<0!6Z1fh$jnVlPi2T>M3`g@#1(PL84Zoh6JJ`~=&m+m+UBG2F~h>(Y@VmT+le+#RXg7518+J^g}s=h%6v"
    "96GqA=e_W}Su8D8f",
    "c-kw|H)LdDU|>kjNX*Mi%_#;lax#lc7|elUP7EL!5MYF2cMOpr3=xLp{M>?~)Z*gI{5%vkNRl}vu_Q4(GcP5-oFOT{!YGqLfB^xRf"
    "f!_5N@j6EPGTiNbvc=Nss2SNsYOUEuoDV0D^hbDiwjbdOM((hGV>YIa`F>P7+Ao%8|;gdi&9hbAjUhV=9K`ol^LZma3EQMtRy@$r6"
    "dE*h?2^JREFY`qRhN>241lG#5|BAGIJBtQyJnI5hjHLaYbBmLP7=uvjX#}tc(u<^FN74vN#zV%!$wo>h}Iycf9%A?>SOZ-z;SdZoK"
    "CZvVBmXk<fa(?l?1F^<2eA3P0Q0{`M&p3dpPMyI#3p+2>EfgCd5Lxwg9iG=Xye",
)
EXR_VALUES = np.array([[0, 0.25, 1], [2, 4, 8], [100, 0.5, 0.125], [1e-3, 0, 0]], np.float32) * np.array(
    [1, 0.5, 0.25], np.float32
).reshape(3, 1, 1)


def shown(lights: np.ndarray, times_us: list[int], **fields: object) -> np.ndarray:
    """Events of a camera that is shown these frames, float32 (N, H, W)."""
    camera = EventCamera(SHAPE[1], SHAPE[0], **fields)
    camera.reset(lights[0], times_us[0])
    return np.concatenate([camera.step(*each) for each in zip(lights[1:], times_us[1:], strict=True)])


@pytest.mark.parametrize(
    ("suffix", "dtype"), [(".png", "u1"), (".ppm", "u1"), (".tif", "u2"), (".exr", "f4"), (".pfm", "f4")]
)
def test_values_are_read_as_they_are(suffix, dtype, tmp_path):
    if dtype == "f4":
        frames = np.random.default_rng(0).normal(0, 100, (2, *SHAPE, 3)).astype(np.float32)
    else:
        frames = random_frames(2, np.dtype(dtype).type)
    paths, _ = find_images(save(tmp_path, frames, suffix), 10.0, 1 << 30)
    found = [picture.values for picture in decoded_images(paths)]
    assert [values.dtype for values in found] == [frames.dtype] * 2
    assert np.array_equal(found, frames)


def test_files_that_other_writers_made_are_read_as_they_are(tmp_path):
    for number, (text, dtype) in enumerate(zip(EXR_FILES, (np.float16, np.float32), strict=True)):
        path = tmp_path / f"{number}.exr"
        path.write_bytes(zlib.decompress(base64.b85decode(text)))
        (picture,) = decoded_images([path])
        assert np.array_equal(picture.values, EXR_VALUES.astype(dtype))
    grey = np.random.default_rng(0).integers(0, 1 << 16, SHAPE, dtype=np.uint16)
    opaque = np.random.default_rng(0).integers(0, 256, (*SHAPE, 4), dtype=np.uint8)
    for image, expected in (
        (Image.fromarray(grey), np.repeat(grey[..., None], 3, axis=2)),
        (Image.fromarray((grey >> 8).astype(np.uint8)), np.repeat(grey[..., None] >> 8, 3, axis=2)),
        (Image.fromarray(opaque), opaque[..., :3]),  # opacity is not light
    ):
        image.save(tmp_path / "a.png")
        (picture,) = decoded_images([tmp_path / "a.png"])
        assert np.array_equal(picture.values, expected)
    plane = np.random.default_rng(0).random(SHAPE, np.float32) * 9
    (tmp_path / "a.pfm").write_bytes(b"Pf\n16 12\n-1.0\n" + plane[::-1].tobytes())  # rows from below
    (picture,) = decoded_images([tmp_path / "a.pfm"])
    assert np.array_equal(picture.values, plane)


def test_the_same_scene_in_8_bits_16_bits_and_floating_point_makes_the_same_events(tmp_path):
    """Those of a camera that is shown the images in the order of their numbers: frame_2 before frame_10."""
    coarse = random_frames(12)
    fine, light = coarse.astype(np.uint16) * 257, light_of_grey("srgb")[coarse]
    between = fine ^ 5  # levels that 8 bits do not have
    for name, frames, seen in (
        ("8", coarse, light),
        ("16", fine, light),
        ("float", light, light),
        ("between", between, light_of_grey("srgb", 16)[between]),
    ):
        folder = save(tmp_path / name, frames, ".exr" if name == "float" else ".png")
        expected = shown(seen @ LUMA, [round(n * 1e6 / 30) for n in range(12)])
        assert len(expected) > 1000
        assert np.array_equal(quietly(folder, fps=30.0).events, expected)


@pytest.mark.filterwarnings("ignore:.*events are missing:UserWarning")
def test_the_times_of_a_list_are_those_of_the_events(tmp_path):
    """Uneven times, not from 0 on; the list has another order than the names, remarks, and a folder."""
    frames = random_frames(5)
    save(tmp_path / "images", frames, ".png")
    times_s = ["7.5", "7.500001", "7.9", "1468941032.1234567"]
    order = [3, 0, 4, 1]
    lines = [f"{t} images/frame_{n}.png" for t, n in zip(times_s, order, strict=True)]
    (tmp_path / "images.txt").write_text("# time [s] name\n\n" + "\r\n".join(lines) + "\n")
    times_us = [7_500_000, 7_500_001, 7_900_000, 1_468_941_032_123_457]
    steps = list(video_steps(tmp_path))
    assert [step.t_us for step in steps] == times_us[1:]
    for start_us, step in zip(times_us[:-1], steps, strict=True):
        assert step.events["t"].min() > start_us
        assert step.events["t"].max() <= step.t_us
    lights = light_of_grey("srgb")[frames[order]] @ LUMA
    assert np.array_equal(np.concatenate([step.events for step in steps]), shown(lights, times_us))
    even = quietly(tmp_path, fps=4.0)
    assert np.array_equal(even.events, shown(lights, [0, 250_000, 500_000, 750_000]))


def test_light_brighter_than_white_and_negative_values_are_light_and_black(tmp_path):
    frames = np.full((2, *SHAPE, 3), -0.5, np.float32)
    frames[1] = 50.0
    events = video_to_events(save(tmp_path, frames, ".exr"), fps=10.0).events
    count = int(np.log((50.0 + 1e-3) / 1e-3) / 0.2)
    assert len(events) == count * SHAPE[0] * SHAPE[1]
    assert (events["p"] == 1).all()


@pytest.mark.parametrize(
    ("dtype", "transfer", "floor"),
    [
        (np.uint8, "srgb", 1e-3),
        (np.uint8, "linear", 10 / 255),
        (np.uint16, "linear", 1e-3),
        (np.float32, "srgb", 1e-3),
    ],
)
def test_the_floor_is_right_for_what_the_camera_is_shown(dtype, transfer, floor, tmp_path):
    """A step from black to one grey level of 8 linear bits is no event, if no lower floor is given."""
    assert usual_floor(np.dtype(dtype), transfer) == floor
    frames = np.zeros((2, *SHAPE, 3), dtype)
    frames[1] = 1 / 255 if dtype is np.float32 else np.iinfo(dtype).max // 255
    folder = save(tmp_path, frames, ".exr" if dtype is np.float32 else ".png")
    value = 1 / 255 if transfer == "linear" else 1 / 255 / 12.92
    for config, used in ((None, floor), (CameraConfig(width=16, height=12, luminance_floor=2e-3), 2e-3)):
        events = video_to_events(folder, config, transfer=transfer, fps=10.0).events
        assert len(events) == int(np.log((value + used) / used) / 0.2) * SHAPE[0] * SHAPE[1]


@pytest.mark.parametrize(
    ("line", "rule"),
    [
        ("0 frame_1.png", "times must increase"),
        ("", "has 1 images"),
        ("nan frame_1.png", "line 2 must be time and name"),
        ("-1 frame_1.png", "line 2 must be time and name"),
        ("1e999999999 frame_1.png", "line 2 must be time and name"),
        ("0.1", "line 2 must be time and name"),
        ("1 /etc/passwd", "not inside"),
        ("1 images.txt", "is no image"),
        ("1 frame_9.png", "cannot be opened"),
        ("1 a\0.png", "cannot be opened"),
        ("1 .", "is no image"),
    ],
)
def test_a_list_that_breaks_a_rule_is_refused_by_name(line, rule, tmp_path):
    folder = save(tmp_path / "a", random_frames(3), ".png")
    (folder / "images.txt").write_text(f"0 frame_0.png\n{line}\n")
    with pytest.raises(ValueError, match=rule) as error:
        video_to_events(folder)
    assert str(folder) in str(error.value)


def test_any_damage_of_a_list_is_refused_by_name_or_leaves_a_list(tmp_path):
    names = ["frame_0.png", "b/c.png", "frame_10.exr"]
    (tmp_path / "b").mkdir()
    for name in names:
        (tmp_path / name).write_bytes(b"a")
    listed, rng = tmp_path / "images.txt", np.random.default_rng(0)
    good, results = "\n".join(f"{n * 0.04:.6f} {name}" for n, name in enumerate(names * 5)).encode(), []
    for _ in range(300):
        listed.write_bytes(damaged(good, [good, rng.bytes(50)], rng) or b"\n")
        try:
            paths, times_us = find_images(tmp_path, None, 1 << 20)
        except ValueError as error:
            if str(tmp_path) not in str(error):
                raise
            results.append(False)
        else:
            assert len(paths) == len(times_us) >= 2
            assert all(path.is_file() and path.is_relative_to(tmp_path) for path in paths)
            assert all(0 <= t_us < 1 << 52 for t_us in times_us)
            results.append(True)
    assert 0 < sum(results) < 300


def test_folders_that_are_no_sequence_are_refused(tmp_path):
    with pytest.raises(ValueError, match="has 0 images"):
        video_to_events(tmp_path, fps=10.0)
    folder = save(tmp_path / "a", random_frames(3), ".png")
    for fps in (0.0, np.inf, np.nan, 2e6):
        with pytest.raises(ValueError, match="fps must lie in"):
            video_to_events(folder, fps=fps)
    with pytest.raises(ValueError, match="most max_bytes=100"):
        video_to_events(folder, fps=10.0, max_bytes=100)


def test_images_that_are_damaged_or_differ_are_refused(tmp_path):
    folder = save(tmp_path / "a", random_frames(4), ".png")
    good = (folder / "frame_2.png").read_bytes()
    for bad in (good[:100], b"no image", good[:60] + bytes(20) + good[80:]):
        (folder / "frame_2.png").write_bytes(bad)
        with pytest.raises(ValueError, match=str(folder)):
            quietly(folder, fps=10.0)
    for other in (np.zeros((13, 16, 3), np.uint8), np.zeros(SHAPE, np.uint16)):
        Image.fromarray(other).save(folder / "frame_2.png")
        with pytest.raises(ValueError, match="change their size or depth"):
            quietly(folder, fps=10.0)
    for bad, camera in ((np.nan, None), (np.inf, CameraConfig(width=4, height=3)), (-np.inf, None)):
        frames = np.ones((3, *SHAPE, 3), np.float32)
        frames[1, 5, 5] = bad
        with pytest.raises(ValueError, match="frame 1 has values that are not finite"):
            video_to_events(save(tmp_path / "b", frames, ".exr"), camera, fps=10.0)
