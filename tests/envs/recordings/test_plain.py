"""Text, npz and the digits of N-MNIST: real recordings, values of every type, and files that break a rule."""

import io
import os
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from envs.recordings import read_events
from envs.recordings.text import CHUNK_BYTES

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
    t, x, y, p = zip(*(line.split() for line in SLIDER.read_text().splitlines()), strict=True)
    assert len(file.events) == 50_000
    assert (file.events["t"][0], file.events["t"][-1]) == (3811, 174_156)
    nanoseconds = np.array([int(text.replace(".", "")) for text in t])
    assert np.abs(1000 * file.events["t"] - nanoseconds).max() <= 500
    assert np.array_equal(file.events["x"], np.array(x, int))
    assert np.array_equal(file.events["y"], np.array(y, int))
    assert np.array_equal(file.events["p"], 2 * np.array(p, int) - 1)


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
    turn = 2**23
    entries = [(1, 2, 0, turn - 1), (3, 4, 1, 5), (0, 240, 0, 5), (5, 6, 1, 9)]
    raw = b"".join((x << 32 | y << 24 | p << 23 | t).to_bytes(5, "big") for x, y, p, t in entries)
    (tmp_path / "a.bin").write_bytes(raw)
    file = read_events(tmp_path / "a.bin")
    assert file.events.tolist() == [(turn - 1, 1, 2, -1), (turn + 5, 3, 4, 1), (turn + 9 + 8192, 5, 6, 1)]
    assert file.skipped == 1


def test_labels_stay_with_events_that_are_sorted_in_and_bad_ones_are_refused(tmp_path):
    columns = {"t": [5, 3, 4], "x": [1, 2, 3], "y": [0, 0, 0], "p": [1, 0, 1]}
    file = read_events(save(tmp_path / "a.npz", **columns, is_noise=[1, 0, 0]))
    assert file.events["t"].tolist() == [3, 4, 5]
    assert file.is_noise.tolist() == [False, False, True]
    assert file.late == 2
    for wrong in ([1, 0], [0, 1, 2], [0.0, np.nan, 1.0], [[0, 1, 0]]):
        with pytest.raises(ValueError, match=r"a\.npz: .*is_noise"):
            read_events(save(tmp_path / "a.npz", **columns, is_noise=wrong))


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("t x y\n1 2 3\n", "does not name the column 'p'"),
        ("t_us x y p\nnan 2 3 1\n", "t must lie in"),
        ("t_us x y p\n-1 2 3 1\n", "t must lie in"),
        ("t_us x y p\n1e300 2 3 1\n", "t must lie in"),
        ("t_us x y p\n1 2 70000 1\n", "y must lie in"),
        ("t_us x y p\n1 2 3 nan\n", "polarity must be coded"),
        ("t_us x y p\n1 2 3\n", "no row of numbers"),
        ("# width: 2\n# height: 9\nt_us x y p\n1 2 3 1\n", "1 of 1 outside the sensor of 2x9"),
        ("# width: many\nt_us x y p\n1 2 3 1\n", "no row of numbers"),
        # Noticed also across the pieces in which a file is read.
        ("# a line\n" * ((CHUNK_BYTES - 700) // 9) + "# " + "x" * 1400, "a line of more than 1000 bytes"),
    ],
)
def test_a_text_file_that_breaks_a_rule_is_refused(text, rule, tmp_path):
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(ValueError, match=rule) as caught:
        read_events(tmp_path / "a.txt")
    assert "a.txt" in str(caught.value)


def test_more_lines_than_asked_for_and_an_unknown_unit_are_refused(tmp_path):
    (tmp_path / "a.txt").write_text("t_us x y p\n" + "1 2 3 1\n" * 3000)
    with pytest.raises(ValueError, match="at most max_events=1000"):
        read_events(tmp_path / "a.txt", max_events=1000)
    with pytest.raises(ValueError, match="time_unit must be one of"):
        read_events(tmp_path / "a.txt", time_unit="h")


def test_npz_times_are_integers_of_microseconds_or_have_a_unit(tmp_path):
    assert read_events(save(tmp_path / "a.npz")).events["t"].tolist() == [1, 2]
    seconds = save(tmp_path / "b.npz", t=[0.5, 1.25])
    assert read_events(seconds, time_unit="s").events["t"].tolist() == [500_000, 1_250_000]
    for path in (seconds, save(tmp_path / "c.npz", time_unit="weeks")):
        with pytest.raises(ValueError, match="does not say the unit"):
            read_events(path)


def test_short_floats_and_integers_of_an_npz_file_do_not_overflow(tmp_path):
    half = {name: np.array([0, 1.5 if name == "t" else 1], np.float16) for name in TXYP}
    file = read_events(save(tmp_path / "a.npz", **half), time_unit="s")
    assert file.events.tolist() == [(0, 0, 0, -1), (1_500_000, 1, 1, 1)]
    for kind in (np.float16, np.float32, np.int8, np.uint64):
        path = save(tmp_path / "b.npz", t=np.array([100, 120], kind), x=np.array([1, 2], kind))
        assert read_events(path, time_unit="ms").events["t"].tolist() == [100_000, 120_000]


@pytest.mark.parametrize("p", [[-1, 1], [False, True], [0.0, 1.0]])
def test_both_codes_of_polarity_are_understood_in_every_type(p, tmp_path):
    assert read_events(save(tmp_path / "a.npz", p=p)).events["p"].tolist() == [-1, 1]


@pytest.mark.parametrize(
    ("arrays", "rule"),
    [
        ({"t": [[1], [2]]}, r"has no array 't'; it contains t int64 \(2, 1\)"),
        ({"t": np.array([2**62, 2**63], np.uint64)}, "t must lie in"),
        ({"t": [1 + 2j, 2]}, "t has dtype complex128"),
        ({"p": ["a", "b"]}, "p has dtype <U1"),
        ({"width": 1, "height": 5, "x": [1, 1]}, "x=1, y=1, 2 of 2 outside the sensor of 1x5"),
        ({"p": np.zeros(2, "V0")}, "p has dtype .*V0"),
        ({"is_noise": np.zeros((2, 0), bool)}, r"is_noise has dtype bool and shape \(2, 0\); save numbers"),
        ({"width": "wide"}, "is no readable array file"),
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


def zipped(path: Path, t: bytes) -> Path:
    """Arrays of two numbers, but for t, which has these bytes."""
    members = dict.fromkeys("xyp", npy(2, bytes(16))) | {"t": t}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return path


def npy(length: int, body: bytes = b"") -> bytes:
    file = io.BytesIO()
    header = {"descr": "<i8", "fortran_order": False, "shape": (length,)}
    np.lib.format.write_array_header_1_0(file, header)
    return file.getvalue() + body


def headed(header: str) -> bytes:
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode() + bytes(16)


@pytest.mark.parametrize(
    ("t", "rule"),
    [
        (npy(10**13), "arrays of different lengths"),
        (npy(-2), r"shape \(-2,\)"),
        (b"junk", "array t has no sound header"),
        # A TokenError, a TypeError and a MemoryError of numpy.
        (headed("{'descr': '<i8', 'fortran_order': False, 'shape': (2,), "), "array t has no sound header"),
        (headed("{'descr': ['a'], 'fortran_order': False, 'shape': (2,), }"), "array t has no sound header"),
        (headed("[" * 300), "array t has no sound header"),
    ],
)
def test_an_array_whose_header_lies_or_makes_no_sense_is_refused(t, rule, tmp_path):
    with pytest.raises(ValueError, match=r"a\.npz: .*" + rule):
        read_events(zipped(tmp_path / "a.npz", t))


def test_an_array_that_unpacks_to_more_than_it_declares_takes_no_memory(tmp_path):
    path = zipped(tmp_path / "a.npz", npy(2, bytes(1 << 26)))
    tracemalloc.start()
    with pytest.raises(ValueError, match="array t contains more than it declares"):
        read_events(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 22
