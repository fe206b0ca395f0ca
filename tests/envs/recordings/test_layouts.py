"""Layouts of HDF5, npz and text as data sets and programs write them: each has the same three events."""

import struct
from pathlib import Path

import h5py
import hdf5plugin
import numpy as np
import pytest

from envs.recordings import event_writer, read_events, read_parts, write_events
from envs.recordings.hdf5 import milliseconds_to_index
from envs.recordings.hdf5_layouts import LAYOUTS
from tests.support.event_files import aedat3, some_events

T, X, Y, P = np.array([10, 20, 35]), np.array([1, 2, 3]), np.array([4, 5, 6]), np.array([1, 0, 1])
SAME = [(10, 1, 4, 1), (20, 2, 5, -1), (35, 3, 6, 1)]


def put(group, names="t x y p", types="u4 u2 u2 u1", values=(T, X, Y, P), **how):
    for name, kind, value in zip(names.split(), types.split(), values, strict=True):
        group.create_dataset(name, data=value.astype(kind), **how)


def dsec(file):
    put(file.create_group("events"), **hdf5plugin.Blosc(cname="zstd"))
    file["ms_to_idx"], file["t_offset"] = np.array([0], "u8"), np.int64(0)


def rvt(file):
    put(file.create_group("events"))
    file["events/height"], file["events/width"] = 720, 1280


def m3ed(file):
    for side in ("left", "right"):
        group = file.create_group(f"prophesee/{side}")
        put(group, types="i8 u2 u2 i1", compression="lzf", chunks=(3,))
        group.create_group("calib")["resolution"] = np.array([1280, 720])


def mvsec(file):
    file["davis/left/events"] = np.stack([X, Y, T * 1e-6, 2.0 * P - 1], 1)


def event_utils(file):
    put(file.create_group("events"), "ts xs ys ps", "f8 i2 i2 ?", (T * 1e-6, X, Y, P))
    file.attrs["sensor_resolution"] = (180, 240)


KNOWN = {
    "dsec": (dsec, (640, 480)),
    "rvt": (rvt, (1280, 720)),
    "m3ed": (m3ed, (1280, 720)),
    "mvsec": (mvsec, (346, 260)),
    "event_utils": (event_utils, (240, 180)),
    "v2e": (
        lambda file: file.create_dataset("events", data=np.stack([T, X, Y, 2 * P - 1], 1).astype("u4")),
        None,
    ),
    "eds": (put, None),
    "raw_events": (
        lambda file: put(file.create_group("raw_events"), types="f8 i2 i2 ?", values=(T * 1e-6, X, Y, P)),
        None,
    ),
    "rpeflow": (lambda file: put(file, "events_t events_x events_y events_p"), None),
    "vid2e": (lambda file: put(file.create_group("events"), types="f8 u2 u2 u1"), None),
    "any": (lambda file: put(file.create_group("a/b"), "timestamps col row polarity"), None),
    "compound": (
        lambda file: file.create_dataset("events", data=np.array(list(zip(T, X, Y, P, strict=True)),
                                         [("t", "u4"), ("x", "u2"), ("y", "u2"), ("p", "u1")])),
        None,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", KNOWN)
@pytest.mark.filterwarnings("ignore:.*group= chooses")
def test_every_layout_gives_the_same_events_and_its_size(name, tmp_path):
    make, size = KNOWN[name]
    with h5py.File(tmp_path / "a.h5", "w") as file:
        make(file)
    found = read_events(tmp_path / "a.h5")
    assert found.events.tolist() == SAME
    assert (found.width, found.height) == (size or (None, None))
    parts = [part.events for part in read_parts(tmp_path / "a.h5", part_events=2)]
    assert np.concatenate(parts).tolist() == SAME


def test_the_table_of_layouts_has_no_two_rows_for_one_place():
    places = [(row.group, row.columns) for row in LAYOUTS]
    assert len(set(places)) == len(places)


def test_two_cameras_in_one_file_are_told_and_chosen(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        m3ed(file)
        file["prophesee/right/x"][:] = X + 1
    with pytest.warns(UserWarning, match="events of prophesee/left are read; group= chooses"):
        assert read_events(tmp_path / "a.h5").events["x"].tolist() == [1, 2, 3]
    assert read_events(tmp_path / "a.h5", group="prophesee/right").events["x"].tolist() == [2, 3, 4]


def test_what_is_written_needs_no_filter_that_hdf5_does_not_have(tmp_path):
    events = some_events(0, 1000, 346, 260, 3_000_000)
    write_events(tmp_path / "a.h5", events, 346, 260)
    with h5py.File(tmp_path / "a.h5") as file:
        for name in "txyp":
            pipeline = file[f"events/{name}"].id.get_create_plist()
            codes = {pipeline.get_filter(number)[0] for number in range(pipeline.get_nfilters())}
            assert codes <= {1, 2, 3}  # deflate, shuffle, fletcher32
        t_us = events["t"] - events["t"][0]
        assert np.array_equal(file["ms_to_idx"][:], milliseconds_to_index(t_us))


@pytest.mark.parametrize("format", ["npz", "hdf5", "txt", "csv", "dat", "evt2", "evt3", "aedat4"])
def test_a_file_written_in_parts_has_the_events_of_one_written_at_once(format, tmp_path):
    events = some_events(2, 5000, 346, 260, 3_000_000)
    write_events(tmp_path / "once", events, 346, 260, format)
    with event_writer(tmp_path / "parts", 346, 260, format) as write:
        for first in range(0, 5000, 333):
            write(events[first : first + 333])
    size = {"width": 346, "height": 260, "format": "txt"} if format == "csv" else {}
    size |= {"format": "txt"} if format == "txt" else {}
    assert read_events(tmp_path / "parts", **size).events.tobytes() == events.tobytes()
    if format not in ("hdf5", "aedat4"):
        assert (tmp_path / "parts").read_bytes() == (tmp_path / "once").read_bytes()
    with pytest.raises(ValueError, match="sort the parts"):
        twice(tmp_path / "b", events, format)
    assert not (tmp_path / "b").exists()


def twice(path: Path, events: np.ndarray, format: str) -> None:
    with event_writer(path, 346, 260, format) as write:
        write(events)
        write(events)


ROWS = np.array(list(zip(X, Y, P, T, strict=True)), [("x", "u2"), ("y", "u2"), ("p", "i2"), ("t", "i8")])
EV = {"width": np.array([64], "u8"), "height": np.array([48], "u8"), "timestamp_scale_ms": np.array([0.001])}
NPZ = {
    "timelens": {"timestamp": T, "x": X, "y": Y, "polarity": P},
    "eventcv": {"t": T, "x": X, "y": Y, "p": P, **EV},
    "evimo": {"events_t": T * 1e-6, "events_xy": np.stack([X, Y], 1), "events_p": P},
    "structured": {"events": ROWS},
    "table": {"rows": np.stack([T, X, Y, P], 1)},
    "whole floats": {"t": T.astype("f8"), "x": X, "y": Y, "p": P.astype(bool)},
}


@pytest.mark.parametrize("name", NPZ)
def test_arrays_are_found_by_the_names_that_programs_give_them(name, tmp_path):
    np.savez(tmp_path / "a.npz", **NPZ[name])
    assert read_events(tmp_path / "a.npz").events.tolist() == SAME


def test_nanoseconds_since_1970_are_read_with_the_unit_that_the_refusal_names(tmp_path):
    np.savez(tmp_path / "a.npz", t=1_461_581_614_000_000_000 + T * 1000, x=X, y=Y, p=P)
    with pytest.raises(ValueError, match="give time_unit='ns'"):
        read_events(tmp_path / "a.npz")
    assert np.diff(read_events(tmp_path / "a.npz", time_unit="ns").events["t"]).tolist() == [10, 15]


TEXTS = {
    "metavision": (
        "%geometry:640,480\n1,4,1,10\n2,5,0,20\n3,6,1,35\n",
        {"columns": tuple("xypt"), "time_unit": "us"},
    ),
    "truth": ("t_us,x,y,p\n10,1,4,True\n20,2,5,False\n35,3,6,TRUE\n", {}),
    "quotes": ('"t_us","x","y","p"\n10,1,4,1\n20,2,5,0\n35,3,6,1\n', {}),
    "semicolons": ("t_us;x;y;p\n10;1;4;1\n20;2;5;0\n35;3;6;1\n", {}),
    "index": (",t_us,x,y,p\n0,10,1,4,1\n1,20,2,5,0\n2,35,3,6,1\n", {}),
    "parts of seconds": ("sec,nsec,x,y,p\n0,10000,1,4,1\n0,20000,2,5,0\n0,35000,3,6,1\n", {}),
    "jaer": ("# timestamp(us) x y polarity\n10 1 4 1\n20 2 5 0\n35 3 6 1\n", {}),
}


@pytest.mark.parametrize("name", TEXTS)
def test_text_is_read_as_programs_write_it(name, tmp_path):
    text, options = TEXTS[name]
    (tmp_path / "a.csv").write_text(text)
    assert read_events(tmp_path / "a.csv", **options).events.tolist() == SAME
    parts = read_parts(tmp_path / "a.csv", part_events=2, **options)
    assert np.concatenate([part.events for part in parts]).tolist() == SAME


def test_aedat3_has_events_triggers_and_a_clock_that_turns(tmp_path):
    def polarity(t, x, y, on):
        return struct.pack("<Ii", x << 17 | y << 2 | on << 1 | 1, t)

    invalid = struct.pack("<Ii", 5 << 17, 11)
    path = aedat3(
        tmp_path / "a.aedat",
        [
            (1, 0, 8, polarity(10, 1, 4, 1) + invalid + polarity(20, 2, 5, 0)),
            (0, 0, 8, struct.pack("<Ii", 2 << 1 | 1, 22) + struct.pack("<Ii", 3 << 1 | 1, 24)),
            (1, 1, 8, polarity(35, 3, 6, 1)),
        ],
    )
    file = read_events(path)
    assert (file.format, file.width, file.height, file.skipped) == ("aedat3", 128, 128, 2)
    assert file.events.tolist() == [*SAME[:2], (2**31 + 35, 3, 6, 1)]
    assert file.triggers.tolist() == [(22, 0, 1), (24, 0, -1)]
    path.write_bytes(path.read_bytes()[:-3])
    assert read_events(path).events.tolist() == SAME[:2]
    with pytest.raises(ValueError, match=r"has no source 7; give stream as one of \{1: 'DVS128'\}"):
        read_events(path, stream=7)
    assert len(read_events(path, stream=1).events) == 2
