"""Every remedy that a refusal or warning of a reader or writer of recordings names is tried here, and works.

A trial makes the refusal, does what it says, and reads the events. What was said is then compared with the
endings of all messages in the sources.
"""

import ast
import re
import struct
import subprocess
import sys
import warnings
from collections.abc import Callable
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any

import h5py
import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

import envs.recordings
from envs.config import CameraConfig
from envs.events import EVENT
from envs.recordings import (
    Recording,
    event_writer,
    read_events,
    read_frames,
    read_imu,
    read_recording,
    video_to_events,
    write_events,
    write_recording,
)
from envs.recordings.decoder import decoded_images
from envs.recordings.video import video_steps
from tests.support.bags import array_message, davis, store_of, write_bag
from tests.support.event_files import aedat2, aedat3, some_events
from tests.support.image_folders import save as save_images

EVENTS = some_events(0, 200, 64, 48, 100_000)
N = len(EVENTS)
COLUMNS = {name: EVENTS[name] for name in "txy"} | {"p": (EVENTS["p"] > 0).astype("u1")}
ROWS = np.stack([COLUMNS[name] for name in "xytp"], 1)
SAID: list[str] = []  # by refusals


def refuses(rule: str, call: Callable[..., Any], *arguments: Any, **options: Any) -> None:
    """The call is refused with this in its message."""
    with pytest.raises(ValueError, match=rule) as caught:
        call(*arguments, **options)
    SAID.append(str(caught.value))


def refused(rule: str, path: Path, *arguments: Any, **options: Any) -> None:
    refuses(rule, read_events, path, *arguments, **options)


def unwritten(rule: str, path: Path, events: np.ndarray, width: int = 64, **options: Any) -> None:
    refuses(rule, write_events, path, events, width, 48, **options)


def unseen(rule: str, path: Path, **options: Any) -> None:
    refuses(rule, video_to_events, path, **options)


def reads(path: Path, count: int = N, **options: Any) -> None:
    assert len(read_events(path, **options).events) == count


def save(path: Path, **arrays: np.ndarray) -> Path:
    np.savez(path, **(COLUMNS | arrays))
    return path


def written(path: Path, bytes: bytes) -> Path:
    path.write_bytes(bytes)
    return path


def hdf5(path: Path, group: str = "events", **arrays: Any) -> Path:
    with h5py.File(path, "a") as file:
        for name, values in (COLUMNS | arrays).items():
            file[f"{group}/{name}"] = values
    return path


def later(us: int) -> np.ndarray:
    events = EVENTS.copy()
    events["t"] += us
    return events


# Options that a message names.


def files(tmp: Path) -> None:
    """Files of `EVENTS`, most of which do not say all about themselves."""
    for name in ("a.npz", "a.raw", "a.dat", "a.aedat4"):
        write_events(tmp / name, EVENTS, 64, 48)
    for format in ("evt2", "evt3"):
        write_events(tmp / "whole", EVENTS, 64, 48, format)
        written(tmp / f"bare_{format}.raw", (tmp / "whole").read_bytes().partition(b"% end\n")[2])
    written(tmp / "tail.dat", (tmp / "a.dat").read_bytes() + b"abc")
    aedat2(tmp / "whole", [(x << 1 | y << 8, t) for t, x, y, _ in EVENTS.tolist()])
    written(tmp / "headless", (tmp / "whole").read_bytes().partition(b"\r\n")[2])
    aedat2(tmp / "davis", [(y << 22 | x << 12 | (p > 0) << 11, t) for t, x, y, p in EVENTS.tolist()])
    words = np.stack((EVENTS["x"].astype("<u4") << 17 | EVENTS["y"].astype("<u4") << 2 | 1, EVENTS["t"]), 1)
    two = "#Source 1: DVS128\r\n#Source 2: DVS128\r\n"
    aedat3(tmp / "two_sources", [(1, 0, 8, words.astype("<u4").tobytes())], two)
    lines = "".join(f"{x},{y},{t},{p},7\n" for x, y, t, p in ROWS.tolist())
    (tmp / "bare.csv").write_text(lines)
    (tmp / "twice.csv").write_text("x,y,t_us,p,p\n" + lines)
    np.save(tmp / "rows.npy", ROWS[::-1])
    np.save(tmp / "fields.npy", np.array([tuple(row) for row in ROWS.tolist()], [(n, "i8") for n in "xyuv"]))
    arrays = dict(zip("abcd", COLUMNS.values(), strict=True))
    np.savez(tmp / "abcd.npz", **arrays)
    np.savez(tmp / "abcde.npz", **arrays, e=ROWS)
    with h5py.File(tmp / "deep.h5", "w") as file:
        for name, values in COLUMNS.items():
            file[f"deep/{name * 2}"] = values
    hdf5(tmp / "seconds.h5", t=EVENTS["t"] * 1.0000001e-6)
    store, kind = store_of("dvs_msgs", False), "dvs_msgs/msg/EventArray"
    parts = {"/a": EVENTS, "/b": EVENTS[:100]}
    messages = {name: (kind, [array_message(store, "dvs_msgs", some, False)]) for name, some in parts.items()}
    write_bag(tmp / "bag", messages, store, False)
    hdf5(tmp / "sides.h5", "prophesee/left")
    hdf5(tmp / "sides.h5", "prophesee/right", **{name: values[:100] for name, values in COLUMNS.items()})


XYTP = {"columns": tuple("xytp")}
DEEP = {"group": "deep", "columns": ("tt", "xx", "yy", "pp")}
OF_OPTIONS = [  # a file, options that are refused, what the message says, options that read it
    ("headless", {}, "give format as one of aedat2", {"format": "aedat2"}),
    ("bare_evt3.raw", {}, "names no encoding; give format='evt2'", {"format": "evt3"}),
    ("bare_evt2.raw", {"format": "evt3"}, "another encoding: give format as evt2", {"format": "evt2"}),
    ("a.dat", {"format": "es"}, "so it is none; give its format", {"format": "dat"}),
    ("a.dat", {"format": "ros"}, "give its format, or leave format", {}),
    ("a.raw", {"format": "evt2"}, "says evt3 and the caller says evt2; leave format out", {}),
    ("a.raw", {"width": 9}, "says width=64 .*leave width out", {}),
    ("a.raw", {"topic": "a"}, "topic has no effect on evt.* leave topic out", {}),
    ("a.npz", {"time_unit": "s"}, "says time_unit=us .* says s; leave time_unit out", {}),
    ("bag", {"format": "evt3"}, "no evt3 file; leave format out", {}),
    ("a.npz", {"max_bytes": 10}, "raise max_bytes", {"max_bytes": 1 << 30}),
    ("a.npz", {"max_events": 9}, "raise max_events, or read a part by start_us", {"max_events": N}),
    ("rows.npy", XYTP | {"width": 9}, "give the right width and height", XYTP | {"width": 64}),
    ("davis", {}, "an unknown camera.* give width and height of one", {"width": 346, "height": 260}),
    ("tail.dat", {"strict": True}, "read it without strict", {}),
    ("bare.csv", {}, r"column 't' .* give columns=\('t', .* and time_unit", XYTP | {"time_unit": "us"}),
    ("bare.csv", XYTP, "give time_unit as one of s, ms, us, ns", XYTP | {"time_unit": "us"}),
    ("twice.csv", {}, "column p twice; give columns= with one", XYTP | {"time_unit": "us"}),
    ("rows.npy", {}, "give columns= in their order, such as", XYTP),
    ("fields.npy", {}, "give columns= with those of t, x, y, p", {"columns": tuple("uxyv")}),
    ("abcd.npz", {}, "give columns= with the names of the arrays", {"columns": tuple("abcd")}),
    ("abcde.npz", {"group": "nowhere"}, "give group as one", {"group": "e"} | XYTP),
    ("deep.h5", {}, "give group= with the path of the group or data set of", DEEP),
    ("deep.h5", {"group": "other"}, "give group= with the path of a group", DEEP),
    ("seconds.h5", {}, "are no whole microseconds; give time_unit", {"time_unit": "s"}),
    ("two_sources", {"stream": 7}, "give stream as one of", {"stream": 1}),
    ("a.aedat4", {"stream": 7}, "its streams are 0 .*: give stream as one of that kind", {"stream": 0}),
    ("bag", {"topic": "/c"}, "no topic '/c' .* /a .*: give topic as one of events", {"topic": "/a"}),
]  # fmt: skip


def of_options(tmp: Path) -> None:
    files(tmp)
    for name, wrong, rule, right in OF_OPTIONS:
        refused(rule, tmp / name, **wrong)
        reads(tmp / name, **right)
    early = int(np.sum(EVENTS["t"] < 2_000))
    reads(tmp / "a.npz", early, max_events=max(9, early), end_us=2_000)
    for name in ("two_sources", "sides.h5"):  # whose warnings say what chooses
        reads(tmp / name)
    reads(tmp / "sides.h5", 100, group="prophesee/right")
    reads(tmp / "bag", 100, topic="/b")
    reads(next((tmp / "bag").glob("*.db3")), topic="/a")


def other_formats(tmp: Path) -> None:
    """Files that are none of the format that was asked for, or of none at all."""
    refused("give format as one of aedat2", written(tmp / "a", b"\0\1\2\3" * 10))
    endless = written(tmp / "b", b"% " + b"x" * 70_000)
    refused("no file of a Prophesee camera, or damaged: give its format", endless, format="evt3")
    endless = written(tmp / "b", b"#!AER-DAT2.0" + b"x" * 70_000)
    refused("no AEDAT 2.0 file, or damaged: give its format", endless, format="aedat2")
    refused("is not UTF-8 text .*; give the format", written(tmp / "c.txt", b"\xff\xfe\xfa" * 20))
    refused("so it is no text; give its format", written(tmp / "c.txt", b"1" * 2000))
    (tmp / "empty").mkdir()
    refused("is no regular file; give the path of one recording", tmp / "empty")


def other_files(tmp: Path) -> None:
    write_events(tmp / "a.dat", EVENTS, 64, 48)
    refuses("aedat3, aedat4, hdf5, ros files have them", read_frames, tmp / "a.dat")
    write_events(tmp / "a.aedat4", EVENTS, 64, 48)
    refuses("no stream of kind FRME; give another file", list, read_frames(tmp / "a.aedat4"))
    store, part = davis(EVENTS, "dvs_msgs", False)
    write_bag(tmp / "bag", {"/events": part}, store, False)
    refuses("its topics are .*: give one", read_imu, tmp / "bag", topic="/c")
    assert list(read_imu(tmp / "bag")) == []
    with h5py.File(tmp / "b.h5", "w") as file:
        file["here/image_raw"], file["here/image_raw_ts"] = np.zeros((2, 4, 5), "u1"), np.arange(2.0)
        file["bad/image_raw"] = np.zeros((2, 4, 5), "u1")
    refuses("image_raw; give group", list, read_frames(tmp / "b.h5"))
    refuses("give group, or another file", list, read_frames(tmp / "b.h5", group="bad"))
    assert len(list(read_frames(tmp / "b.h5", group="here"))) == 2


# What the caller changes in the data.


def recoded(tmp: Path) -> None:
    refused("got 7; recode it", save(tmp / "a.npz", p=COLUMNS["p"] * 7))
    refused("recode it as 0 and 1", save(tmp / "a.npz", p=np.arange(N) % 3 - 1))
    reads(save(tmp / "a.npz", p=(np.arange(N) % 3 > 1).astype("u1")))
    zero = EVENTS.copy()
    zero["p"] = COLUMNS["p"]
    unwritten("polarities must be -1 or \\+1; recode them", tmp / "b.npz", zero)
    unwritten("outside a sensor of 9x48; give its size", tmp / "b.npz", EVENTS, 9)


def shifted(tmp: Path) -> None:
    unwritten("shift them", tmp / "a.npz", later(1 << 52))
    refused(r"not below 2\*\*62 .*; shift them", hdf5(tmp / "a.h5", t=(1 << 63) + EVENTS["t"].astype("u8")))
    unwritten("subtract the time of the first event", tmp / "c.dat", later(1 << 40))
    refused("else shift them", save(tmp / "b.npz", t=EVENTS["t"] + (1 << 52)))
    refused("t must lie in .*; shift the times", save(tmp / "b.npz", t=EVENTS["t"] - 90_000))
    signed = save(tmp / "b.npz", x=EVENTS["x"].astype(int) - 60)
    refused("x must lie in .*; coordinates count from 0", signed)
    first = later(-int(EVENTS["t"][0]))
    write_events(tmp / "c.dat", first, 64, 48)
    reads(tmp / "c.dat")
    reads(save(tmp / "b.npz", t=first["t"]))


def rounded(tmp: Path) -> None:
    refused("x must be whole pixels.*round them", save(tmp / "a.npz", x=EVENTS["x"] + 0.5))
    reads(save(tmp / "a.npz", x=np.floor(EVENTS["x"] + 0.5)))


def in_order(tmp: Path) -> None:
    swapped = EVENTS[::-1].copy()
    unwritten("is older than the one before it", tmp / "a.npz", swapped)
    write_events(tmp / "a.npz", np.sort(swapped, order="t", kind="stable"), 64, 48)

    def write_parts(*parts: np.ndarray) -> None:
        with event_writer(tmp / "b.npz", 64, 48) as write:
            for part in parts:
                write(part)

    refuses("sort the parts", write_parts, EVENTS[100:], EVENTS[:100])
    assert not (tmp / "b.npz").exists()
    write_parts(EVENTS[:100], EVENTS[100:])
    reads(tmp / "b.npz")
    back = np.tile(np.arange(0, 5_000_000, 10_000), 40)
    n = np.arange(len(back))
    arrays = {"x": n % 64, "y": n % 48, "p": n % 2}
    refused("check format, columns and time_unit, or sort", save(tmp / "c.npz", t=back, **arrays))
    reads(save(tmp / "c.npz", t=np.sort(back), **arrays), len(back))


def saved_again(tmp: Path) -> None:
    path = tmp / "a.npz"
    refused("different lengths .*save one entry per event", save(path, x=EVENTS["x"][1:]))
    refused("save it again", save(path, width=np.arange(3)))
    refused("array p has dtype object .*; save numbers", save(path, p=EVENTS["p"].astype(object)))
    refused("repair or remove it", save(path, is_noise=np.full(N, 7)))
    reads(save(path, is_noise=np.zeros(N, bool)))
    reads(save(path))
    np.savez(path, rows=np.asfortranarray(ROWS))
    refused("save np.ascontiguousarray of it", path)
    np.savez(path, rows=np.ascontiguousarray(np.asfortranarray(ROWS)))
    reads(path, columns=("x", "y", "t", "p"))
    head = b"# columns: t x y p\n# time_unit: us\n1 2 3 1\n"
    refused("no row of numbers .*repair or remove it", written(tmp / "b.txt", head + b"three\n4 5 6 0\n"))
    reads(written(tmp / "b.txt", head + b"4 5 6 0\n"), 2)


def written_again(tmp: Path) -> None:
    """What is written again is the file of a round trip, so only refusals are here."""
    with h5py.File(hdf5(tmp / "a.h5"), "a") as file:
        del file["events/x"]
        file.create_dataset("events/x", data=EVENTS["x"], chunks=(N,), scaleoffset=0)
    refused("write it again with blosc or gzip", tmp / "a.h5")
    write_events(tmp / "b.h5", EVENTS, 64, 48)
    with h5py.File(tmp / "b.h5", "a") as file:
        file["events/x"].id.write_direct_chunk((0,), bytes(3))
    refused("chunk without its checksum.*; copy or write it again", tmp / "b.h5")
    with h5py.File(hdf5(tmp / "c.h5"), "a") as file:
        del file["events/x"]
        packing = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        packing.set_chunk((N,))
        packing.set_fletcher32()
        packing.set_deflate(4)
        kind, space = h5py.h5t.py_create(EVENTS["x"].dtype), h5py.h5s.create_simple((N,))
        h5py.h5d.create(file["events"].id, b"x", kind, space, packing)
        file["events/x"][:] = EVENTS["x"]
    refused("events/x has its checksum within .*; write it again without fletcher32", tmp / "c.h5")
    dat, cochlea = "% Data file containing CD events.\n% Version {}\n% end\n", "chips.cochlea.CochleaAMS1c"
    for rule, content in (
        ("EVT2, EVT21 and EVT3 are read: write it again", "% evt 4.0\n% format EVT4;height=48;width=64\n"),
        ("little-endian ones are read: write it again", "% format EVT21;endianness=big;height=48;width=64\n"),
        ("version 2 is read: write it again", dat.format(9) + "\x0c\x08"),
        ("give the DAT file of brightness", dat.format(2) + "\x0e\x08"),
        ("of version 2 are read: write it again", "Event Stream\3\0\0\1"),
        ("write it again with jAER as one of these cameras", f"#!AER-DAT2.0\r\n# AEChip: {cochlea}\r\n"),
        ("RAW is read: save it as RAW", "#!AER-DAT3.1\r\n#Format: LZ4\r\n#!END-HEADER\r\n"),
    ):
        refused(rule, written(tmp / "a", content.encode() + bytes(64)))


def copied_again(tmp: Path) -> None:
    """Damage beyond what is tolerated; the same file undamaged is that of a round trip."""
    refused("is empty; record or copy it again", written(tmp / "empty.raw", b""))
    refused("cannot be opened .*; check the path", tmp / "missing.raw")
    npz = save(tmp / "a.npz").read_bytes()
    head = aedat3(tmp / "a.aedat", []).read_bytes()
    packet = struct.pack("<hhiiiiii", 1, 1, 8, 4, 0, -5, -5, -5)
    for rule, content in (
        ("no AEDAT 4.0 file .*; copy or record it again", b"#!AER-DAT4.0\r\n" + b"\xff" * 99),
        ("no readable array file .*; copy or save it again", b"PK\3\4" + b"\xff" * 100),
        ("before the end of its columns .*; copy it again", npz[: len(npz) // 2]),
        ("or damaged: copy it again", head.partition(b"#!END")[0]),
        ("copy or record it again", head + packet + bytes(64)),
    ):
        refused(rule, written(tmp / "a", content))
    write_recording(tmp / "a.h5", Recording(EVENTS, {}, {}))
    short = written(tmp / "b.h5", (tmp / "a.h5").read_bytes()[:2000])
    refuses(r"b\.h5 is no readable event recording .*collect it again", read_recording, short)


def another_format(tmp: Path) -> None:
    long = np.zeros(2, EVENT)
    long["t"], long["p"] = [0, 1 << 49], 1
    rule = "write parts of at most .* us, or choose npz"
    unwritten("choose npz or hdf5", tmp / "a.raw", long)
    unwritten(rule, tmp / "a.h5", long)
    refuses(rule, write_recording, tmp / "a.h5", Recording(long, {}, {}))
    unwritten(
        "stores no labels of noise; choose hdf5 or npz", tmp / "a.dat", EVENTS, is_noise=np.zeros(N, bool)
    )
    assert not list(tmp.iterdir())
    write_events(tmp / "a.npz", long, 64, 48)
    reads(tmp / "a.npz", 2)
    write_events(tmp / "b.npz", EVENTS, 64, 48, is_noise=np.zeros(N, bool))


def a_library_for_bags(tmp: Path) -> None:
    """`pip install NAME` names the package by which the import that failed is found."""
    store, part = davis(EVENTS, "dvs_msgs", False)
    write_bag(tmp / "bag", {"/events": part}, store, False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "rosbags", None)
        refused("needs the library rosbags; pip install rosbags", tmp / "bag")
    found = packages_distributions()
    assert "rosbags" in found["rosbags"]
    assert "opencv-python-headless" in found.get("cv2", ["opencv-python-headless"])
    reads(tmp / "bag")


# Videos and folders of images.


def a_library_for_flow(tmp: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "cv2", None)
        unseen("needs OpenCV; pip install opencv-python-headless", tmp / "a", interpolate="flow")


def pictures(folder: Path, times: str | None = None) -> Path:
    """Four images, and a list if there is text for one."""
    folder.mkdir(exist_ok=True)
    for number in range(4):
        Image.fromarray(np.full((48, 64), 40 + 40 * number, np.uint8)).save(folder / f"{number}.png")
    if times is not None:
        (folder / "images.txt").write_text(times)
    return folder


def sees(path: Path, **options: Any) -> None:
    assert len(video_to_events(path, CameraConfig(width=16, height=12), **options).events)


def of_lists(tmp: Path) -> None:
    folder = pictures(tmp / "a")
    unseen("write images.txt with lines 'time name', or give fps", folder)
    sees(folder, fps=10.0)
    sees(pictures(folder, "0 0.png\n1 1.png\n"))
    unseen("lists images; give its folder", folder / "images.txt")
    (folder / "1.gif").write_bytes((folder / "1.png").read_bytes())
    for line, rule in (
        ("", "has 1 images.* give 2 to .* of "),
        ("x 1.png", "repair it, or give fps"),
        ("1 ../b.png", "not inside its folder; copy it there"),
        ("1 1.gif", "no image of the kinds .*; convert it"),
    ):
        unseen(rule, pictures(folder, f"0 0.png\n{line}\n"))
    (folder / "images.txt").write_bytes(b"\xff\xff")
    unseen("is not UTF-8 text.*; write it again", folder)
    sees(pictures(folder, "0 0.png\n1 1.png\n"))


def of_images(tmp: Path) -> None:
    folder = pictures(tmp / "a")
    (folder / "timestamps.txt").write_text("0\n1\n")
    unseen("write one line an image, or give fps", folder)
    (folder / "timestamps.txt").write_text("0\n1\n2\n3\n")
    sees(folder)
    Image.fromarray(np.zeros((48, 64), np.uint8)).save(folder / "9.jpg")
    unseen("convert one", folder, fps=5.0)
    (folder / "9.jpg").unlink()
    Image.fromarray(np.zeros((24, 64), np.uint8)).save(folder / "3.png")
    unseen("convert them to one", folder)
    unseen("copy or encode it again", written(folder / "3.png", b"none").parent)
    (folder / "3.png").unlink()  # after the folder was listed
    images = [folder / f"{number}.png" for number in range(4)]
    refuses("copy or convert it again", list, decoded_images(images))
    sees(pictures(folder))
    frames = np.full((3, 12, 16, 3), 0.5, np.float32)
    frames[1, 0, 0] = np.nan
    unseen("values that are not finite; replace them", save_images(tmp / "b", frames, ".exr"), fps=5.0)
    sees(save_images(tmp / "b", np.nan_to_num(frames), ".exr"), fps=5.0)


def video(path: Path, *words: str, count: int = 6) -> Path:
    frames = np.stack([np.full((48, 64), 40 + 20 * k, np.uint8) for k in range(count)])
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-v", "error", "-f", "rawvideo", "-pix_fmt", "gray"]
    command += ["-s", "64x48", "-r", "25", "-i", "-", *words, str(path)]
    subprocess.run(command, input=frames.tobytes(), check=True)
    return path


def of_videos(tmp: Path) -> None:
    none = written(tmp / "a.mp4", b"no video" * 99)
    unseen("encode it again as mp4, or as images that are named in docs", none)
    busy = video(tmp / "a.mp4")
    sees(busy)
    whole = video(tmp / "b.mkv", "-c:v", "ffv1").read_bytes()
    cut = written(tmp / "b.mkv", whole[: len(whole) * 8 // 10])
    refuses("copy or encode it again|its last frame is not whole; encode it again", list, video_steps(cut))
    sees(written(cut, whole))
    unseen("events need at least two", video(tmp / "c.mp4", count=1))
    sees(video(tmp / "c.mp4", count=2))
    times = ["-vf", "settb=1/1000,setpts=5", "-fps_mode", "passthrough", "-enc_time_base", "1/1000"]
    same = video(tmp / "d.mkv", *times, "-c:v", "ffv1")
    unseen("encode the video again at a constant frame rate, or give fps", same)
    sees(same, fps=25.0)
    unseen("raise max_events, or take them frame by frame from video_steps and write", busy, max_events=5)
    camera = CameraConfig(width=64, height=48)
    with event_writer(tmp / "e.npz", 64, 48) as write:
        for step in video_steps(busy, camera):
            write(step.events)
    reads(tmp / "e.npz", len(video_to_events(busy, camera, max_events=10**7).events))


OF_FILES = (
    of_options, other_formats, other_files, recoded, shifted, rounded, in_order, saved_again,
    written_again, copied_again, another_format, a_library_for_bags,
)  # fmt: skip
OF_PICTURES = (a_library_for_flow, of_lists, of_images, of_videos)
PICTURES = ("decoder", "image_folder", "in_between", "light", "video")  # modules
# No remedy of the caller's, or one that is tried elsewhere.
ELSEWHERE_OF_FILES = {
    "at most {} are read": "of an inner error; its outer one is tried",
    "at most {} are unpacked": "the same",
    "read a part by start_us and end_us, or lower max_events": "memory runs out; ranges are tried above",
    "give the folder or a file of a rosbag2": "an empty folder is refused before as no recording",
    "{} are read: convert them": "images of a bag: test_ros.py",
    "{} are read: record it with one": "packets of a bag: test_ros.py",
    "later times were moved to follow": "a kind of damage",
}
ELSEWHERE_OF_PICTURES = {
    "encode it again": "of a last frame that is not whole, or that does not come",
    "encode it again at a constant frame rate": "a frame without time, which no muxer here writes",
    "record at a higher frame rate, or read docs/recordings.md": "test_video_noise.py, a warning",
}


@pytest.mark.parametrize(
    ("trials", "elsewhere"),
    [(OF_FILES, ELSEWHERE_OF_FILES), (OF_PICTURES, ELSEWHERE_OF_PICTURES)],
    ids=["files", "pictures"],
)
def test_every_remedy_that_a_message_names_is_tried_and_works(trials, elsewhere, tmp_path):
    SAID.clear()
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        for trial in trials:
            (tmp_path / trial.__name__).mkdir()
            trial(tmp_path / trial.__name__)
    said = "\n".join([*SAID, *(str(one.message) for one in warned)])
    untried = {ending for ending in endings(trials is OF_PICTURES) if not is_said(ending, said)}
    assert untried == set(elsewhere)


def is_said(ending: str, said: str) -> bool:
    """Whether a message ended so, or the part of one in brackets."""
    text = ".*".join(map(re.escape, ending.split("{}")))
    return bool(re.search(rf"; {text}(\)|\.?$|\. )", said, re.MULTILINE))


def shown(node: ast.AST) -> str:
    """The text of a message with {} where values come."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(shown(part) if isinstance(part, ast.Constant) else "{}" for part in node.values)
    return ""


def endings(of_pictures: bool) -> set[str]:
    """The endings of the messages of `envs/recordings`, behind their last semicolon."""
    found = set()
    for path in Path(envs.recordings.__file__).parent.glob("*.py"):
        if (path.stem in PICTURES) != of_pictures:
            continue
        nodes = list(ast.walk(ast.parse(path.read_text())))
        parts = {id(part) for node in nodes if isinstance(node, ast.JoinedStr) for part in node.values}
        for node in nodes:
            text = shown(node) if id(node) not in parts else ""
            if "; " in text and "\n" not in text and not text.endswith("."):
                found.add(text.rsplit("; ", 1)[1])
    return found - {""}
