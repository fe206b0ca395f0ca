"""Damaged and hostile files of every format: one ValueError, in bounded memory and time."""

import base64
import json
import os
import subprocess
import sys
import tracemalloc
import zipfile
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest

from envs.recordings import FORMATS, read_events, write_events
from tests.support.bags import davis, write_bag
from tests.support.event_files import (
    LZ4_FILE,
    ZSTD_FILE,
    aedat2,
    aedat3,
    ecf_chunk,
    es,
    metavision,
    some_events,
)

ROOT = Path(__file__).resolve().parents[3]
# Each runs in a process of its own: a crash or a hang of a library must fail the test, not end it.


def run_child(paths: list[Path], rounds: int = 0, seed: int = 0) -> dict[str, dict[str, int]]:
    """How many reads of each file, or of damaged copies of it, were "read" and "refused"."""
    script = ROOT / "tests" / "support" / "damaged_files.py"
    child = subprocess.run(
        [sys.executable, str(script), str(rounds), str(seed), *map(str, paths)],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},  # by its path: other packages are called tests too
        capture_output=True,
        text=True,
    )
    assert child.returncode == 0, (child.returncode, child.stdout[-500:], child.stderr[-3000:])
    return json.loads(child.stdout)


EVENTS = some_events(0, 300, 34, 34, 100_000)


def one_of_each(folder: Path) -> list[Path]:
    """A good file of every format."""
    events, paths = EVENTS, []
    for format in ("npz", "hdf5", "txt", "csv", "dat", "evt2", "evt3", "aedat4"):
        suffix = {"txt": ".txt", "csv": ".csv", "hdf5": ".h5"}.get(format, "")
        paths.append(folder / f"{format}{suffix}")
        labels = {"is_noise": events["x"] < 9} if format in ("npz", "hdf5") else {}
        write_events(paths[-1], events, 34, 34, format, **labels)
    for name, text in (("aedat4_lz4", LZ4_FILE), ("aedat4_zstd", ZSTD_FILE)):
        paths.append(folder / name)
        paths[-1].write_bytes(zlib.decompress(base64.b85decode(text)))
    columns = [events[name].tolist() for name in "xyt"]
    paths.append(aedat2(folder / "aedat2", [(x << 1 | y << 8, t) for x, y, t in zip(*columns, strict=True)]))
    paths.append(folder / "nmnist.bin")
    entries = [(x << 32 | y << 24 | t).to_bytes(5, "big") for x, y, t in zip(*columns, strict=True)]
    paths[-1].write_bytes(b"".join(entries))
    paths.append(folder / "rows.npy")
    np.save(paths[-1], events)
    words = np.stack((events["x"].astype("<u4") << 17 | events["y"].astype("<u4") << 2 | 1, events["t"]), 1)
    paths.append(aedat3(folder / "aedat3", [(1, 0, 8, words.astype("<u4").tobytes())]))
    store, part = davis(events, "dvs_msgs", True)
    paths.append(write_bag(folder / "ros", {"/dvs/events": part}, store, True))
    paths += [es(folder / "es", events, 34, 34), metavision(folder / "metavision.h5", [ecf_chunk(0)])]
    halves = np.zeros((4, 2), "<u4")
    halves[:, 1] = [8 << 28, 1 << 28, 1 << 28 | 5, 0]
    halves[:, 0] = 7
    paths.append(folder / "evt21")
    paths[-1].write_bytes(b"% format EVT21;height=34;width=64\n% end\n" + halves.tobytes())
    return paths


def test_damaged_files_of_every_format_are_read_or_refused_by_name(tmp_path):
    paths = one_of_each(tmp_path)
    assert {read_events(path).format for path in paths} == set(FORMATS)
    counts = run_child(paths, rounds=30)
    for path in paths:
        assert sum(counts[path.name].values()) == 30
        assert counts[path.name]["refused"] > 6, path.name


@pytest.mark.parametrize("side", ["0", "70000", "99999999999999999999"])
def test_a_header_with_an_impossible_side_states_none(side, tmp_path):
    path = tmp_path / "street.txt"
    rows = "\n".join(f"{t} {x} {y} {p}" for t, x, y, p in EVENTS[["t", "x", "y", "p"]].tolist())
    path.write_text(f"{side} 34\n{rows}\n")
    file = read_events(path, format="txt", columns=("t", "x", "y", "p"))
    assert (file.width, file.height) == (None, 34)
    assert len(file.events) == len(EVENTS)
    assert read_events(path, format="txt", columns=("t", "x", "y", "p"), width=34).width == 34


@pytest.mark.parametrize("kind", ["V2", "S2", "c8"])
def test_a_field_without_real_numbers_is_refused_by_name(kind, tmp_path):
    path = tmp_path / "rows.npy"
    rows = np.zeros(30, [("t", "<i8"), ("x", kind), ("y", "<u2"), ("p", "i1")])
    np.save(path, rows)
    with pytest.raises(ValueError, match="column x has dtype") as refused:
        read_events(path)
    assert str(refused.value).count(str(path)) == 1


@pytest.mark.parametrize("kind", ["i1", "u1", "u2", "i4", "u8"])
def test_nanoseconds_of_any_type_are_rounded_without_overflow(kind, tmp_path):
    path = tmp_path / "rows.npy"
    rows = np.zeros(30, [("t", kind), ("x", "<u2"), ("y", "<u2"), ("p", "i1")])
    rows["t"] = t = np.linspace(0, min(np.iinfo(kind).max, 10**9), 30).astype(np.int64)
    np.save(path, rows)
    assert read_events(path, time_unit="ns").events["t"].tolist() == ((t + 500) // 1000).tolist()


def test_a_bag_is_read_up_to_a_damaged_message_and_says_so(tmp_path):
    store, part = davis(EVENTS, "dvs_msgs", True)
    path = write_bag(tmp_path / "ros", {"/dvs/events": part}, store, True)
    good = bytearray(path.read_bytes())
    good[good.rindex(b"time=", 0, good.rindex(b"op=\x04")) + 5] ^= 255  # unlike the time in the index
    path.write_bytes(good)
    file = read_events(path)
    assert file.damage
    assert 0 < len(file.events) < len(EVENTS)
    with pytest.raises(ValueError, match="damaged"):
        read_events(path, strict=True)


@pytest.mark.slow
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("part", range(16))
def test_a_million_damaged_files_are_read_or_refused_by_name(part, tmp_path):
    paths = one_of_each(tmp_path)
    rounds = 1 + 1_000_000 // 16 // len(paths)
    counts = run_child(paths, rounds, seed=1 + part)
    assert sum(map(sum, (count.values() for count in counts.values()))) > 1_000_000 // 16


@pytest.mark.system
def test_bombs_and_liars_are_refused_in_little_memory(tmp_path):
    shape = tmp_path / "shape.npz"
    with zipfile.ZipFile(shape, "w") as archive:
        for name in "txyp":
            with archive.open(f"{name}.npy", "w") as file:
                header = {"descr": "<i8", "fortran_order": False, "shape": (1 << 50,)}
                np.lib.format.write_array_header_1_0(file, header)
    declared = tmp_path / "declared.h5"
    with h5py.File(declared, "w") as file:
        for name in "txyp":
            file.create_dataset(f"events/{name}", (25 * 10**9,), "i8", chunks=(1024,), fillvalue=1)
    sparse = tmp_path / "sparse.raw"
    sparse.write_bytes(b"% evt 3.0\n")
    os.truncate(sparse, 1 << 40)
    line = tmp_path / "line.txt"
    line.touch()
    os.truncate(line, 7 << 30)
    vectors = tmp_path / "vectors.raw"  # 1.2e9 events in 200 MB
    with vectors.open("wb") as out:
        out.write(b"% evt 3.0\n" + np.array([0x8000, 0x0001, 0x3000], "<u2").tobytes())
        for _ in range(100):
            out.write(np.full(1 << 20, 0x4FFF, "<u2").tobytes())
    names = [shape, declared, sparse, line, vectors]
    assert all(path.stat().st_blocks * 512 < 1 << 28 for path in names)
    assert run_child(names) == {path.name: {"read": 0, "refused": 1} for path in names}
    for path in names:
        path.unlink()


@pytest.mark.parametrize("format", ["es", "floats", "npz", "hdf5", "txt", "evt3", "aedat4"])
def test_reading_takes_no_more_memory_than_stated(format, tmp_path):
    events, path = np.tile(EVENTS, 100), tmp_path / f"a.{format}"
    events["t"] = np.arange(len(events)) ^ 1  # half of them late
    ordered = events[np.argsort(events["t"])]
    if format == "es":
        es(path, ordered, 34, 34)
    elif format == "floats":
        columns = {name: np.where(events[name] < 0, 0, events[name]).astype(np.float64) for name in "txyp"}
        np.savez(tmp_path / "a", **columns)
        path = tmp_path / "a.npz"
    else:
        write_events(path, ordered, 34, 34, format)
    unit = "us" if format == "floats" else None
    read_events(path, time_unit=unit)  # imports what it needs
    tracemalloc.start()
    try:
        assert len(read_events(path, time_unit=unit).events) == len(events)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    each = 50 if format in ("es", "evt3") else 80
    assert peak < each * len(events) + (1 << 20)


@pytest.mark.parametrize("format", [None, "npz"])
def test_what_is_no_regular_file_is_refused_without_being_opened(format, tmp_path):
    os.mkfifo(tmp_path / "fifo.npz")
    (tmp_path / "empty.raw").touch()
    (tmp_path / "loop.raw").symlink_to("loop.raw")
    (tmp_path / "link.raw").symlink_to("fifo.npz")
    for path, rule in (
        (tmp_path, "is no regular file"),
        (tmp_path / "fifo.npz", "is no regular file"),
        (Path("/dev/zero"), "is no regular file"),
        (tmp_path / "empty.raw", "is empty"),
        (tmp_path / "missing.raw", "cannot be opened"),
        (tmp_path / "loop.raw", "cannot be opened"),
        (tmp_path / "link.raw", "is no regular file"),
        (tmp_path / "nul\0.raw", "cannot be opened"),
    ):
        with pytest.raises(ValueError, match=rule):
            read_events(path, format)


def test_a_flipped_bit_in_stored_events_is_noticed_where_the_format_has_checksums(tmp_path):
    for name in ("a.npz", "a.h5"):
        write_events(tmp_path / name, EVENTS, 34, 34)
        good = (tmp_path / name).read_bytes()
        first, size = packed_x(tmp_path / name)
        for place in range(first, first + size, 17):
            bad = bytearray(good)
            bad[place] ^= 4
            (tmp_path / name).write_bytes(bad)
            with pytest.raises(ValueError, match=name):
                read_events(tmp_path / name)


def packed_x(path: Path) -> tuple[int, int]:
    """Where the packed x of a file lies, and how many bytes it has."""
    if path.suffix == ".npz":
        with zipfile.ZipFile(path) as archive:
            info = archive.getinfo("x.npy")
        return path.read_bytes().index(b"x.npy") + 25, info.compress_size - 25
    with h5py.File(path) as file:
        chunk = file["events/x"].id.get_chunk_info(0)
    return int(chunk.byte_offset), int(chunk.size)
