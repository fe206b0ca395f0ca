"""Damage of real recordings is left out, counted and told; gaps are told; strict refuses."""

import warnings
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.events import EVENT
from envs.recordings import read_events, read_parts, write_events
from envs.recordings.event_file import (
    CUT,
    CUT_LINE,
    CUT_PACKETS,
    CUT_TABLE,
    OLD_CLOCK,
    OUTSIDE,
    RESETS,
    ROWS,
    STRAY_TIMES,
    TOO_LATE,
    TORN,
    Opened,
    Part,
    Request,
    Tally,
)
from envs.recordings.order import in_order
from tests.support.event_files import ecf_chunk, metavision, some_events

SECOND = 1_000_000


def save(path: Path, t_us: list[int] | np.ndarray, **columns: np.ndarray) -> Path:
    n = np.arange(len(t_us))
    arrays = {"t": np.asarray(t_us), "x": n % 64, "y": n % 48, "p": n % 2, **columns}
    np.savez(path, **arrays)
    return path


def test_left_over_events_of_an_older_clock_are_left_out_and_one_warning_tells_what_was_found(tmp_path):
    times_us = [*range(0, 2 * SECOND, 1000), 29 * SECOND]
    path = save(tmp_path / "a.npz", [9 * SECOND, 9 * SECOND + 10, *times_us])
    with pytest.warns(UserWarning, match=r"a\.npz") as said:
        file = read_events(path)
    assert file.events["t"].tolist() == times_us
    assert file.damage == {OLD_CLOCK: 2}
    (warning,) = said
    assert str(warning.message).startswith(
        f"{path}: left out or moved: 2 events of an older clock at the start"
    )
    assert "strict=True refuses" in str(warning.message)
    assert "no events for 27.0 s" in str(warning.message)
    with pytest.raises(ValueError, match="read it without strict"):
        read_events(path, strict=True)


def test_after_a_reset_in_the_middle_the_clock_goes_on(tmp_path):
    run = np.arange(0, 5 * SECOND, 100)
    file = read_events(save(tmp_path / "a.npz", np.concatenate((run, run))))
    last = run[-1]
    assert file.events["t"].tolist() == [*run.tolist(), *(run + last + 1).tolist()]
    assert file.damage == {RESETS: 1}


@pytest.mark.parametrize("wrong", [2**40, 50 * SECOND, 0])
def test_a_time_far_from_all_others_is_left_out_and_moves_nothing(wrong, tmp_path):
    t_us = 10 * SECOND + np.arange(2000)
    t_us[1000] = wrong
    file = read_events(save(tmp_path / "a.npz", t_us))
    assert file.events["t"].tolist() == np.delete(t_us, 1000).tolist()
    assert (file.damage, file.gaps) == ({STRAY_TIMES: 1}, ())


def test_seconds_that_were_not_carried_are_left_out(tmp_path):
    t_us = 5 * SECOND + np.arange(0, 2 * SECOND, 100)
    torn = np.flatnonzero(t_us % SECOND < 1000)[1:3]
    shown = t_us.copy()
    shown[torn] -= 999_000
    file = read_events(save(tmp_path / "a.npz", shown))
    assert file.damage == {TORN: 2}
    assert file.events["t"].tolist() == np.delete(t_us, torn).tolist()


def test_gaps_are_told_and_leave_nothing_out(tmp_path):
    t_us = [*range(40), *range(3000 * SECOND, 3000 * SECOND + 100)]
    file = read_events(save(tmp_path / "a.npz", t_us))
    assert file.events["t"].tolist() == t_us
    assert (file.gaps, file.damage) == (((39, 3000 * SECOND),), {})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read_events(save(tmp_path / "b.npz", range(100))).gaps == ()


def test_single_bad_rows_and_pixels_are_left_out_and_many_are_refused(tmp_path):
    x, t = np.arange(100) % 64, np.arange(100.0)
    x[7], t[9] = -1, np.nan
    path = save(tmp_path / "a.npz", t, x=x)
    file = read_events(path, width=63, height=48, time_unit="us")
    assert file.damage == {ROWS: 2, OUTSIDE: 1}
    assert len(file.events) == 97
    with pytest.raises(ValueError, match="outside the sensor of 9x48; give the right width and height"):
        read_events(path, width=9, height=48, time_unit="us")
    assert len(read_events(path, width=64, height=48, time_unit="us").events) == 98  # the remedy
    with pytest.raises(ValueError, match="x must lie in"):
        read_events(save(tmp_path / "b.npz", range(100), x=x - 20))


def ordered(t_us: np.ndarray, part: int, hold: int | None) -> tuple[np.ndarray, Tally]:
    events = some_events(0, len(t_us), 640, 480, 1)
    events["t"], tally = t_us, Tally()
    some = (Part(events[first : first + part]) for first in range(0, len(events), part))
    parts = list(in_order(Opened("x", Request(Path("a"), tally=tally), some), hold))
    return np.concatenate([np.empty(0, EVENT), *(one.events for one in parts)]), tally


@given(steps_us=st.lists(st.integers(-400, 500), min_size=1, max_size=60), part=st.integers(1, 20))
def test_late_events_are_sorted_in_with_ties_in_the_order_of_the_file(steps_us, part):
    t_us = 30_000 + np.cumsum(steps_us)
    whole, tally = ordered(t_us, part, None)
    parts, other = ordered(t_us, part, 1000)
    expected = some_events(0, len(t_us), 640, 480, 1)
    expected["t"] = t_us
    assert whole.tobytes() == parts.tobytes() == expected[np.argsort(t_us, kind="stable")].tobytes()
    assert tally.late == other.late == sum(t < max(t_us[: i + 1]) for i, t in enumerate(t_us))


@given(steps_us=st.lists(st.integers(-3000, 4000), min_size=1, max_size=60), hold=st.integers(1, 8))
def test_what_is_too_late_for_its_part_is_counted(steps_us, hold):
    t_us = 200_000 + np.cumsum(steps_us)
    parts, tally = ordered(t_us, hold, hold)
    assert np.all(np.diff(parts["t"]) >= 0)
    assert len(parts) + tally.damage[TOO_LATE] == len(t_us)


@pytest.mark.parametrize("format", ["dat", "evt2", "evt3", "aedat4", "txt", "csv"])
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=5, deadline=None)
def test_a_file_that_was_cut_off_has_the_events_before_the_cut(format, seed, tmp_path_factory):
    rng, path = np.random.default_rng(seed), tmp_path_factory.mktemp("a") / f"a.{format}"
    events = some_events(seed, 20_000, 346, 260, SECOND)
    write_events(path, events, 346, 260, format)
    whole = path.read_bytes()
    path.write_bytes(whole[: rng.integers(len(whole) // 2, len(whole))])
    size = {"width": 346, "height": 260} if format == "csv" else {}
    back = read_events(path, **size)
    n = len(back.events) - (format in ("txt", "csv"))  # a number may have lost its last digits
    assert back.events[:n].tobytes() == events[:n].tobytes()
    assert n >= 0.4 * len(events) or format == "aedat4"  # whole packets of 16,384 events
    assert set(back.damage) <= {CUT, CUT_LINE, CUT_PACKETS}


EVENTS = some_events(5, 300_000, 346, 260, 2 * SECOND)
SHARES = (0.999, 0.75, 0.6)


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


def rows(path: Path) -> None:
    """One data set of rows, neither packed nor in chunks."""
    kinds = [("t", "i8"), ("x", "u2"), ("y", "u2"), ("p", "u1")]
    table = np.empty(len(EVENTS), kinds)
    for name, values in columns().items():
        table[name] = values
    with h5py.File(path, "w") as file:
        file["events"] = table


@pytest.mark.parametrize("make", [ours, rows])
def test_an_hdf5_file_that_was_cut_off_has_the_events_before_the_cut(make, tmp_path):
    make(tmp_path / "a.h5")
    for share in SHARES:
        short = cut(tmp_path / "a.h5", share)
        file = read_events(short)
        n = len(file.events)
        assert file.events.tobytes() == EVENTS[:n].tobytes()
        assert n >= 0.9 * share * len(EVENTS) - 70_000
        assert file.damage == ({CUT_PACKETS: 1} if n < len(EVENTS) else {})
        assert sum(len(part.events) for part in read_parts(short, part_events=100_000)) == n
    assert n < len(EVENTS)
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
    n = len(read_events(cut(tmp_path / "a.npz", 1 - 150_000 / whole)).events)  # within p
    assert 0.4 * len(EVENTS) < n < len(EVENTS)
    write_events(tmp_path / "b.npz", EVENTS, 346, 260)
    short = cut(tmp_path / "b.npz", 1 - 60 / (tmp_path / "b.npz").stat().st_size)  # its table alone
    assert read_events(short).events.tobytes() == EVENTS.tobytes()
    with pytest.raises(ValueError, match="tables of contents"):
        read_events(short, strict=True)
