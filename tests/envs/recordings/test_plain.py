import io
import os
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.recordings import read_events, write_events
from envs.recordings.text import CHUNK_BYTES
from tests.support.event_files import some_events

DATA = Path(os.environ.get("EVADE_DATA", Path(__file__).resolve().parents[4] / "shared" / "data"))
SLIDER = DATA / "rpg_slider_depth" / "events_chunk.txt"
NMNIST = DATA / "nmnist" / "sample_nmnist.bin"
needs_slider = pytest.mark.skipif(not SLIDER.is_file(), reason=f"no {SLIDER}; set EVADE_DATA")
needs_nmnist = pytest.mark.skipif(not NMNIST.is_file(), reason=f"no {NMNIST}; set EVADE_DATA")
TXYP = ("t", "x", "y", "p")


def save(path: Path, **arrays: object) -> Path:
    columns = {"t": [1, 2], "x": [0, 1], "y": [0, 1], "p": [0, 1], **arrays}
    np.savez(path, **{name: np.asarray(values) for name, values in columns.items()})
    return path


@needs_slider
def test_the_slider_recording_is_read_with_named_columns_and_unit():
    file = read_events(SLIDER, columns=TXYP, time_unit="s", width=240, height=180)
    lines = [line.split() for line in SLIDER.read_text().splitlines()]
    expected = [(int(t.replace(".", "")) // 1000, int(x), int(y), 2 * int(p) - 1) for t, x, y, p in lines]
    nanoseconds = [int(line[0].replace(".", "")) for line in lines]
    assert len(file.events) == 50_000
    assert (file.events["t"][0], file.events["t"][-1]) == (3811, 174_156)
    assert all(
        abs(1000 * t - ns) <= 500 for t, ns in zip(file.events["t"].tolist(), nanoseconds, strict=True)
    )
    for place, name in enumerate("xyp", start=1):
        assert file.events[name].tolist() == [event[place] for event in expected]


@needs_nmnist
def test_the_digit_has_its_published_count_and_span():
    file = read_events(NMNIST)
    raw = NMNIST.read_bytes()
    words = [int.from_bytes(raw[start : start + 5], "big") for start in range(0, len(raw), 5)]
    assert (file.format, file.width, file.height) == ("nmnist", 34, 34)
    assert len(file.events) == 4325
    assert file.events["t"][-1] - file.events["t"][0] == 310_521
    assert file.events.tolist() == [
        (word % 2**23, word >> 32, word >> 24 & 255, 1 if word >> 23 & 1 else -1) for word in words
    ]


def test_the_clock_of_a_digit_is_unwrapped_and_overflow_rows_move_it(tmp_path):
    entries = [(1, 2, 0, 2**23 - 1), (3, 4, 1, 5), (0, 240, 0, 5), (5, 6, 1, 9)]
    raw = b"".join((x << 32 | y << 24 | p << 23 | t).to_bytes(5, "big") for x, y, p, t in entries)
    (tmp_path / "a.bin").write_bytes(raw)
    file = read_events(tmp_path / "a.bin")
    turned = 2**23
    assert file.events.tolist() == [
        (turned - 1, 1, 2, -1),
        (turned + 5, 3, 4, 1),
        (turned + 9 + 8192, 5, 6, 1),
    ]
    assert file.skipped == 1


@pytest.mark.parametrize("suffix", ["npz", "txt", "csv", "h5"])
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 200), until_us=st.sampled_from([5, 10**6, 2**51]))
@settings(max_examples=15, deadline=None)
def test_what_is_written_is_read(tmp_path_factory, suffix, seed, count, until_us):
    if suffix == "h5":
        until_us = min(until_us, 10**9)  # its index has an entry per millisecond
    path = tmp_path_factory.mktemp("a") / f"events.{suffix}"
    events = some_events(seed, count, 346, 260, until_us)
    write_events(path, events, 346, 260)
    size = {"width": 346, "height": 260} if suffix == "csv" else {}  # the only one that does not say
    back = read_events(path, **size)
    assert back.events.tobytes() == events.tobytes()
    assert (back.width, back.height, back.late, back.skipped) == (346, 260, 0, 0)
    once = path.read_bytes()
    write_events(path, events, 346, 260)
    assert path.read_bytes() == once or suffix == "h5"
    assert list(path.parent.iterdir()) == [path]


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


def test_labels_stay_with_events_that_are_sorted_in_and_bad_ones_are_refused(tmp_path):
    columns = {"t": [5, 3, 4], "x": [1, 2, 3], "y": [0, 0, 0], "p": [1, 0, 1]}
    np.savez(tmp_path / "a.npz", **columns, is_noise=[1, 0, 0])
    file = read_events(tmp_path / "a.npz")
    assert file.events["t"].tolist() == [3, 4, 5]
    assert file.is_noise.tolist() == [False, False, True]
    for wrong in ([1, 0], [0, 1, 2], [0.0, np.nan, 1.0], [[0, 1, 0]]):
        np.savez(tmp_path / "a.npz", **columns, is_noise=wrong)
        with pytest.raises(ValueError, match=r"a\.npz: .*is_noise"):
            read_events(tmp_path / "a.npz")


@pytest.mark.parametrize("format", ["txt", "csv", "dat", "evt2", "evt3", "aedat4"])
def test_a_format_without_labels_does_not_lose_them_in_silence(format, tmp_path):
    with pytest.raises(ValueError, match="stores no labels of noise; choose hdf5 or npz"):
        write_events(
            tmp_path / "a", some_events(0, 3, 346, 260, 9), 346, 260, format, is_noise=np.zeros(3, bool)
        )
    assert not list(tmp_path.iterdir())


def test_numpy_reads_what_is_written(tmp_path):
    events = some_events(0, 100, 346, 260, 10**6)
    write_events(tmp_path / "a.npz", events, 346, 260)
    write_events(tmp_path / "a.txt", events, 346, 260)
    stored = np.load(tmp_path / "a.npz")
    rows = np.loadtxt(tmp_path / "a.txt", dtype=np.int64)
    for place, name in enumerate(TXYP):
        assert np.array_equal(stored[name], events[name] > 0 if name == "p" else events[name])
        assert np.array_equal(rows[:, place], events[name])
    assert "# columns: t x y p\n" in (tmp_path / "a.txt").read_text()


def test_pandas_reads_csv_without_options(tmp_path):
    pandas = pytest.importorskip("pandas")
    events = some_events(0, 100, 346, 260, 10**6)
    write_events(tmp_path / "a.csv", events, 346, 260)
    table = pandas.read_csv(tmp_path / "a.csv")
    assert list(table.columns) == ["t_us", "x", "y", "p"]
    for name, column in zip(TXYP, table.columns, strict=True):
        assert np.array_equal(table[column], events[name])


def test_the_callers_columns_take_the_place_of_those_of_the_file(tmp_path):
    (tmp_path / "a.csv").write_text("t,x@320,y@240,on\n1000,2,3,1\n2000,4,5,0\n")
    with pytest.raises(ValueError, match="does not name the column 'x'"):
        read_events(tmp_path / "a.csv", time_unit="us")
    file = read_events(tmp_path / "a.csv", columns=TXYP, time_unit="us")
    assert file.events.tolist() == [(1000, 2, 3, 1), (2000, 4, 5, -1)]
    (tmp_path / "b.txt").write_text("# columns: x y p t\n# time_unit: us\n2 3 1 1000\n")
    assert read_events(tmp_path / "b.txt", columns=("y", "x", "p", "t")).events.tolist() == [(1000, 3, 2, 1)]


def test_a_byte_order_mark_is_passed_over(tmp_path):
    for text in ("t_us,x,y,p\n1000,2,3,1\n", "# columns: t x y p\n# time_unit: us\n1000 2 3 1\n"):
        (tmp_path / "a.txt").write_bytes(b"\xef\xbb\xbf" + text.encode())
        assert read_events(tmp_path / "a.txt").events.tolist() == [(1000, 2, 3, 1)]
    (tmp_path / "a.txt").write_bytes(b"\xef\xbb\xbf1000 2 3 1\n")
    assert read_events(tmp_path / "a.txt", columns=TXYP, time_unit="us").events.tolist() == [(1000, 2, 3, 1)]


def test_a_first_line_of_two_numbers_is_the_size_that_e2vid_writes(tmp_path):
    (tmp_path / "a.txt").write_text("240 180\n0.001 2 3 1\n0.002 4 5 0\n")
    file = read_events(tmp_path / "a.txt")
    assert (file.width, file.height) == (240, 180)
    assert file.events.tolist() == [(1000, 2, 3, 1), (2000, 4, 5, -1)]
    assert read_events(tmp_path / "a.txt", time_unit="ms").events["t"].tolist() == [1, 2]
    assert read_events(tmp_path / "a.txt", columns=("t", "y", "x", "p")).events["x"].tolist() == [3, 5]
    (tmp_path / "b.txt").write_text("240 180\n")
    assert len(read_events(tmp_path / "b.txt").events) == 0
    with pytest.raises(ValueError, match="says width=240 and the caller says 320"):
        read_events(tmp_path / "a.txt", width=320)


@pytest.mark.parametrize(
    "text",
    [
        "t_us,x,y,p\n1000,2,3,1\n2000,4,5,0\n",
        "x y polarity timestamp[ms]\n2 3 1 1\n4 5 -1 2\n",
        "# columns: t x y p\n# time_unit: us\n\n1000 2 3 1\n2000 4 5 -1\n",
        "ts_s, note, x, y, pol\n1e-3, 9, 2, 3, 1\n2e-3, 9, 4, 5, 0\n",
        "time_ns x y on\n1000000 2 3 1\r\n2000000 4 5 0\r\n",
    ],
)
def test_the_header_of_a_text_file_says_what_its_columns_are(text, tmp_path):
    (tmp_path / "a.txt").write_text(text)
    assert read_events(tmp_path / "a.txt").events.tolist() == [(1000, 2, 3, 1), (2000, 4, 5, -1)]


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("1 2 3 1\n", "does not name the column 't'"),
        ("t x y\n1 2 3\n", "does not name the column 'p'"),
        ("t x y p\n1 2 3 1\n", "does not say the unit"),
        ("t_us x y p pol\n1 2 3 1 1\n", "names the column p twice"),
        ("t_us x y p\nnan 2 3 1\n", "t must lie in"),
        ("t_us x y p\ninf 2 3 1\n", "t must lie in"),
        ("t_us x y p\n-1 2 3 1\n", "t must lie in"),
        ("t_us x y p\n1e300 2 3 1\n", "t must lie in"),
        ("t_us x y p\n1 -2 3 1\n", "x must lie in"),
        ("t_us x y p\n1 2 70000 1\n", "y must lie in"),
        ("t_us x y p\n1 2.5 3 1\n", "x must be whole pixels"),
        ("t_us x y p\n1 2 3 2\n", "polarity must be coded"),
        ("t_us x y p\n1 2 3 nan\n", "polarity must be coded"),
        ("t_us x y p\n1 2 3 0\n1 2 3 -1\n", "-1, 0 and 1 at once"),
        ("t_us x y p\n1 2 3\n", "no row of numbers"),
        ("t_us x y p\n1 two 3 1\n", "no row of numbers"),
        ("# width: 2\n# height: 9\nt_us x y p\n1 2 3 1\n", "1 of 1 outside the sensor of 2x9"),
        ("# width: many\nt_us x y p\n1 2 3 1\n", "no row of numbers"),
        ("t_us x y p\n" + "1 " * 600 + "\n", "a line of more than 1000 bytes"),
        ("1" * 3_000_000, "a line of more than 1000 bytes"),
    ],
)
def test_a_text_file_that_breaks_a_rule_is_refused(text, rule, tmp_path):
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(ValueError, match=rule) as caught:
        read_events(tmp_path / "a.txt")
    assert "a.txt" in str(caught.value)


def test_text_that_is_not_utf8_or_has_an_unknown_unit_is_refused(tmp_path):
    (tmp_path / "a.txt").write_bytes(b"t_us x y p\n1 2 3 \xff\n")
    with pytest.raises(ValueError, match="is not UTF-8 text"):
        read_events(tmp_path / "a.txt")
    (tmp_path / "a.txt").write_text("t_us x y p\n1 2 3 1\n")
    with pytest.raises(ValueError, match="time_unit must be one of"):
        read_events(tmp_path / "a.txt", time_unit="h")


def test_a_long_line_is_noticed_also_across_the_pieces_in_which_a_file_is_read(tmp_path):
    before = "# a line\n" * ((CHUNK_BYTES - 700) // 9)
    (tmp_path / "a.txt").write_text(before + "# " + "x" * 1400 + "\n1 2 3 1\n")
    with pytest.raises(ValueError, match="a line of more than 1000 bytes"):
        read_events(tmp_path / "a.txt")


def test_more_lines_than_asked_for_are_refused_before_they_are_parsed(tmp_path):
    (tmp_path / "a.txt").write_text("t_us x y p\n" + "1 2 3 1\n" * 3000)
    with pytest.raises(ValueError, match="at most max_events=1000"):
        read_events(tmp_path / "a.txt", max_events=1000)


def test_npz_times_are_integers_of_microseconds_or_have_a_unit(tmp_path):
    assert read_events(save(tmp_path / "a.npz")).events["t"].tolist() == [1, 2]
    seconds = save(tmp_path / "b.npz", t=[0.5, 1.25])
    assert read_events(seconds, time_unit="s").events["t"].tolist() == [500_000, 1_250_000]
    with pytest.raises(ValueError, match="does not say the unit"):
        read_events(seconds)


def test_short_floats_and_integers_of_an_npz_file_do_not_overflow(tmp_path):
    half = {name: np.array([0, 1.5 if name == "t" else 1], np.float16) for name in TXYP}
    file = read_events(save(tmp_path / "a.npz", **half), time_unit="s")
    assert file.events.tolist() == [(0, 0, 0, -1), (1_500_000, 1, 1, 1)]
    for kind in (np.float16, np.float32, np.int8, np.uint64):
        path = save(tmp_path / "b.npz", t=np.array([100, 120], kind), x=np.array([1, 2], kind))
        assert read_events(path, time_unit="ms").events["t"].tolist() == [100_000, 120_000]


@pytest.mark.parametrize("p", [[0, 1], [-1, 1], [False, True], [0.0, 1.0]])
def test_both_codes_of_polarity_are_understood_in_every_type(p, tmp_path):
    assert read_events(save(tmp_path / "a.npz", p=p)).events["p"].tolist() == [-1, 1]


@pytest.mark.parametrize(
    ("arrays", "rule"),
    [
        ({"t": [[1], [2]]}, r"has no array 't'; it contains t int64 \(2, 1\)"),
        ({"t": [1]}, "different lengths"),
        ({"t": np.array([2**62, 2**63], np.uint64)}, "t must lie in"),
        ({"t": [1 + 2j, 2]}, "t has dtype complex128"),
        ({"p": ["a", "b"]}, "p has dtype <U1"),
        ({"x": [-2, -1]}, "x must lie in"),
        ({"width": 1, "height": 5, "x": [1, 1]}, "x=1, y=1, 2 of 2 outside the sensor of 1x5"),
        ({"width": [1, 2]}, "array width"),
        ({"width": "wide"}, "is no readable array file"),
        ({"time_unit": "weeks"}, "does not say the unit"),
    ],
)
def test_an_npz_file_that_breaks_a_rule_is_refused(arrays, rule, tmp_path):
    with pytest.raises(ValueError, match=rule) as caught:
        read_events(save(tmp_path / "a.npz", **arrays))
    assert "a.npz" in str(caught.value)


class Payload:
    def __reduce__(self):
        return (Path.touch, (Path("pwned"),))


def test_a_pickle_in_an_npz_file_is_not_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = save(tmp_path / "a.npz", p=np.array([Payload(), 1], object))
    with pytest.raises(ValueError, match="p has dtype object"):
        read_events(path)
    assert not Path("pwned").exists()


def zipped(path: Path, members: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def npy(header: dict, body: bytes) -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, header)
    return file.getvalue() + body


@pytest.mark.parametrize(
    ("header", "body", "rule"),
    [
        ({"descr": "<i8", "fortran_order": False, "shape": (10**13,)}, b"", "arrays of different lengths"),
        (
            {"descr": "<i8", "fortran_order": False, "shape": (2,)},
            bytes(10**8),
            "array t contains more than it declares",
        ),
        ({"descr": "<i8", "fortran_order": False, "shape": (-2,)}, bytes(10**8), "shape \\(-2,\\)"),
    ],
)
def test_an_array_that_lies_about_its_length_is_refused(header, body, rule, tmp_path):
    path = save(tmp_path / "good.npz")
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members["t.npy"] = npy(header, body)
    with pytest.raises(ValueError, match=rule):
        read_events(zipped(tmp_path / "a.npz", members))


def test_an_array_that_unpacks_to_more_than_it_declares_takes_no_memory(tmp_path):
    header = npy({"descr": "<i8", "fortran_order": False, "shape": (2,)}, b"")
    members = {f"{name}.npy": header + bytes(1 << 26) for name in TXYP}
    path = zipped(tmp_path / "a.npz", members)
    members.clear()
    tracemalloc.start()
    with pytest.raises(ValueError, match="array t contains more than it declares"):
        read_events(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 22


@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '<i8', 'fortran_order': False, 'shape': (2,), ",  # numpy raises tokenize.TokenError
        "{'descr': ('<i8',), 'fortran_order': False, 'shape': (2,), }",
        "{'descr': ['a'], 'fortran_order': False, 'shape': (2,), }",
        "[" * 300,
    ],
)
def test_a_header_that_numpy_cannot_parse_is_refused_by_name(header, tmp_path):
    body = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode() + bytes(16)
    with pytest.raises(ValueError, match=r"a\.npz: array t has no sound header"):
        read_events(zipped(tmp_path / "a.npz", {f"{name}.npy": body for name in TXYP}))


def test_an_array_without_a_sound_header_and_a_missing_one_are_refused(tmp_path):
    members = {f"{name}.npy": b"junk" for name in TXYP}
    with pytest.raises(ValueError, match="array t has no sound header"):
        read_events(zipped(tmp_path / "a.npz", members))
    body = npy({"descr": "<i8", "fortran_order": False, "shape": (2,)}, bytes(16))
    members = {f"{name}.npy": body for name in "txp"}
    with pytest.raises(ValueError, match="has no array 'y'"):
        read_events(zipped(tmp_path / "a.npz", members))
