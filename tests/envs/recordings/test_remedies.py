"""Every remedy that a refusal of a reader or writer of recordings names is tried here, and works.

`TRIALS` has each ending of a message of `envs/recordings`; the last test finds them in the sources. A trial
makes the refusal, does what it says, and reads the events.
"""

import ast
import struct
import subprocess
import sys
from collections.abc import Callable
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
    event_writer,
    read_events,
    read_frames,
    video_to_events,
    write_events,
)
from envs.recordings.beside import read_imu
from envs.recordings.hdf5 import Recording, read_recording, write_recording
from envs.recordings.video import video_steps
from tests.support.bags import array_message, davis, store_of, write_bag
from tests.support.event_files import aedat2, aedat3, some_events

EVENTS = some_events(0, 200, 64, 48, 100_000)
N = len(EVENTS)
COLUMNS = {name: EVENTS[name] for name in "txy"} | {"p": (EVENTS["p"] > 0).astype("u1")}
ROWS = np.stack([COLUMNS[name] for name in "xytp"], 1)
SIZE = {"width": 64, "height": 48}
US = {"time_unit": "us"}


def refused(rule: str, call: Callable[[], Any]) -> None:
    """The call is refused with this in its message."""
    with pytest.raises(ValueError, match=rule):
        call()


def reads(path: Path, count: int = N, **options: Any) -> None:
    assert len(read_events(path, **options).events) == count


def save(path: Path, **arrays: np.ndarray) -> Path:
    np.savez(path, **(COLUMNS | arrays))
    return path


def raw(path: Path, header: str = "", words: bytes = b"") -> Path:
    """A file of a Prophesee camera with a header and words, or the words of `EVENTS`."""
    if not words:
        write_events(path, EVENTS, 64, 48, "evt3")
        words = path.read_bytes().partition(b"% end\n")[2]
    path.write_bytes(header.encode() + words)
    return path


def hdf5(path: Path, group: str = "events", **arrays: Any) -> Path:
    with h5py.File(path, "w") as file:
        for name, values in (COLUMNS | arrays).items():
            file[f"{group}/{name}"] = values
    return path


# Options that a message names.


def say_format(tmp: Path) -> None:
    path = tmp / "a.bin2"
    path.write_bytes(b"\0\1\2\3" * 10)
    refused("give format as one of aedat2", lambda: read_events(path))
    aedat2(tmp / "b", [(x << 1 | y << 8, t) for t, x, y, _ in EVENTS.tolist()])
    (tmp / "c").write_bytes((tmp / "b").read_bytes().partition(b"\r\n")[2])
    refused("give format as one of aedat2", lambda: read_events(tmp / "c"))
    reads(tmp / "c", format="aedat2")
    name = raw(tmp / "d.raw")
    refused("names no encoding; give format='evt2'", lambda: read_events(name))
    reads(name, format="evt3")
    refused("no file of a Prophesee camera, or damaged: give its format",
            lambda: read_events(aedat_without_end(tmp / "e", b"% x"), "evt3"))  # fmt: skip
    refused("no AEDAT 2.0 file, or damaged: give its format",
            lambda: read_events(aedat_without_end(tmp / "e", b"#!AER-DAT2.0"), "aedat2"))  # fmt: skip
    write_events(tmp / "f.dat", EVENTS, 64, 48)
    for wrong, rule in (
        ("es", "so it is none; give its format"),
        ("ros", "give its format, or leave format"),
    ):
        refused(rule, lambda wrong=wrong: read_events(tmp / "f.dat", wrong))
    refused("is not UTF-8 text .*; give the format", lambda: read_events(binary_text(tmp / "g.txt")))
    (tmp / "h.txt").write_bytes(b"1" * 2000)
    refused("so it is no text; give its format", lambda: read_events(tmp / "h.txt"))
    reads(tmp / "f.dat", format="dat")
    reads(tmp / "f.dat")


def aedat_without_end(path: Path, head: bytes) -> Path:
    path.write_bytes(head + b"x" * 70_000)
    return path


def binary_text(path: Path) -> Path:
    path.write_bytes(b"\xff\xfe\xfa" * 20)
    return path


def another_encoding(tmp: Path) -> None:
    write_events(tmp / "a.raw", EVENTS, 64, 48, "evt2")
    words = (tmp / "a.raw").read_bytes().partition(b"% end\n")[2]
    path = raw(tmp / "b.raw", "", words)
    refused("or of another encoding: give format as evt2", lambda: read_events(path, "evt3"))
    reads(path, format="evt2")


def leave_out(tmp: Path) -> None:
    write_events(tmp / "a.raw", EVENTS, 64, 48)
    refused(
        "says evt3 and the caller says evt2; leave format out", lambda: read_events(tmp / "a.raw", "evt2")
    )
    refused("says width=64 .*leave width out", lambda: read_events(tmp / "a.raw", width=9))
    refused("topic has no effect on evt.* leave topic out", lambda: read_events(tmp / "a.raw", topic="a"))
    reads(tmp / "a.raw")
    write_events(tmp / "a.npz", EVENTS, 64, 48)
    refused("time_unit=us .* says s; leave time_unit out", lambda: read_events(tmp / "a.npz", time_unit="s"))
    reads(tmp / "a.npz")
    store, part = davis(EVENTS, "dvs_msgs", False)
    write_bag(tmp / "bag", {"/events": part}, store, False)
    refused("no evt3 file; leave format out", lambda: read_events(tmp / "bag", "evt3"))
    reads(tmp / "bag")


def larger_limits(tmp: Path) -> None:
    path = save(tmp / "a.npz")
    refused("raise max_bytes", lambda: read_events(path, max_bytes=10))
    reads(path, max_bytes=1 << 30)
    refused(
        "raise max_events, or read a part by start_us and end_us", lambda: read_events(path, max_events=9)
    )
    reads(path, max_events=N)
    early = int(np.sum(EVENTS["t"] < 2_000))
    reads(path, early, max_events=max(9, early), end_us=2_000)


def right_size(tmp: Path) -> None:
    path = save(tmp / "a.npz")
    refused("give the right width and height", lambda: read_events(path, width=9, height=9))
    reads(path, **SIZE)
    entries = [(y << 22 | x << 12 | (p > 0) << 11, t) for t, x, y, p in EVENTS.tolist()]
    aedat2(tmp / "b.aedat", entries)
    refused("give width and height of one", lambda: read_events(tmp / "b.aedat"))
    reads(tmp / "b.aedat", width=346, height=260)
    refused("outside a sensor of 9x9; give its size", lambda: write_events(tmp / "c.npz", EVENTS, 9, 9))
    write_events(tmp / "c.npz", EVENTS, 64, 48)


def not_strict(tmp: Path) -> None:
    write_events(tmp / "a.dat", EVENTS, 64, 48)
    with (tmp / "a.dat").open("ab") as file:
        file.write(b"abc")
    refused("read it without strict", lambda: read_events(tmp / "a.dat", strict=True))
    reads(tmp / "a.dat")


def columns_of_text(tmp: Path) -> None:
    path = tmp / "a.csv"
    path.write_text("".join(f"{x},{y},{p},{t}\n" for x, y, t, p in ROWS.tolist()))
    refused(r"give columns=\('t', 'x', 'y', 'p'\) .* and time_unit", lambda: read_events(path))
    refused("give time_unit as one of s, ms, us, ns", lambda: read_events(path, columns=tuple("xypt")))
    reads(path, columns=tuple("xypt"), time_unit="us")
    path.write_text("t_us,x,y,p,p\n" + "".join(f"{t},{x},{y},{p},7\n" for x, y, t, p in ROWS.tolist()))
    refused("names the column p twice; give columns= with one", lambda: read_events(path))
    reads(path, columns=("t", "x", "y", "p", "other"), time_unit="us")


def columns_of_arrays(tmp: Path) -> None:
    np.save(tmp / "a.npy", ROWS[::-1])
    refused(r"give columns= in their order, such as \('x'", lambda: read_events(tmp / "a.npy"))
    reads(tmp / "a.npy", columns=("x", "y", "t", "p"))
    table = np.array([tuple(row) for row in ROWS.tolist()], [(name, "i8") for name in "uvws"])
    np.save(tmp / "b.npy", table)
    refused("give columns= with those of t, x, y, p", lambda: read_events(tmp / "b.npy"))
    reads(tmp / "b.npy", columns=("w", "u", "v", "s"))
    np.savez(tmp / "c.npz", a=COLUMNS["t"], b=COLUMNS["x"], c=COLUMNS["y"], d=COLUMNS["p"], e=ROWS)
    (tmp / "d.npz").write_bytes((tmp / "c.npz").read_bytes())
    np.savez(tmp / "d.npz", a=COLUMNS["t"], b=COLUMNS["x"], c=COLUMNS["y"], d=COLUMNS["p"])
    refused("give columns= with the names of the arrays", lambda: read_events(tmp / "d.npz"))
    reads(tmp / "d.npz", columns=tuple("abcd"))
    refused("give group as one", lambda: read_events(tmp / "c.npz", group="nowhere"))
    reads(tmp / "c.npz", group="e", columns=("x", "y", "t", "p"))


def places_in_hdf5(tmp: Path) -> None:
    with h5py.File(tmp / "a.h5", "w") as file:
        for name, values in COLUMNS.items():
            file[f"deep/{name * 2}"] = values
    refused("give group= with the path of the group or data set of", lambda: read_events(tmp / "a.h5"))
    refused("give group= with the path of a group", lambda: read_events(tmp / "a.h5", group="other"))
    reads(tmp / "a.h5", group="deep", columns=("tt", "xx", "yy", "pp"))
    hdf5(tmp / "b.h5", t=EVENTS["t"] * 1.0000001e-6)
    refused("are no whole microseconds; give time_unit", lambda: read_events(tmp / "b.h5"))
    reads(tmp / "b.h5", time_unit="s")
    hdf5(tmp / "c.h5", t=(1 << 63) + EVENTS["t"].astype("u8"))
    refused("not below 2\\*\\*62 with their offset; shift them", lambda: read_events(tmp / "c.h5"))
    reads(hdf5(tmp / "c.h5"))
    for side in ("left", "right"):
        with h5py.File(tmp / "d.h5", "a") as file:
            for name, values in COLUMNS.items():
                file[f"prophesee/{side}/{name}"] = values
    with pytest.warns(UserWarning, match="group= chooses another of prophesee/left, prophesee/right"):
        read_events(tmp / "d.h5")
    reads(tmp / "d.h5", group="prophesee/right")


def streams(tmp: Path) -> None:
    words = np.stack((EVENTS["x"].astype("<u4") << 17 | EVENTS["y"].astype("<u4") << 2 | 1, EVENTS["t"]), 1)
    body = words.astype("<u4").tobytes()
    two = "#Source 1: DVS128\r\n#Source 2: DVS128\r\n"
    path = aedat3(tmp / "a.aedat", [(1, 0, 8, body)], two)
    refused("give stream as one of", lambda: read_events(path, stream=7))
    with pytest.warns(UserWarning, match="stream= chooses"):
        read_events(path)
    reads(path, stream=1)
    write_events(tmp / "b.aedat4", EVENTS, 64, 48)
    refused(
        "its streams are 0 .*: give stream as one of that kind",
        lambda: read_events(tmp / "b.aedat4", stream=7),
    )
    reads(tmp / "b.aedat4", stream=0)
    refused("no stream of kind FRME; give another file", lambda: list(read_frames(tmp / "b.aedat4")))


def topics(tmp: Path) -> None:
    store = store_of("dvs_msgs", False)
    message = array_message(store, "dvs_msgs", EVENTS, False)
    kind = "dvs_msgs/msg/EventArray"
    write_bag(tmp / "bag", {"/a": (kind, [message]), "/b": (kind, [message])}, store, False)
    refused("its topics are /a .*: give topic as one of events", lambda: read_events(tmp / "bag", topic="/c"))
    with pytest.warns(UserWarning, match="topic= chooses"):
        read_events(tmp / "bag")
    reads(tmp / "bag", topic="/b")
    refused("its topics are .*: give one", lambda: list(read_imu(tmp / "bag", topic="/c")))
    assert list(read_imu(tmp / "bag")) == []
    (tmp / "empty").mkdir()
    refused("is no regular file; give the path of one recording", lambda: read_events(tmp / "empty"))
    reads(next((tmp / "bag").glob("*.db3")), topic="/a")


def other_files(tmp: Path) -> None:
    write_events(tmp / "a.dat", EVENTS, 64, 48)
    refused("aedat3, aedat4, hdf5, ros files have them", lambda: list(read_frames(tmp / "a.dat")))
    with h5py.File(tmp / "b.h5", "w") as file:
        file["here/image_raw"], file["here/image_raw_ts"] = np.zeros((2, 4, 5), "u1"), np.arange(2.0)
        file["bad/image_raw"] = np.zeros((2, 4, 5), "u1")
    refused("image_raw; give group", lambda: list(read_frames(tmp / "b.h5")))
    refused("give group, or another file", lambda: list(read_frames(tmp / "b.h5", group="bad")))
    assert len(list(read_frames(tmp / "b.h5", group="here"))) == 2


# What the caller changes in the data.


def recoded(tmp: Path) -> None:
    refused("got 7; recode it", lambda: read_events(save(tmp / "a.npz", p=COLUMNS["p"] * 7)))
    refused("recode it as 0 and 1", lambda: read_events(save(tmp / "a.npz", p=np.arange(N) % 3 - 1)))
    reads(save(tmp / "a.npz", p=(np.arange(N) % 3 > 1).astype("u1")))
    zero = EVENTS.copy()
    zero["p"] = COLUMNS["p"]
    refused("polarities must be -1 or \\+1; recode them", lambda: write_events(tmp / "b.npz", zero, 64, 48))
    zero["p"] = np.where(zero["p"] > 0, 1, -1)
    write_events(tmp / "b.npz", zero, 64, 48)


def shifted(tmp: Path) -> None:
    late = EVENTS.copy()
    late["t"] += 1 << 52
    refused("shift them", lambda: write_events(tmp / "a.npz", late, 64, 48))
    refused("else shift them", lambda: read_events(save(tmp / "b.npz", t=late["t"])))
    refused("x must lie in .*; coordinates count from 0",
            lambda: read_events(save(tmp / "b.npz", x=EVENTS["x"].astype(int) - 60)))  # fmt: skip
    refused(
        "t must lie in .*; shift the times", lambda: read_events(save(tmp / "b.npz", t=EVENTS["t"] - 90_000))
    )
    refused(
        "subtract the time of the first event", lambda: write_events(tmp / "c.dat", late_by(1 << 40), 64, 48)
    )
    late["t"] -= late["t"][0]
    write_events(tmp / "c.dat", late, 64, 48)
    reads(tmp / "c.dat")
    reads(save(tmp / "b.npz", t=late["t"]))


def late_by(us: int) -> np.ndarray:
    events = EVENTS.copy()
    events["t"] += us
    return events


def rounded(tmp: Path) -> None:
    refused(
        "x must be whole pixels.*round them", lambda: read_events(save(tmp / "a.npz", x=EVENTS["x"] + 0.5))
    )
    reads(save(tmp / "a.npz", x=np.floor(EVENTS["x"] + 0.5)))


def in_order(tmp: Path) -> None:
    swapped = EVENTS[::-1].copy()
    refused("is older than the one before it", lambda: write_events(tmp / "a.npz", swapped, 64, 48))
    write_events(tmp / "a.npz", np.sort(swapped, order="t", kind="stable"), 64, 48)

    def twice() -> None:
        with event_writer(tmp / "b.npz", 64, 48) as write:
            write(EVENTS[100:])
            write(EVENTS[:100])

    refused("sort the parts", twice)
    with event_writer(tmp / "b.npz", 64, 48) as write:
        write(EVENTS[:100])
        write(EVENTS[100:])
    reads(tmp / "b.npz")
    back = np.concatenate([np.arange(0, 5_000_000, 1000) for _ in range(40)])
    n = np.arange(len(back))
    arrays = {"x": n % 64, "y": n % 48, "p": n % 2}
    refused(
        "check format, columns and time_unit, or sort",
        lambda: read_events(save(tmp / "c.npz", t=back, **arrays)),
    )
    reads(save(tmp / "c.npz", t=np.sort(back), **arrays), len(back))


def saved_again(tmp: Path) -> None:
    path = tmp / "a.npz"
    refused(
        "different lengths .*save one entry per event", lambda: read_events(save(path, x=EVENTS["x"][1:]))
    )
    np.savez(path, rows=np.asfortranarray(ROWS))
    refused("save np.ascontiguousarray of it", lambda: read_events(path))
    np.savez(path, rows=np.ascontiguousarray(np.asfortranarray(ROWS)))
    reads(path, columns=("x", "y", "t", "p"))
    refused("save it again", lambda: read_events(save(path, width=np.arange(3))))
    refused(
        "array p has dtype object .*; save numbers",
        lambda: read_events(save(path, p=EVENTS["p"].astype(object))),
    )
    refused("repair or remove it", lambda: read_events(save(path, is_noise=np.full(N, 7))))
    reads(save(path, is_noise=np.zeros(N, bool)))
    reads(save(path))
    (tmp / "b.txt").write_text("# columns: t x y p\n# time_unit: us\n1 2 3 1\nthree\n4 5 6 0\n")
    refused("no row of numbers .*repair or remove it", lambda: read_events(tmp / "b.txt"))
    (tmp / "b.txt").write_text("# columns: t x y p\n# time_unit: us\n1 2 3 1\n4 5 6 0\n")
    reads(tmp / "b.txt", 2)


def written_again(tmp: Path) -> None:
    with h5py.File(hdf5(tmp / "a.h5"), "a") as file:
        del file["events/x"]
        file.create_dataset("events/x", data=EVENTS["x"], chunks=(N,), scaleoffset=0)
    refused("write it again with blosc or gzip", lambda: read_events(tmp / "a.h5"))
    with h5py.File(tmp / "a.h5", "a") as file:
        del file["events/x"]
        file.create_dataset("events/x", data=EVENTS["x"], compression="gzip")
    reads(tmp / "a.h5")
    refused("chunk without its checksum.*; copy or write it again",
            lambda: read_events(short_chunk(tmp / "b.h5")))  # fmt: skip
    write_events(tmp / "b.h5", EVENTS, 64, 48)
    reads(tmp / "b.h5")
    with h5py.File(tmp / "c.h5", "w") as file:
        packing = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        packing.set_chunk((N,))
        packing.set_fletcher32()
        packing.set_deflate(4)
        for name, values in COLUMNS.items():
            kind, space = h5py.h5t.py_create(values.dtype), h5py.h5s.create_simple((N,))
            h5py.h5d.create(file.require_group("events").id, name.encode(), kind, space, packing)
            file[f"events/{name}"][:] = values
    refused("write it again without fletcher32", lambda: read_events(tmp / "c.h5"))
    reads(hdf5(tmp / "c.h5"))
    for header, rule in (
        (
            "% evt 4.0\n% format EVT4;height=48;width=64\n% end\n",
            "EVT2, EVT21 and EVT3 are read: write it again",
        ),
        (
            "% format EVT21;endianness=big;height=48;width=64\n% end\n",
            "little-endian ones are read: write it again",
        ),
    ):
        refused(rule, lambda header=header: read_events(raw(tmp / "d.raw", header, bytes(64))))
    head = "% Data file containing CD events.\n% Version 9\n% end\n"
    refused(
        "version 2 is read: write it again",
        lambda: read_events(raw(tmp / "d.dat", head, b"\x0c\x08" + bytes(64))),
    )
    head = head.replace("9", "2")
    refused(
        "give the DAT file of brightness",
        lambda: read_events(raw(tmp / "d.dat", head, b"\x0e\x08" + bytes(64))),
    )
    (tmp / "e.es").write_bytes(b"Event Stream" + bytes((2, 0, 0, 0)) + bytes(20))
    refused("of version 2 are read: write it again", lambda: read_events(tmp / "e.es"))
    for suffix in ("raw", "dat"):
        write_events(tmp / f"d.{suffix}", EVENTS, 64, 48)
        reads(tmp / f"d.{suffix}")
    chip = aedat2(tmp / "f.aedat", [(0, t) for t in range(5)], "eu.seebetter.ini.chips.cochlea.CochleaAMS1c")
    refused("write it again with jAER as one of these cameras", lambda: read_events(chip))
    reads(aedat2(tmp / "f.aedat", [(0, t) for t in range(5)], "eu.seebetter.ini.chips.davis.Davis346blue"), 5)
    aedat3(tmp / "g.aedat", [])
    (tmp / "g.aedat").write_bytes((tmp / "g.aedat").read_bytes().replace(b"RAW", b"LZ4"))
    refused("RAW is read: save it as RAW", lambda: read_events(tmp / "g.aedat"))


def short_chunk(path: Path) -> Path:
    write_events(path, EVENTS, 64, 48)
    with h5py.File(path, "a") as file:
        file["events/x"].id.write_direct_chunk((0,), bytes(3))
    return path


def copied_again(tmp: Path) -> None:
    """Damage beyond what is tolerated: the same file undamaged is read."""
    (tmp / "empty.raw").touch()
    refused("is empty; record or copy it again", lambda: read_events(tmp / "empty.raw"))
    refused("cannot be opened .*; check the path", lambda: read_events(tmp / "missing.raw"))
    write_events(tmp / "a.aedat4", EVENTS, 64, 48)
    whole = (tmp / "a.aedat4").read_bytes()
    (tmp / "a.aedat4").write_bytes(whole[:14] + b"\xff" * (len(whole) - 14))
    refused("no AEDAT 4.0 file .*; copy or record it again", lambda: read_events(tmp / "a.aedat4"))
    (tmp / "a.aedat4").write_bytes(whole)
    reads(tmp / "a.aedat4")
    (tmp / "b.npz").write_bytes(b"PK\3\4" + b"\xff" * 100)
    refused("no readable array file .*; copy or save it again", lambda: read_events(tmp / "b.npz"))
    reads(save(tmp / "b.npz"))
    short = save(tmp / "b.npz").read_bytes()
    (tmp / "b.npz").write_bytes(short[: len(short) // 2])
    refused("was cut off before the end of its columns .*; copy it again", lambda: read_events(tmp / "b.npz"))
    reads(save(tmp / "b.npz"))
    path = aedat3(tmp / "c.aedat", [])
    path.write_bytes(path.read_bytes().partition(b"#!END")[0])
    refused("or damaged: copy it again", lambda: read_events(path))
    packet = struct.pack("<hhiiiiii", 1, 1, 8, 4, 0, -5, -5, -5)
    aedat3(path, [])
    path.write_bytes(path.read_bytes() + packet + bytes(64))
    refused("copy or record it again", lambda: read_events(path, strict=True))
    good = aedat3(path, [(1, 0, 8, struct.pack("<II", 1, 5))])
    reads(good, 1)
    recording = Recording(EVENTS, {}, {})
    write_recording(tmp / "d.h5", recording)
    short = (tmp / "d.h5").read_bytes()
    (tmp / "d.h5").write_bytes(short[:2000])
    refused("collect it again", lambda: read_recording(tmp / "d.h5"))
    write_recording(tmp / "d.h5", recording)
    assert len(read_recording(tmp / "d.h5").events) == N


def another_format(tmp: Path) -> None:
    long = np.zeros(2, EVENT)
    long["t"], long["p"] = [0, 1 << 49], 1
    refused("choose npz or hdf5", lambda: write_events(tmp / "a.raw", long, 64, 48))
    refused("write parts of at most .* us, or choose npz", lambda: write_events(tmp / "a.h5", long, 64, 48))
    with pytest.raises(ValueError, match=r"write parts of at most .* us, or choose npz"):
        write_recording(tmp / "a.h5", Recording(long, {}, {}))
    write_events(tmp / "a.npz", long, 64, 48)
    reads(tmp / "a.npz", 2)
    labels = {"is_noise": np.zeros(N, bool)}
    refused(
        "stores no labels of noise; choose hdf5 or npz",
        lambda: write_events(tmp / "b.raw", EVENTS, 64, 48, **labels),
    )
    write_events(tmp / "b.npz", EVENTS, 64, 48, **labels)


def missing_libraries(tmp: Path) -> None:
    """`pip install NAME` names a package by which the import that failed is found."""
    from importlib.metadata import packages_distributions

    found = packages_distributions()
    assert "rosbags" in found["rosbags"]
    assert {"opencv-python-headless"} & set(found.get("cv2", ["opencv-python-headless"]))
    store, part = davis(EVENTS, "dvs_msgs", False)
    write_bag(tmp / "bag", {"/events": part}, store, False)
    hide = "import sys; sys.modules['rosbags'] = sys.modules['cv2'] = None\n"
    code = f"{hide}from envs.recordings import read_events\nread_events({str(tmp / 'bag')!r})"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stderr
    assert "needs the library rosbags; pip install rosbags" in said
    reads(tmp / "bag")
    code = f"{hide}from envs.recordings import video_to_events\nvideo_to_events('a', interpolate='flow')"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stderr
    assert "pip install opencv-python-headless" in said


# Videos and folders of images.


def pictures(folder: Path, count: int = 4, suffix: str = "png", listed: bool = True) -> Path:
    folder.mkdir(exist_ok=True)
    for number in range(count):
        values = np.full((48, 64), 40 + 40 * number, np.uint8)
        Image.fromarray(values).save(folder / f"{number}.{suffix}")
    if listed:
        lines = [f"{number / 10} {number}.{suffix}\n" for number in range(count)]
        (folder / "images.txt").write_text("".join(lines))
    return folder


def sees(path: Path, **options: Any) -> None:
    assert len(video_to_events(path, CameraConfig(width=16, height=12), **options).events)


def of_images(tmp: Path) -> None:
    bare = pictures(tmp / "a", listed=False)
    refused("write images.txt with lines 'time name', or give fps", lambda: video_to_events(bare))
    sees(bare, fps=10.0)
    sees(pictures(bare))
    (bare / "images.txt").write_text("0 0.png\n")
    refused("give 2 to .* of ", lambda: video_to_events(bare))
    (bare / "images.txt").write_text("0 0.png\nx 1.png\n")
    refused("repair it, or give fps", lambda: video_to_events(bare))
    (bare / "images.txt").write_bytes(b"\xff\xff")
    refused("is not UTF-8 text.*; write it again", lambda: video_to_events(bare))
    (bare / "images.txt").write_text("0 0.png\n1 ../b.png\n")
    refused("not inside its folder; copy it there", lambda: video_to_events(bare))
    (bare / "images.txt").write_text("0 0.png\n1 1.gif\n")
    (bare / "1.gif").write_bytes((bare / "1.png").read_bytes())
    refused("no image of the kinds .*; convert it", lambda: video_to_events(bare))
    refused("lists images; give its folder", lambda: video_to_events(bare / "images.txt"))
    sees(pictures(bare))
    (bare / "times").mkdir()
    other = pictures(tmp / "b", listed=False)
    (other / "timestamps.txt").write_text("0\n1\n")
    refused("write one line an image, or give fps", lambda: video_to_events(other))
    (other / "timestamps.txt").write_text("0\n1\n2\n3\n")
    sees(other)
    Image.fromarray(np.zeros((48, 64), np.uint8)).save(other / "9.jpg")
    refused("convert one", lambda: video_to_events(other, fps=5.0))
    (other / "9.jpg").unlink()
    Image.fromarray(np.zeros((24, 64), np.uint8)).save(other / "3.png")
    refused("convert them to one", lambda: video_to_events(other))
    (other / "3.png").write_bytes(b"none")
    refused("copy or convert it again|is damaged or truncated", lambda: video_to_events(other))
    sees(pictures(other, listed=False))
    np.save(tmp / "c.npy", np.zeros(1))


def video(path: Path, *words: str, count: int = 6) -> Path:
    frames = np.stack([np.full((48, 64), 40 + 20 * k, np.uint8) for k in range(count)])
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-v", "error", "-f", "rawvideo", "-pix_fmt", "gray"]
    command += ["-s", "64x48", "-r", "25", "-i", "-", *words, str(path)]
    subprocess.run(command, input=frames.tobytes(), check=True)
    return path


def of_videos(tmp: Path) -> None:
    (tmp / "a.mp4").write_bytes(b"no video" * 99)
    refused(
        "encode it again as mp4, or as images that are named in docs", lambda: video_to_events(tmp / "a.mp4")
    )
    sees(video(tmp / "a.mp4"))
    whole = video(tmp / "b.mkv", "-c:v", "ffv1").read_bytes()
    (tmp / "b.mkv").write_bytes(whole[: len(whole) * 8 // 10])
    refused("(copy or encode it again|its last frame is not whole; encode it again)",
            lambda: list(video_steps(tmp / "b.mkv")))  # fmt: skip
    (tmp / "b.mkv").write_bytes(whole)
    sees(tmp / "b.mkv")
    one = video(tmp / "c.mp4", count=1)
    refused("events need at least two", lambda: video_to_events(one))
    sees(video(tmp / "c.mp4", count=2))
    times = ["-vf", "settb=1/1000,setpts=5", "-fps_mode", "passthrough", "-enc_time_base", "1/1000"]
    same = video(tmp / "d.mkv", *times, "-c:v", "ffv1")
    refused("encode the video again at a constant frame rate, or give fps", lambda: video_to_events(same))
    sees(same, fps=25.0)
    busy = video(tmp / "e.mp4")
    refused("raise max_events, or take them frame by frame from video_steps and write them with event_writer",
            lambda: video_to_events(busy, max_events=5))  # fmt: skip
    camera = CameraConfig(width=64, height=48)
    with event_writer(tmp / "e.npz", 64, 48) as write:
        for step in video_steps(busy, camera):
            write(step.events)
    reads(tmp / "e.npz", len(video_to_events(busy, camera, max_events=10**7).events))


def finite_frames(tmp: Path) -> None:
    cv2 = pytest.importorskip("cv2", reason="writes images of floating point")
    folder = tmp / "a"
    folder.mkdir()
    for number in range(3):
        values = np.full((12, 16, 3), 0.1 + 0.2 * number, np.float32)
        values[0, 0] = np.nan if number == 1 else 0.5
        cv2.imwrite(str(folder / f"{number}.exr"), values)
    refused("values that are not finite; replace them", lambda: video_to_events(folder, fps=5.0))


# The trials of remedies, with the endings of the messages.
TRIALS = {
    say_format: (
        "give format as one of {}", "give format='evt2', 'evt21', 'evt3' or 'dat'", "give its format",
        "it is no AEDAT 2.0 file, or damaged: give its format", "give its format, or leave format out",
        "it is no file of a Prophesee camera, or damaged: give its format", "give the format",
    ),
    another_encoding: ("the file is damaged or of another encoding: give format as evt2, evt21 or evt3",),
    leave_out: ("leave {} out", "leave format out", "leave time_unit out"),
    larger_limits: ("raise max_bytes", "raise max_events, or read a part by start_us and end_us"),
    right_size: ("give the right width and height", "give its size"),
    not_strict: ("read it without strict, which leaves this out",),
    columns_of_text: (
        "give columns=('t', 'x', 'y', 'p') in the order of the file and time_unit",
        "give time_unit as one of {}", "give columns= with one",
    ),
    columns_of_arrays: (
        "give columns= in their order, such as ('x', 'y', 't', 'p')",
        "give columns= with those of t, x, y, p",
        "{}: give columns= with the names of the arrays of t, x, y and p, or group= with the name of one "
        "array of rows", "{}: give group as one",
    ),
    places_in_hdf5: (
        "{}: give group= with the path of the group or data set of the events, and columns= with the names "
        "of its t, x, y and p", "give time_unit", "group= chooses another of {}",
        "{}: give group= with the path of a group or data set, and columns= with the names of its t, x, y "
        "and p",
    ),
    streams: (
        "give stream as one of {}", "its streams are {}: give stream as one of that kind",
        "stream= chooses",
        "give another file",
    ),
    topics: (
        "its topics are {}: give topic as one of events, or another bag", "topic= chooses",
        "its topics are {}: give one", "give the path of one recording",
    ),
    other_files: ("{} files have them", "give group", "give group, or another file"),
    recoded: ("recode it", "recode it as 0 and 1", "recode them"),
    shifted: ("shift them", "{}", "subtract the time of the first event, or choose another format"),
    rounded: ("round them",),
    in_order: (
        "event {} is older than the one before it", "sort the parts",
        "check format, columns and time_unit, or sort its events",
    ),
    saved_again: (
        "save one entry per event in each", "save np.ascontiguousarray of it", "save it again",
        "save numbers",
        "repair or remove it",
    ),
    written_again: (
        "write it again with blosc or gzip", "copy or write it again", "write it again without fletcher32",
        "EVT2, EVT21 and EVT3 are read: write it again with one",
        "little-endian ones are read: write it again",
        "version 2 is read: write it again", "give the DAT file of brightness changes (CD)",
        "types 1 (DVS) and 2 (ATIS) of version 2 are read: write it again as one of them",
        "RAW is read: save it as RAW",
    ),
    copied_again: (
        "record or copy it again", "check the path", "copy or record it again", "copy or save it again",
        "it is no AEDAT 3.1 file, or damaged: copy it again", "collect it again", "copy it again",
    ),
    another_format: ("choose npz or hdf5", "write parts of at most {} us, or choose npz", "choose {}"),
    missing_libraries: ("pip install rosbags", "pip install opencv-python-headless"),
    of_images: (
        "write {} with lines 'time name', or give fps", "give 2 to {} of {}", "repair it, or give fps",
        "write it again", "copy it there", "convert it", "give its folder",
        "write one line an image, or give fps",
        "convert one", "convert them to one", "copy or convert it again",
    ),
    of_videos: (
        "encode it again as mp4, or as images that are named in docs/recordings.md",
        "copy or encode it again",
        "events need at least two", "encode it again",
        "times must increase: encode the video again at a constant frame rate, or give fps",
        "raise max_events, or take them frame by frame from video_steps and write them with event_writer",
    ),
    finite_frames: ("replace them",),
}  # fmt: skip
# No remedy of the caller's, or one that is tried elsewhere.
ELSEWHERE = {
    "at most {} are read": "of an inner error; its outer one is tried",
    "at most {} are unpacked": "the same",
    "read a part by start_us and end_us, or lower max_events": "memory runs out; ranges are tried above",
    "encode it again at a constant frame rate": "a frame without time, which no muxer here writes",
    "record at a higher frame rate, or read docs/recordings.md": "test_video.py, a warning",
    "give the folder or a file of a rosbag2": "an empty folder is refused before as no recording",
    "{} are read: convert them": "images of a bag: test_ros.py",
    "{} are read: record it with one": "packets of a bag: test_ros.py",
    "later times were moved to follow": "a kind of damage",
}


@pytest.mark.parametrize("trial", TRIALS, ids=lambda trial: trial.__name__)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_remedy_works(trial, tmp_path):
    trial(tmp_path)


def written(node: ast.AST) -> str:
    """The text of a message with {} where values come."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(written(part) if isinstance(part, ast.Constant) else "{}" for part in node.values)
    return ""


def endings() -> set[str]:
    """The endings of the messages of `envs/recordings`, behind their last semicolon."""
    found = set()
    for path in Path(envs.recordings.__file__).parent.glob("*.py"):
        tree = ast.parse(path.read_text())
        whole = {
            id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values
        }
        for node in ast.walk(tree):
            text = written(node) if id(node) not in whole else ""
            if "; " in text and "\n" not in text and not text.endswith("."):
                found.add(text.rsplit("; ", 1)[1])
    return found - {""}


def test_every_remedy_has_a_trial():
    tried = {ending for group in TRIALS.values() for ending in group}
    assert endings() == tried | set(ELSEWHERE)
