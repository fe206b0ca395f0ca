"""What is written is read, at once and in parts, here and by other programs; bad events are not written."""

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.events import EVENT
from envs.recordings import event_writer, read_events, read_parts, write_events
from envs.recordings.hdf5 import milliseconds_to_index
from tests.support.event_files import some_events

pytestmark = pytest.mark.filterwarnings("ignore:.*no events for:UserWarning")  # events are few

# The time before which events of a round trip lie [us]: the end of all times, of a clock, or of an index.
UNTIL_US = {
    **dict.fromkeys(("npz", "txt", "csv", "aedat4"), 2**52),
    **{"hdf5": 10**8, "dat": 2**32, "evt2": 2**34, "evt3": 2**27},
}


@pytest.mark.parametrize("format", UNTIL_US)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(0, 300),
    is_dense=st.booleans(),
    part=st.integers(20, 200),
)
@settings(max_examples=12)
def test_what_is_written_is_read_at_once_and_in_parts(tmp_path_factory, format, seed, count, is_dense, part):
    folder = tmp_path_factory.mktemp("a")
    events = some_events(seed, count, 346, 260, 200 if is_dense else UNTIL_US[format])
    if format == "evt3" and count:
        events["t"][0] = 0  # all later turns of its clock are counted
    once, parts = folder / f"once.{format}", folder / f"parts.{format}"
    write_events(once, events, 346, 260, format)
    with event_writer(parts, 346, 260, format) as write:
        for first in range(0, count, part):
            write(events[first : first + part])
    assert sorted(folder.iterdir()) == [once, parts]
    size = {"width": 346, "height": 260} if format == "csv" else {}  # the only one that does not say
    for path in (once, parts):
        back = read_events(path, **size)
        assert back.events.tobytes() == events.tobytes()
        assert (back.width, back.height, back.late, back.skipped) == (346, 260, 0, 0)
        assert back.format == {"csv": "txt"}.get(format, format)
    found = np.concatenate([one.events for one in read_parts(once, part_events=part, **size)])
    assert found.tobytes() == events.tobytes()
    if format not in ("hdf5", "aedat4"):  # whose chunks and packets are those of the parts
        assert once.read_bytes() == parts.read_bytes()


@pytest.mark.parametrize("format", ["npz", "hdf5", "dat", "evt2", "evt3", "aedat4", "txt"])
def test_the_parts_of_a_large_file_are_the_whole_and_a_range_of_times_is_read(format, tmp_path):
    path, events = tmp_path / f"a.{format}", some_events(3, 20_000, 346, 260, 3_000_000)
    write_events(path, events, 346, 260, format)
    for size in (700, 50_000):
        parts = [part.events for part in read_parts(path, part_events=size)]
        assert np.concatenate(parts).tobytes() == events.tobytes()
        assert max(map(len, parts)) <= 2 * size + (1 << 14)
    middle = read_events(path, start_us=1_000_000, end_us=2_000_000).events
    assert middle.tobytes() == events[(events["t"] >= 1_000_000) & (events["t"] < 2_000_000)].tobytes()


@pytest.mark.parametrize(("format", "bits"), [("dat", 32), ("evt2", 34), ("evt3", 24)])
def test_the_last_time_of_a_clock_is_written_and_the_next_is_refused(format, bits, tmp_path):
    events = np.array([(2**bits, 0, 0, 1)], EVENT)
    with pytest.raises(ValueError, match=f"clock of {bits} bits"):
        write_events(tmp_path / "a", events, 8, 8, format)
    assert not list(tmp_path.iterdir())
    events["t"] -= 1
    write_events(tmp_path / "a", events, 8, 8, format)
    assert read_events(tmp_path / "a").events.tobytes() == events.tobytes()


@pytest.mark.parametrize(
    ("name", "events", "width", "rule"),
    [
        ("a.npz", [(-1, 0, 0, 1)], 64, "times must lie in"),
        ("a.raw", [(5, 64, 0, 1)], 64, "outside a sensor of 64x64"),
        ("a.h5", [(5, 0, 64, 1)], 64, "outside a sensor of 64x64"),
        ("a.npz", [0.0, 1.0], 64, "dtype EVENT"),
        ("a.npz", [], 0, "width and height"),
        ("a.xyz", [], 64, "format must be one of"),
        ("a.dat", [], 16_385, "at most 16384 pixels"),
        ("a.aedat4", [], 32_769, "at most 32768 pixels"),
    ],
)
def test_events_that_no_file_may_hold_are_not_written(name, events, width, rule, tmp_path):
    events = np.array(events) if 0.0 in events else np.array(events, EVENT)
    with pytest.raises(ValueError, match=rule):
        write_events(tmp_path / name, events, width, 64)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", ["npz", "h5"])
def test_labels_of_noise_that_are_written_are_read(suffix, tmp_path):
    events, path = some_events(0, 200, 346, 260, 10**6), tmp_path / f"a.{suffix}"
    is_noise = np.random.default_rng(1).random(200) < 0.3
    write_events(path, events, 346, 260, is_noise=is_noise)
    back = read_events(path)
    assert back.events.tobytes() == events.tobytes()
    assert back.is_noise.dtype == bool
    assert np.array_equal(back.is_noise, is_noise)
    write_events(path, events, 346, 260)
    assert read_events(path).is_noise is None
    for wrong in (is_noise[:-1], is_noise.astype(int), is_noise.tolist()):
        with pytest.raises(ValueError, match="is_noise must be bool"):
            write_events(path, events, 346, 260, is_noise=wrong)


def test_numpy_and_pandas_read_what_is_written_without_options(tmp_path):
    events = some_events(0, 100, 346, 260, 10**6)
    for suffix in ("npz", "txt", "csv"):
        write_events(tmp_path / f"a.{suffix}", events, 346, 260)
    stored, rows = np.load(tmp_path / "a.npz"), np.loadtxt(tmp_path / "a.txt", dtype=np.int64)
    table = pytest.importorskip("pandas").read_csv(tmp_path / "a.csv")
    assert list(table.columns) == ["t_us", "x", "y", "p"]
    for place, name in enumerate("txyp"):
        assert np.array_equal(stored[name], events[name] > 0 if name == "p" else events[name])
        assert np.array_equal(rows[:, place], events[name])
        assert np.array_equal(table.iloc[:, place], events[name])
    assert "# columns: t x y p\n" in (tmp_path / "a.txt").read_text()


@pytest.mark.parametrize("window_us", [400, 50_000])
def test_a_tool_for_the_dsec_layout_finds_the_events_of_any_window(window_us, tmp_path):
    """DSEC's EventSlicer: the index at the whole milliseconds around a window, then a search between."""
    events = some_events(1, 30_000, 640, 480, 2_000_000)
    events["t"] += 5_000_123
    write_events(tmp_path / "a.h5", events, 640, 480)
    with h5py.File(tmp_path / "a.h5") as file:
        index, offset = file["ms_to_idx"][:].astype(np.int64), int(file["t_offset"][()])
        t_us, x, p = (file[f"events/{name}"][:] for name in "txp")
        for name in "txyp":
            pipeline = file[f"events/{name}"].id.get_create_plist()
            codes = {pipeline.get_filter(number)[0] for number in range(pipeline.get_nfilters())}
            assert codes <= {1, 2, 3}  # deflate, shuffle, fletcher32: what HDF5 has without a plug-in
    assert np.array_equal(index, milliseconds_to_index(t_us))
    assert np.array_equal(t_us + offset, events["t"])
    assert np.array_equal(p, events["p"] > 0)
    for start_us in np.random.default_rng(0).integers(0, 1_900_000, 50).tolist():
        first, last = index[start_us // 1000], index[-(-(start_us + window_us) // 1000)]
        near = slice(first, last)
        inside = (t_us[near] >= start_us) & (t_us[near] < start_us + window_us)
        wanted = (events["t"] >= offset + start_us) & (events["t"] < offset + start_us + window_us)
        assert x[near][inside].tolist() == events["x"][wanted].tolist()


def test_the_content_of_a_file_decides_and_not_its_name(tmp_path):
    write_events(tmp_path / "a.txt", some_events(0, 9, 64, 64, 99), 64, 64, "npz")
    assert read_events(tmp_path / "a.txt").format == "npz"
    (tmp_path / "a.npz").write_text("t_us x y p\n1 2 3 1\n")
    with pytest.raises(ValueError, match="begins like no known event file"):
        read_events(tmp_path / "a.npz")
    assert read_events(tmp_path / "a.npz", "txt").events.tolist() == [(1, 2, 3, 1)]
    with pytest.raises(ValueError, match="format must be one of"):
        read_events(tmp_path / "a.npz", "xyz")
