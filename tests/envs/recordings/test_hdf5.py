"""Recordings of this project and HDF5 files of others: what they hold, and what is never opened or run."""

import os
from functools import partial
from pathlib import Path

import h5py
import hdf5plugin
import numpy as np
import pytest

from envs.events import EVENT
from envs.recordings import Recording, read_events, read_recording, write_events, write_recording
from tests.support.event_files import some_events

EVENTS = some_events(0, 3000, 64, 65, 40_000)
EVENTS["t"] += 10**13


@pytest.fixture
def path(tmp_path) -> Path:
    """A recording with an index and facts."""
    about = {"sensor": {"width": 64, "height": 65}, "seed": 3}
    write_recording(tmp_path / "a.h5", Recording(EVENTS, {"step_t_us": np.arange(8) * 5000}, about))
    return tmp_path / "a.h5"


def test_a_recording_that_is_written_is_read_and_is_an_event_file_too(path):
    back = read_recording(path)
    assert back.events.tobytes() == EVENTS.tobytes()
    assert back.about == {"sensor": {"width": 64, "height": 65}, "seed": 3}
    assert np.array_equal(back.index["step_t_us"], np.arange(8) * 5000)
    file = read_events(path)
    assert (file.events.tobytes(), file.width, file.height) == (EVENTS.tobytes(), 64, 65)
    write_recording(path, Recording(EVENTS[:0], {}, {}))
    assert len(read_recording(path).events) == 0


@pytest.mark.parametrize(
    ("events", "about", "rule"),
    [
        (EVENTS[::-1], {}, "sorted by t"),
        (np.zeros(3), {}, "EVENT"),
        (EVENTS, {"x": np.nan}, "Out of range float values"),
    ],
)
def test_a_recording_that_is_refused_leaves_the_old_file_and_no_other(events, about, rule, path):
    before = path.read_bytes()
    with pytest.raises(ValueError, match=rule):
        write_recording(path, Recording(events, {}, about))
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("name", ["events", "index"])
@pytest.mark.parametrize("file_name", ["other.h5", "a.h5", None])
def test_a_link_to_another_place_is_not_even_listed(file_name, name, path):
    for place in (path, path.with_name("other.h5")):
        with h5py.File(place, "a") as file:
            file.create_group("empty")
    with h5py.File(path, "a") as file:
        del file[name]
        file[name] = h5py.ExternalLink(file_name, "/empty") if file_name else h5py.SoftLink("/empty")
    with pytest.raises(ValueError, match=f"{name} is missing or a link"):
        read_recording(path)


def test_a_recording_that_is_no_regular_file_is_refused_without_being_opened(path):
    link, pipe = path.with_name("link.h5"), path.with_name("pipe.h5")
    link.symlink_to("a.h5")  # as data sets on a shared disk are laid out
    assert np.array_equal(read_recording(link).events, EVENTS)
    os.mkfifo(pipe)
    with pytest.raises(ValueError, match="is no regular file"):
        read_recording(pipe)


@pytest.mark.parametrize("options", [{"fillvalue": 1}, {"compression": "gzip"}])
def test_more_than_a_file_of_this_size_could_hold_is_refused_before_it_is_read(options, tmp_path):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        for column in "txyp":  # nothing of it is stored
            file.create_dataset(f"events/{column}", (10**8,), "i8", chunks=(1024,), **options)
    assert path.stat().st_size < 1 << 16
    with pytest.raises(ValueError, match="at most max_events=10000000 are read"):
        read_events(path)
    for read in (read_recording, partial(read_events, max_events=10**8)):
        with pytest.raises(ValueError, match="events/t declares 800000000 bytes in a file of"):
            read(path)
    same = np.zeros(1 << 20, EVENT)  # packs as well as events can
    same["p"] = 1
    write_recording(path, Recording(same, {}, {}))
    assert np.array_equal(read_recording(path).events, same)


DSEC = {"t": np.uint32, "x": np.uint16, "y": np.uint16, "p": np.uint8}


def dsec(path: Path, how: dict | None = None, **columns: object) -> Path:
    """A file as the data set's own ones are: 32-bit times after an offset; `how` x is stored."""
    values = {"t": [0, 5, 5], "x": [1, 2, 3], "y": [4, 5, 6], "p": [0, 1, 1], **columns}
    with h5py.File(path, "w") as file:
        for name, dtype in DSEC.items():
            data = np.asarray(values[name], None if name in columns else dtype)
            file.create_dataset(f"events/{name}", data=data, **(how or {} if name == "x" else {}))
        file["t_offset"] = 10**10
    return path


@pytest.mark.parametrize("offset", [10.0, 0.5, np.nan, -np.inf])
def test_an_offset_is_added_and_must_be_whole_microseconds(offset, tmp_path):
    path = dsec(tmp_path / "a.h5")
    with h5py.File(path, "a") as file:
        del file["t_offset"]
        file["t_offset"] = offset
    if offset == 10.0:
        assert read_events(path).events.tolist() == [(10, 1, 4, -1), (15, 2, 5, 1), (15, 3, 6, 1)]
    else:
        with pytest.raises(ValueError, match=r"a\.h5"):
            read_events(path)


@pytest.mark.parametrize(
    ("columns", "rule"),
    [
        ({"t": [-20_000_000_000, -20_000_000_000, 2]}, "t must lie in"),
        ({"x": [1, 2]}, "differ in length"),
        ({"x": [1, 641, 640]}, "x=641, y=6, 2 of 3 outside the sensor"),
        ({"p": [0, 1, 7]}, "polarity must be coded"),
        ({"p": np.array([b"0", b"1", b"1"])}, "not numbers"),
        ({"t": [[0, 1, 2]]}, "plain data set of 1 dimensions"),
    ],
)
def test_an_hdf5_file_that_breaks_a_rule_is_refused(columns, rule, tmp_path):
    with pytest.raises(ValueError, match=rule) as caught:
        read_events(dsec(tmp_path / "a.h5", **columns), width=640, height=480)
    assert "a.h5" in str(caught.value)


def test_data_kept_outside_the_file_or_in_huge_chunks_are_not_read(tmp_path):
    (tmp_path / "secret").write_bytes(bytes(range(24)))
    for name in ("external", "virtual", "chunks", "soft"):
        path = dsec(tmp_path / f"{name}.h5")
        with h5py.File(path, "a") as file:
            del file["events/x"]
            if name == "external":
                file.create_dataset("events/x", (3,), "u1", external=[(str(tmp_path / "secret"), 0, 24)])
            elif name == "virtual":
                layout = h5py.VirtualLayout((3,), "u2")
                layout[:] = h5py.VirtualSource(str(tmp_path / "other.h5"), "x", (3,))
                file.create_virtual_dataset("events/x", layout)
            elif name == "chunks":
                file.create_dataset("events/x", (3,), "u2", chunks=(2**28,), maxshape=(None,))
            else:
                file["events/x"] = h5py.SoftLink("/events/y")
        with pytest.raises(ValueError, match=r"not a plain data set|chunks of more|missing or a link"):
            read_events(path)


def test_common_filters_are_read_and_those_that_crash_on_damaged_files_are_not_run(tmp_path):
    blosc = dict(hdf5plugin.Blosc(cname="zstd"))
    for options in ({"compression": "gzip", "shuffle": True}, {"compression": "lzf"}, blosc):
        assert read_events(dsec(tmp_path / "a.h5", options)).events["x"].tolist() == [1, 2, 3]
    for options in (dict(hdf5plugin.Bitshuffle()), dict(hdf5plugin.LZ4())):
        with pytest.raises(ValueError, match="write it again with blosc or gzip"):
            read_events(dsec(tmp_path / "a.h5", {"chunks": (3,), **options}))


@pytest.mark.parametrize(("name", "kind"), [("geometry", "list"), ("width", "array"), ("about", "truth")])
def test_an_attribute_that_is_no_single_number_or_text_is_refused_unread(kind, name, tmp_path):
    path = tmp_path / "a.h5"
    write_events(path, EVENTS, 64, 65)
    with h5py.File(path, "a") as file:
        if name != "width":
            del file.attrs["width"]
        if kind == "list":  # of numbers, whose length is declared beside them
            data = np.empty((), object)
            data[()] = np.arange(3, dtype="u1")
            file.attrs.create(name, data, dtype=h5py.vlen_dtype("u1"))
        else:
            file.attrs[name] = {"array": np.arange(3), "truth": True}[kind]
    with pytest.raises(ValueError, match=f"the attribute {name} is no single number or text"):
        read_events(path)


@pytest.mark.parametrize(
    "attributes",
    [
        {"width": 34.0, "height": 34.0},
        {"geometry": "34x34"},
        {"geometry": np.bytes_("34x34")},
        {"width": 34, "height": 34, "geometry": [1, 2]},
    ],
)
def test_a_size_is_read_as_other_programs_write_it(attributes, tmp_path):
    path = dsec(tmp_path / "a.h5")
    with h5py.File(path, "a") as file:
        file.attrs.update(attributes)
    found = read_events(path)
    assert (found.width, found.height) == (34, 34)
