import os
from functools import partial
from pathlib import Path

import h5py
import hdf5plugin
import numpy as np
import pytest

from envs.events import EVENT
from envs.recordings import Recording, read_events, read_recording, write_events, write_recording
from envs.recordings.hdf5 import milliseconds_to_index
from tests.support.event_files import some_events


@pytest.fixture
def recording() -> Recording:
    rng = np.random.default_rng(0)
    events = np.empty(5000, EVENT)
    events["t"] = np.sort(rng.integers(10**13, 10**13 + 40_000, 5000))
    events["x"], events["y"] = rng.integers(0, 64, (2, 5000))
    events["p"] = rng.choice([-1, 1], 5000)
    return Recording(events, {"step_t_us": np.arange(8) * 5000}, {"sensor": {"width": 64}, "seed": 3})


def test_what_is_written_is_read(recording, tmp_path):
    write_recording(tmp_path / "a.h5", recording)
    back = read_recording(tmp_path / "a.h5")
    assert back.events.tobytes() == recording.events.tobytes()
    assert back.about == recording.about
    assert np.array_equal(back.index["step_t_us"], recording.index["step_t_us"])
    assert not list(tmp_path.glob("*.part"))


def test_a_recording_without_events_is_read_too(tmp_path):
    write_recording(tmp_path / "a.h5", Recording(np.empty(0, EVENT), {}, {}))
    assert len(read_recording(tmp_path / "a.h5").events) == 0


def test_milliseconds_point_at_the_first_event_not_before_them(recording):
    t_us = recording.events["t"] - recording.events["t"][0]
    index = milliseconds_to_index(t_us)
    for ms, first in enumerate(index):
        assert t_us[first] >= 1000 * ms
        assert first == 0 or t_us[first - 1] < 1000 * ms


def test_events_out_of_order_or_of_another_type_are_refused(recording, tmp_path):
    with pytest.raises(ValueError, match="sorted by t"):
        write_recording(tmp_path / "a.h5", Recording(recording.events[::-1], {}, {}))
    with pytest.raises(ValueError, match="EVENT"):
        write_recording(tmp_path / "a.h5", Recording(np.zeros(3), {}, {}))
    assert not list(tmp_path.iterdir())


def test_a_truncated_file_is_refused_by_name(recording, tmp_path):
    path = tmp_path / "a.h5"
    write_recording(path, recording)
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(ValueError, match=r"a\.h5 is no readable event recording"):
        read_recording(path)


def test_a_file_that_declares_more_than_memory_holds_is_refused_before_reading(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name in "txyp":
            file.create_dataset(f"events/{name}", (10**12,), "i8", chunks=(1024,), fillvalue=1)
        file["t_offset"] = 0
    with pytest.raises(ValueError, match="declares 1000000000000 entries"):
        read_recording(tmp_path / "a.h5")


def test_a_link_to_another_file_is_not_followed(recording, tmp_path):
    write_recording(tmp_path / "a.h5", recording)
    with h5py.File(tmp_path / "b.h5", "w") as file:
        for name in ("events", "index", "t_offset"):
            file[name] = h5py.ExternalLink("a.h5", f"/{name}")
        file.attrs["about"] = "{}"
    with pytest.raises(ValueError, match="events is missing or a link"):
        read_recording(tmp_path / "b.h5")


@pytest.mark.parametrize("kind", ["other", "itself", "soft"])
def test_an_index_that_leads_elsewhere_is_not_even_listed(recording, tmp_path, kind):
    write_recording(tmp_path / "a.h5", recording)
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file.create_group("index")
    with h5py.File(tmp_path / "a.h5", "a") as file:
        del file["index"]
        name = {"other": "other.h5", "itself": "a.h5"}.get(kind)
        file["index"] = h5py.SoftLink("/empty") if name is None else h5py.ExternalLink(name, "/empty")
        file.create_group("empty")
    with h5py.File(tmp_path / "other.h5", "a") as file:
        file.create_group("empty")
    with pytest.raises(ValueError, match="index is missing or a link"):
        read_recording(tmp_path / "a.h5")


def test_more_than_a_file_of_this_size_could_hold_is_refused_before_it_is_read(recording, tmp_path):
    for name, options in (("unwritten", {"fillvalue": 1}), ("unwritten_packed", {"compression": "gzip"})):
        path = tmp_path / f"{name}.h5"
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
    write_recording(tmp_path / "same.h5", Recording(same, {}, {}))
    assert np.array_equal(read_recording(tmp_path / "same.h5").events, same)


def test_a_recording_that_is_no_regular_file_is_refused_without_being_opened(recording, tmp_path):
    write_recording(tmp_path / "a.h5", recording)
    (tmp_path / "link.h5").symlink_to("a.h5")  # as data sets on a shared disk are laid out
    assert np.array_equal(read_recording(tmp_path / "link.h5").events, recording.events)
    os.mkfifo(tmp_path / "pipe.h5")
    with pytest.raises(ValueError, match="is no regular file"):
        read_recording(tmp_path / "pipe.h5")


DSEC = {"t": np.uint32, "x": np.uint16, "y": np.uint16, "p": np.uint8}


def dsec(path: Path, **columns: object) -> Path:
    """A file as the data set's own ones are: 32-bit times after an offset, polarity 0 or 1."""
    values = {"t": [0, 5, 5], "x": [1, 2, 3], "y": [4, 5, 6], "p": [0, 1, 1], **columns}
    with h5py.File(path, "w") as file:
        for name, dtype in DSEC.items():
            given = np.asarray(values[name])
            file[f"events/{name}"] = given if name in columns else given.astype(dtype)
        file["t_offset"] = 10**10
    return path


def test_a_file_of_the_dsec_layout_is_read(tmp_path):
    file = read_events(dsec(tmp_path / "events.h5"), width=640, height=480)
    assert file.format == "hdf5"
    assert file.events.tolist() == [(10**10, 1, 4, -1), (10**10 + 5, 2, 5, 1), (10**10 + 5, 3, 6, 1)]


def test_a_tool_for_the_dsec_layout_reads_what_is_written(recording, tmp_path):
    write_events(tmp_path / "a.h5", recording.events, 64, 64)
    with h5py.File(tmp_path / "a.h5") as file:
        assert np.array_equal(file["events/t"][:] + file["t_offset"][()], recording.events["t"])
        assert set(file["events/p"][:]) == {0, 1}
        assert np.array_equal(file["events/p"][:] == 1, recording.events["p"] == 1)
        first = file["ms_to_idx"][3]
        assert file["events/t"][first] >= 3000 > file["events/t"][first - 1]


@pytest.mark.parametrize("window_us", [400, 3_700, 50_000])
def test_the_index_of_milliseconds_finds_the_events_of_any_window_as_dsec_searches_it(window_us, tmp_path):
    """DSEC's EventSlicer: the index at the whole milliseconds around a window, then a search between."""
    events = some_events(1, 30_000, 640, 480, 2_000_000)
    events["t"] += 5_000_123
    write_events(tmp_path / "a.h5", events, 640, 480)
    with h5py.File(tmp_path / "a.h5") as file:
        index, offset = file["ms_to_idx"][:].astype(np.int64), int(file["t_offset"][()])
        t_us, x = file["events/t"][:], file["events/x"][:]
    for start_us in np.random.default_rng(0).integers(0, 1_900_000, 50).tolist():
        first, last = index[start_us // 1000], index[-(-(start_us + window_us) // 1000)]
        near = slice(first, last)
        inside = (t_us[near] >= start_us) & (t_us[near] < start_us + window_us)
        wanted = (events["t"] >= offset + start_us) & (events["t"] < offset + start_us + window_us)
        assert x[near][inside].tolist() == events["x"][wanted].tolist()


def test_a_recording_is_an_event_file_too_and_says_its_sensor(recording, tmp_path):
    sensor = {"sensor": {"width": 64, "height": 65}}
    write_recording(tmp_path / "a.h5", Recording(recording.events, {}, sensor))
    file = read_events(tmp_path / "a.h5")
    assert (file.width, file.height) == (64, 65)
    assert file.events.tobytes() == recording.events.tobytes()


@pytest.mark.parametrize("offset", [0.5, np.nan, np.inf, -np.inf])
def test_an_offset_that_is_no_whole_microsecond_is_refused(offset, tmp_path):
    path = dsec(tmp_path / "a.h5")
    for value in (offset, 10.0):
        with h5py.File(path, "a") as file:
            del file["t_offset"]
            file["t_offset"] = value
        if value == 10.0:
            assert read_events(path).events["t"].tolist() == [10, 15, 15]
        else:
            with pytest.raises(ValueError, match=r"a\.h5"):
                read_events(path)


@pytest.mark.parametrize(
    ("columns", "rule"),
    [
        ({"t": np.array([0.5, 1.0, 2.0])}, "no whole microseconds"),
        ({"t": np.array([2**63, 1, 2], np.uint64)}, "not below 2"),
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


def test_filters_that_crash_on_damaged_files_are_not_run(tmp_path):
    for options in ({"scaleoffset": 0}, dict(hdf5plugin.Bitshuffle()), dict(hdf5plugin.LZ4())):
        path = dsec(tmp_path / "a.h5")
        with h5py.File(path, "a") as file:
            del file["events/x"]
            file.create_dataset("events/x", data=np.zeros(3, np.uint16), chunks=(3,), **options)
        with pytest.raises(ValueError, match="write it again with blosc or gzip"):
            read_events(path)


@pytest.mark.parametrize(
    "options", [{}, {"compression": "gzip", "shuffle": True}, {"compression": "lzf"}, None]
)
def test_the_filters_of_common_data_sets_are_read(options, tmp_path):
    path = dsec(tmp_path / "a.h5")
    with h5py.File(path, "a") as file:
        del file["events/x"]
        packing = dict(hdf5plugin.Blosc(cname="zstd")) if options is None else options
        file.create_dataset("events/x", data=np.arange(3, dtype=np.uint16), **packing)
    assert read_events(path).events["x"].tolist() == [0, 1, 2]


def test_a_failed_write_leaves_the_old_file_and_no_other(recording, tmp_path):
    write_recording(tmp_path / "a.h5", recording)
    before = (tmp_path / "a.h5").read_bytes()
    with pytest.raises(ValueError, match="Out of range float values"):
        write_recording(tmp_path / "a.h5", Recording(recording.events, {}, {"x": np.nan}))
    assert (tmp_path / "a.h5").read_bytes() == before
    assert list(tmp_path.iterdir()) == [tmp_path / "a.h5"]


@pytest.mark.parametrize("suffix", ["npz", "h5", "txt", "dat", "raw"])
@pytest.mark.parametrize(
    ("event", "rule"),
    [
        ((-1, 0, 0, 1), "times must lie in"),
        ((2**52, 0, 0, 1), "times must lie in"),
        ((5, 64, 0, 1), "outside a sensor of 64x64"),
        ((5, 0, 64, 1), "outside a sensor of 64x64"),
        ((5, 0, 0, 0), "polarities must be -1 or"),
    ],
)
def test_events_that_no_file_may_hold_are_not_written(suffix, event, rule, tmp_path):
    with pytest.raises(ValueError, match=rule):
        write_events(tmp_path / f"a.{suffix}", np.array([event], EVENT), 64, 64)
    assert not list(tmp_path.iterdir())


def test_a_span_of_years_is_refused_by_the_layout_with_an_index_of_milliseconds(tmp_path):
    events = np.array([(0, 0, 0, 1), (2**51, 0, 0, 1)], EVENT)
    with pytest.raises(ValueError, match="an index entry for each millisecond"):
        write_events(tmp_path / "a.h5", events, 64, 64)
    write_events(tmp_path / "a.npz", events, 64, 64)
    assert read_events(tmp_path / "a.npz").events.tobytes() == events.tobytes()


def test_what_is_not_sorted_or_not_events_is_not_written(recording, tmp_path):
    for events, rule in ((recording.events[::-1], "sorted by t"), (np.zeros(3), "dtype EVENT")):
        with pytest.raises(ValueError, match=rule):
            write_events(tmp_path / "a.npz", events, 64, 64)
    with pytest.raises(ValueError, match="width and height"):
        write_events(tmp_path / "a.npz", recording.events, 0, 64)
    with pytest.raises(ValueError, match="format must be one of"):
        write_events(tmp_path / "a.xyz", recording.events, 64, 64)
    assert not list(tmp_path.iterdir())


def test_the_content_of_a_file_decides_and_not_its_name(recording, tmp_path):
    write_events(tmp_path / "a.txt", recording.events, 64, 64, "npz")
    assert read_events(tmp_path / "a.txt").format == "npz"
    (tmp_path / "a.npz").write_text("t_us x y p\n1 2 3 1\n")
    with pytest.raises(ValueError, match="begins like no known event file"):
        read_events(tmp_path / "a.npz")
    assert read_events(tmp_path / "a.npz", "txt").events.tolist() == [(1, 2, 3, 1)]
    with pytest.raises(ValueError, match="format must be one of"):
        read_events(tmp_path / "a.npz", "xyz")
