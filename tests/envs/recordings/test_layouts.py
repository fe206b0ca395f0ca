"""Layouts of HDF5, npz and text as data sets and programs write them: each has the same three events."""

import h5py
import hdf5plugin
import numpy as np
import pytest

from envs.recordings import read_events, read_parts

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


def v2e(file):
    file["events"] = np.stack([T, X, Y, 2 * P - 1], 1).astype("u4")


def raw_events(file):
    put(file.create_group("raw_events"), types="f8 i2 i2 ?", values=(T * 1e-6, X, Y, P))


def rpeflow(file):
    put(file, "events_t events_x events_y events_p")


def vid2e(file):
    put(file.create_group("events"), types="f8 u2 u2 u1")


def any_names(file):
    put(file.create_group("a/b"), "timestamps col row polarity")


def compound(file):
    kinds = [("t", "u4"), ("x", "u2"), ("y", "u2"), ("p", "u1")]
    file["events"] = np.array(list(zip(T, X, Y, P, strict=True)), kinds)


SIZES = {dsec: (640, 480), rvt: (1280, 720), m3ed: (1280, 720), mvsec: (346, 260), event_utils: (240, 180)}
UNSIZED = (v2e, put, raw_events, rpeflow, vid2e, any_names, compound)  # `put` in no group is EDS


@pytest.mark.parametrize("make", [*SIZES, *UNSIZED])
@pytest.mark.filterwarnings("ignore:.*group= chooses")
def test_every_layout_gives_the_same_events_and_its_size(make, tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        make(file)
    found = read_events(tmp_path / "a.h5")
    assert found.events.tolist() == SAME
    assert (found.width, found.height) == SIZES.get(make, (None, None))
    parts = [part.events for part in read_parts(tmp_path / "a.h5", part_events=2)]
    assert np.concatenate(parts).tolist() == SAME


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


NAMED = {"columns": tuple("txyp"), "time_unit": "us"}
TEXTS = {
    "metavision": ("%geometry:640,480\n1,4,1,10\n2,5,0,20\n3,6,1,35\n", NAMED | {"columns": tuple("xypt")}),
    "truth": ("t_us,x,y,p\n10,1,4,True\n20,2,5,False\n35,3,6,TRUE\n", {}),
    "quotes": ('"t_us","x","y","p"\n10,1,4,1\n20,2,5,0\n35,3,6,1\n', {}),
    "semicolons": ("t_us;x;y;p\n10;1;4;1\n20;2;5;0\n35;3;6;1\n", {}),
    "index": (",t_us,x,y,p\n0,10,1,4,1\n1,20,2,5,0\n2,35,3,6,1\n", {}),
    "parts of seconds": ("sec,nsec,x,y,p\n0,10000,1,4,1\n0,20000,2,5,0\n0,35000,3,6,1\n", {}),
    "jaer": ("# timestamp(us) x y polarity\n10 1 4 1\n20 2 5 0\n35 3 6 1\n", {}),
    "milliseconds": ("x y polarity timestamp[ms]\n1 4 1 0.01\n2 5 -1 0.02\n3 6 1 0.035\n", {}),
    "more columns": ("ts_s, note, x, y, pol\n1e-5, 9, 1, 4, 1\n2e-5, 9, 2, 5, 0\n3.5e-5, 9, 3, 6, 1\n", {}),
    "windows": ("time_ns x y on\n10000 1 4 1\r\n20000 2 5 0\r\n35000 3 6 1\r\n", {}),
    "mark before names": ("\ufefft_us,x,y,p\n10,1,4,1\n20,2,5,0\n35,3,6,1\n", {}),
    "mark before facts": ("\ufeff# columns: t x y p\n# time_unit: us\n\n10 1 4 1\n20 2 5 -1\n35 3 6 1\n", {}),
    "mark before rows": ("\ufeff10 1 4 1\n20 2 5 0\n35 3 6 1\n", NAMED),
    "columns of the caller": ("t,x@320,y@240,on\n10,1,4,1\n20,2,5,0\n35,3,6,1\n", NAMED),
    "other columns than it says": (
        "# columns: x y p t\n# time_unit: us\n4 1 1 10\n5 2 0 20\n6 3 1 35\n",
        {"columns": tuple("yxpt")},
    ),
}


@pytest.mark.parametrize("name", TEXTS)
def test_text_is_read_as_programs_write_it_and_as_the_caller_says(name, tmp_path):
    text, options = TEXTS[name]
    (tmp_path / "a.csv").write_bytes(text.encode())
    assert read_events(tmp_path / "a.csv", **options).events.tolist() == SAME
    parts = read_parts(tmp_path / "a.csv", part_events=2, **options)
    assert np.concatenate([part.events for part in parts]).tolist() == SAME


def test_a_first_line_of_two_numbers_is_the_size_that_e2vid_writes(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("240 180\n0.001 2 3 1\n0.002 4 5 0\n")
    file = read_events(path)
    assert (file.width, file.height) == (240, 180)
    assert file.events.tolist() == [(1000, 2, 3, 1), (2000, 4, 5, -1)]
    assert read_events(path, time_unit="ms").events["t"].tolist() == [1, 2]
    assert read_events(path, columns=("t", "y", "x", "p")).events["x"].tolist() == [3, 5]
    path.write_text("240 180\n")
    assert len(read_events(path).events) == 0
