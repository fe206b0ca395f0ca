"""HDF5 and zip files that were cut off have the events before the cut."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from envs.recordings import read_events, read_parts, write_events
from envs.recordings.event_file import CUT, CUT_PACKETS, CUT_TABLE
from tests.support.event_files import ecf_chunk, metavision, some_events

EVENTS = some_events(5, 600_000, 346, 260, 2_000_000)
SHARES = (0.999, 0.9, 0.75, 0.6)


def cut(path: Path, share: float) -> Path:
    """A copy of the first bytes of a file."""
    whole = path.read_bytes()
    short = path.with_name(f"cut{path.suffix}")
    short.write_bytes(whole[: int(share * len(whole))])
    return short


def columns() -> dict[str, np.ndarray]:
    return {name: EVENTS[name] for name in "txy"} | {"p": (EVENTS["p"] > 0).astype("u1")}


def ours(path: Path) -> None:
    write_events(path, EVENTS, 346, 260)


def interleaved(path: Path) -> None:
    """A recorder that adds a second of events at a time."""
    with h5py.File(path, "w") as file:
        for name, values in columns().items():
            file.create_dataset(
                f"events/{name}", (0,), values.dtype, maxshape=(None,), chunks=(4096,), compression="lzf"
            )
        for first in range(0, len(EVENTS), 50_000):
            for name, values in columns().items():
                data = file[f"events/{name}"]
                data.resize((first + 50_000,))
                data[first:] = values[first : first + 50_000]


def rows(path: Path) -> None:
    """One data set of rows, neither packed nor in chunks."""
    kinds = [("t", "i8"), ("x", "u2"), ("y", "u2"), ("p", "u1")]
    table = np.empty(len(EVENTS), kinds)
    for name, values in columns().items():
        table[name] = values
    with h5py.File(path, "w") as file:
        file["events"] = table


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("make", [ours, interleaved, rows])
def test_an_hdf5_file_that_was_cut_off_has_the_events_before_the_cut(make, share, tmp_path):
    path = tmp_path / "a.h5"
    make(path)
    short = cut(path, share)
    file = read_events(short)
    n = len(file.events)
    assert file.events.tobytes() == EVENTS[:n].tobytes()
    assert n >= 0.9 * share * len(EVENTS) - 70_000
    assert file.damage == ({CUT_PACKETS: 1} if n < len(EVENTS) else {})
    parts = list(read_parts(short, part_events=100_000))
    assert sum(len(part.events) for part in parts) == n
    if n < len(EVENTS):
        with pytest.raises(ValueError, match="packets that are damaged or were cut off"):
            read_events(short, strict=True)


def test_a_metavision_file_that_was_cut_off_has_its_whole_chunks(tmp_path):
    path = metavision(tmp_path / "a.h5", [ecf_chunk(0)] * 400, count=60_000)
    assert len(read_events(path).events) == 60_000
    for share in (0.95, 0.7):
        file = read_events(cut(path, share))
        assert 0.8 * share < len(file.events) / 60_000 < share + 0.05
        assert (len(file.events) % 150, file.damage) == (0, {CUT_PACKETS: 1})


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_a_zip_file_of_rows_that_was_cut_off_has_the_rows_before_the_cut(save, tmp_path):
    save(tmp_path / "a.npz", events=EVENTS)
    for share in SHARES:
        file = read_events(cut(tmp_path / "a.npz", share))
        n = len(file.events)
        assert file.events.tobytes() == EVENTS[:n].tobytes()
        assert n >= 0.9 * share * len(EVENTS)
        assert set(file.damage) == {CUT, CUT_TABLE}


def test_a_zip_file_of_columns_needs_all_four(tmp_path):
    np.savez(tmp_path / "a.npz", **columns())
    whole = (tmp_path / "a.npz").stat().st_size
    n = len(read_events(cut(tmp_path / "a.npz", 1 - 300_000 / whole)).events)  # within p
    assert 0.4 * len(EVENTS) < n < len(EVENTS)
    with pytest.raises(ValueError, match=r"before the end of its columns \(t.npy\); copy it again"):
        read_events(cut(tmp_path / "a.npz", 0.6))
    write_events(tmp_path / "b.npz", EVENTS, 346, 260)
    short = cut(tmp_path / "b.npz", 1 - 60 / (tmp_path / "b.npz").stat().st_size)  # its table alone
    assert read_events(short).events.tobytes() == EVENTS.tobytes()
    with pytest.raises(ValueError, match="tables of contents"):
        read_events(short, strict=True)
