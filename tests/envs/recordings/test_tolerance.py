"""Damage of real recordings is left out, counted and told; gaps are told; strict refuses."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.events import EVENT
from envs.recordings import read_events, read_parts, write_events
from envs.recordings.event_file import (
    CUT,
    CUT_LINE,
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
from tests.support.event_files import some_events

SECOND = 1_000_000


def save(path: Path, t_us: list[int] | np.ndarray, **columns: np.ndarray) -> Path:
    n = np.arange(len(t_us))
    arrays = {"t": np.asarray(t_us), "x": n % 64, "y": n % 48, "p": n % 2, **columns}
    np.savez(path, **arrays)
    return path


def test_left_over_events_of_an_older_clock_are_left_out(tmp_path):
    path = save(tmp_path / "a.npz", [9 * SECOND, 9 * SECOND + 10, *range(0, 2 * SECOND, 1000)])
    with pytest.warns(UserWarning, match="2 events of an older clock at the start"):
        file = read_events(path)
    assert file.events["t"].tolist() == list(range(0, 2 * SECOND, 1000))
    assert file.damage == {OLD_CLOCK: 2}
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
    with pytest.warns(UserWarning, match=r"no events for 3,000\.0 s from 0\.000 s on"):
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


FORMATS = ["dat", "evt2", "evt3", "aedat4", "txt", "csv"]


@pytest.mark.parametrize("format", FORMATS)
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None)
def test_a_file_that_was_cut_off_has_the_events_before_the_cut(format, seed, tmp_path_factory):
    rng, path = np.random.default_rng(seed), tmp_path_factory.mktemp("a") / f"a.{format}"
    events = some_events(seed, 30_000, 346, 260, SECOND)
    write_events(path, events, 346, 260, format)
    whole = path.read_bytes()
    path.write_bytes(whole[: rng.integers(len(whole) // 2, len(whole))])
    size = {"width": 346, "height": 260} if format == "csv" else {}
    back = read_events(path, **size)
    n = len(back.events) - (format in ("txt", "csv"))  # a number may have lost its last digits
    assert back.events[:n].tobytes() == events[:n].tobytes()
    assert n >= 0.4 * len(events) or format == "aedat4"  # whole packets of 16,384 events
    assert set(back.damage) <= {CUT, CUT_LINE, "packets that are damaged or were cut off"}


@pytest.mark.parametrize("format", ["npz", "h5", "dat", "evt2", "raw", "aedat4", "txt"])
def test_parts_are_the_whole_whatever_their_size(format, tmp_path):
    path = tmp_path / f"a.{format}"
    events = some_events(3, 20_000, 346, 260, 3 * SECOND)
    write_events(path, events, 346, 260, None if format in ("npz", "h5", "raw", "aedat4", "txt") else format)
    for size in (700, 4096, 50_000):
        parts = list(read_parts(path, part_events=size))
        assert np.concatenate([part.events for part in parts]).tobytes() == events.tobytes()
        assert max(len(part.events) for part in parts) <= 2 * size + (1 << 14)
    middle = read_events(path, start_us=SECOND, end_us=2 * SECOND).events
    t_us = events["t"]
    assert middle.tobytes() == events[(t_us >= SECOND) & (t_us < 2 * SECOND)].tobytes()


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


def test_times_that_go_back_again_and_again_are_refused(tmp_path):
    path = save(tmp_path / "a.npz", np.tile(np.arange(0, 20 * SECOND, SECOND // 2), 40))
    with pytest.raises(ValueError, match="goes back in time more than 16 times"):
        read_events(path)


def test_a_warning_names_the_file_and_comes_once(tmp_path):
    path = save(tmp_path / "a.npz", [9 * SECOND, *range(0, 3 * SECOND, 1000), 30 * SECOND])
    with pytest.warns(UserWarning, match=r"a\.npz") as said:
        read_events(path)
    (warning,) = said
    assert str(warning.message).startswith(f"{path}: left out or moved: 1 events of an older clock")
    assert "strict=True refuses" in str(warning.message)
    assert "no events for 27.0 s" in str(warning.message)
