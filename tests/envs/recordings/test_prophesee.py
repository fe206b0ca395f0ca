import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from envs.events import EVENT
from envs.recordings import read_events, write_events
from envs.recordings.clocks import unwrap
from envs.recordings.event_file import CUT, OUTSIDE, RESERVED, TRIGGER, usual_events
from envs.recordings.evt_decoders import State, decode_dat, decode_evt3, new_state
from tests.support.event_files import some_events

DATA = Path(os.environ.get("EVADE_DATA", Path(__file__).resolve().parents[4] / "shared" / "data"))
EVT3_SAMPLE = DATA / "expelliarmus_evt" / "evt3_sample.raw"
needs_sample = pytest.mark.skipif(not EVT3_SAMPLE.is_file(), reason=f"no {EVT3_SAMPLE}; set EVADE_DATA")

OFF, ON, TIME_HIGH, TRIGGER_KIND, VENDOR = 0, 1, 8, 10, 14
NOT_THERE = (1, 11, 12, 13)  # types of words that EVT 3.0 does not have
PADDING = 9


def slow_clock(highs: list[int], step_us: int, count: int) -> list[int | None]:
    """Times of the high parts of a clock with so many of them, None for the stray ones."""

    def turned(value: int, now_us: int) -> int:
        turns, last = divmod(now_us // step_us, count)
        return (turns + (last - value > count // 2)) * count * step_us + value * step_us

    times, now_us = [], None
    for i, value in enumerate(highs):
        if now_us is None:
            t_us = value * step_us
            before = [v < value and abs(t_us - turned(v, t_us)) > 1e6 for v in highs[i + 1 : i + 3]]
            stray = bool(before) and all(before)
        else:
            t_us = turned(value, now_us)
            near = any(abs(turned(later, now_us) - now_us) <= 1e6 for later in highs[i + 1 : i + 17])
            stray = abs(t_us - now_us) > 1e6 and near
        times.append(None if stray else t_us)
        now_us = now_us if stray else t_us
    return times


def slow_evt3(words: list[int]) -> list[tuple[int, int, int, int]]:  # noqa: C901
    """The published table, one word at a time, written without a look at the kernel."""
    events, row, base, time, low = [], None, None, None, 0
    times = iter(slow_clock([word % 4096 for word in words if word // 4096 == 0x8], 4096, 4096))
    for word in words:
        kind, value = divmod(word, 4096)
        if kind == 0x0:
            row = value % 2048
        elif kind in (0x2, 0x3):
            base = [value % 2048, 1 if value >= 2048 else -1]
        elif kind == 0x6:
            low = value
        elif kind == 0x8:
            later = next(times)
            low = low if later in (None, time) else 0
            time = time if later is None else later
        length = {0x2: 1, 0x4: 12, 0x5: 8}.get(kind, 0)
        for bit in range(length):
            if (kind == 0x2 or (value >> bit) % 2) and None not in (time, row, base):
                events.append((time + low, base[0] + bit, row, base[1]))
        if kind in (0x4, 0x5) and base is not None:
            base[0] += length
    return events


def first_beyond(words: list[int]) -> int:
    """Index of the first vector of EVT 3.0 that reaches beyond 2048 columns, or -1."""
    x = 0
    for i, word in enumerate(words):
        kind, value = divmod(word, 4096)
        length = {0x4: 12, 0x5: 8}.get(kind, 0)
        if any(value >> bit & 1 and x + bit >= 2048 for bit in range(length)):
            return i
        x = value % 2048 if kind in (0x2, 0x3) else x + length
    return -1


def slow_evt2(words: list[int], width: int = 1) -> list[tuple[int, int, int, int]]:
    """EVT 2.0 (width 1), or EVT 2.1 as (upper half, mask) pairs (width 32)."""
    pairs = [(word, 1) if width == 1 else word for word in words]
    highs = [upper % 2**28 for upper, _ in pairs if upper // 2**28 == TIME_HIGH]
    events, time, times = [], None, iter(slow_clock(highs, 64, 2**28))
    for upper, mask in pairs:
        kind = upper // 2**28
        if kind == TIME_HIGH:
            later = next(times)
            time = time if later is None else later
        elif kind in (OFF, ON) and time is not None:
            for bit in range(width):
                if mask >> bit & 1:
                    t_us = time + upper // 2**22 % 64
                    events.append((t_us, upper // 2**11 % 2**11 + bit, upper % 2**11, 2 * kind - 1))
    return events


def raw(path: Path, words: np.ndarray, header: str) -> Path:
    path.write_bytes(f"% {header}\n% end\n".encode() + words.tobytes())
    return path


def words3(*words: int) -> bytes:
    return b"% evt 3.0\n" + np.array(words, "<u2").tobytes()


# The last of 32 pixels from x = 2017 on.
EVT21_GOOD = b"% format EVT21;\n" + np.array([0, 8 << 28, 0xFFFFF, 1 << 28], "<u4").tobytes()
EVT21_BEYOND = np.array([1 << 31, 1 << 28 | 2017 << 11], "<u4").tobytes()


def tuples(events: np.ndarray) -> list[tuple[int, int, int, int]]:
    return events.tolist()


@needs_sample
def test_the_street_recording_has_its_published_counts():
    file = read_events(EVT3_SAMPLE)
    assert (file.format, file.width, file.height, file.late, file.skipped) == ("evt3", 1280, 720, 0, 0)
    assert len(file.events) == 219_596
    assert file.events["t"][-1] - file.events["t"][0] == 8801
    assert tuples(file.events[[0, -1]]) == [(11_718_656, 874, 200, -1), (11_727_457, 1218, 572, 1)]


@needs_sample
def test_the_street_recording_decodes_as_by_the_published_table():
    head = b"".join(line for line in EVT3_SAMPLE.open("rb").readlines()[:7] if line.startswith(b"% "))
    words = np.frombuffer(EVT3_SAMPLE.read_bytes()[len(head) :], "<u2")
    assert tuples(read_events(EVT3_SAMPLE).events) == slow_evt3(words.tolist())


@needs_sample
def test_the_street_recording_has_the_pixels_that_another_decoder_gives():
    """That decoder's own times are wrong from event 20,121 on, where it misses a high part."""
    other = read_events(EVT3_SAMPLE.with_name("evt3_sample_npy.npz"))
    ours = read_events(EVT3_SAMPLE).events
    for name in "xyp":
        assert np.array_equal(ours[name], other.events[name])
    assert np.array_equal(ours["t"][:20_121], other.events["t"][:20_121])


@pytest.mark.parametrize("seed", range(3))
def test_evt3_words_in_any_order_decode_as_by_the_published_table(seed, tmp_path):
    rng = np.random.default_rng(seed)
    kinds = rng.choice([0, 2, 2, 3, 4, 4, 5, 6, 7, 10, 14, 15], 3000)
    words = (kinds << 12 | rng.integers(0, 4096, 3000)).astype("<u2")
    words[words >> 12 == 0] &= 0x07FF
    clock = np.flatnonzero(rng.random(3000) < 0.05)  # a clock that goes round and round
    words[clock] = 0x8000 | np.arange(len(clock)) * (40 + 20 * seed) & 0xFFF
    words[words >> 12 == 6] &= 0xF07F  # no way back of more than a second in a test of 4 ms steps
    while (place := first_beyond(words.tolist())) >= 0:
        words[place] &= 0xF000
    expected = sorted(slow_evt3(words.tolist()), key=lambda event: event[0])
    found = read_events(raw(tmp_path / "a.raw", words, "format EVT3;height=2048;width=2048"))
    assert tuples(found.events) == expected
    assert len(expected) > 3000


@given(seed=st.integers(0, 2**32 - 1), length=st.integers(0, 100), part=st.integers(32, 60))
def test_any_evt3_words_give_the_events_and_counts_of_the_table_in_parts_of_any_size(seed, length, part):
    rng = np.random.default_rng(seed)
    kinds = rng.choice([0, 2, 3, 4, 5, 6, 7, 8, 8, PADDING, 10, *NOT_THERE, 14], length)
    array = (kinds << 12 | rng.integers(0, 4096, length) & rng.choice([1, 4095], length)).astype("<u2")
    words, state, found, edges = array.tolist(), new_state(), [], []
    while state[State.WORD] < length:
        events, triggers = np.empty(part, EVENT), np.empty(2, TRIGGER)
        n, k = decode_evt3(array, state, events, triggers)
        found += tuples(events[:n])
        edges += triggers[:k].tolist()
    expected = slow_evt3(words)
    assert found == [event for event in expected if event[1] < 2048]
    masks = {0x2: lambda _: 1, 0x4: lambda value: value, 0x5: lambda value: value % 256}
    entries = [masks[word >> 12](word % 4096) for word in words if word >> 12 in masks]
    total = sum(mask.bit_count() for mask in entries)
    of_kind = {kind: sum(word >> 12 == kind for word in words) for kind in range(16)}
    assert state[State.BEYOND] == len(expected) - len(found)
    assert state[State.SKIPPED] == total - len(expected) + of_kind[PADDING] + of_kind[TRIGGER_KIND]
    assert state[State.RESERVED] == sum(of_kind[kind] for kind in NOT_THERE)
    shown = [word for word in words if word >> 12 == TRIGGER_KIND]
    assert [(c, p) for _, c, p in edges] == [
        (w >> 8 & 15, 2 * (w & 1) - 1) for w in shown[-len(edges) :] if edges
    ]


@given(seed=st.integers(0, 2**32 - 1))
def test_dat_entries_give_the_columns_of_the_published_table(seed):
    rng = np.random.default_rng(seed)
    entries = np.empty(100, [("t", "<u4"), ("data", "<u4")])
    steps = rng.integers(-(2**31), 2**31, 100) if seed % 2 else rng.integers(-1000, 2**31, 100)
    entries["t"] = np.cumsum(steps) % 2**32
    entries["data"] = rng.integers(0, 2**32, 100)
    events = np.empty(100, EVENT)
    decode_dat(entries, -1, events)
    data = entries["data"].tolist()
    assert tuples(events) == [
        (t, d % 2**14, d // 2**14 % 2**14, 1 if d // 2**28 % 2 else -1)
        for t, d in zip(unwrap(entries["t"], 32, -1).tolist(), data, strict=True)
    ]


@pytest.mark.parametrize("endianness", ["little", "legacy"])
def test_evt21_vectors_decode_as_by_the_published_table_in_both_orders_of_halves(endianness, tmp_path):
    rng = np.random.default_rng(1)
    uppers = (rng.choice([OFF, ON, TRIGGER_KIND, VENDOR], 500) << 28 | rng.integers(0, 2**28, 500)).astype(
        "<u4"
    )
    masks = rng.integers(0, 2**32, 500, dtype="<u4")
    uppers &= ~np.uint32(1 << 21)  # x below 1024: no vector reaches beyond the last column
    clock = np.arange(5, 500, 20)  # the first words have no time
    uppers[clock] = TIME_HIGH << 28 | np.arange(2**28 - 10, 2**28 - 10 + len(clock)) & 2**28 - 1
    halves = (uppers, masks) if endianness == "legacy" else (masks, uppers)
    path = raw(tmp_path / "a.raw", np.stack(halves, axis=1), f"format EVT21;endianness={endianness}")
    found = read_events(path)
    expected = slow_evt2(list(zip(uppers.tolist(), masks.tolist(), strict=True)), 32)
    assert tuples(found.events) == sorted(expected, key=lambda event: event[0])
    assert expected[-1][0] > 2**34 > expected[0][0]
    first = (uppers[:5] >> 28 <= 1) * np.array([bin(mask).count("1") for mask in masks[:5].tolist()])
    assert found.skipped == first.sum() + len(found.triggers) + np.sum(uppers[:5] >> 28 == TRIGGER_KIND)
    assert first.sum() > 0 < len(found.triggers)


def test_evt2_words_decode_as_by_the_published_table(tmp_path):
    rng = np.random.default_rng(2)
    words = (rng.choice([OFF, ON, TRIGGER_KIND, VENDOR, 15], 500) << 28 | rng.integers(0, 2**28, 500)).astype(
        "<u4"
    )
    clock = np.arange(3, 500, 20)
    words[clock] = TIME_HIGH << 28 | np.arange(2**28 - 10, 2**28 - 10 + len(clock)) & 2**28 - 1
    found = read_events(raw(tmp_path / "a.raw", words, "evt 2.0"))
    assert tuples(found.events) == sorted(slow_evt2(words.tolist()), key=lambda event: event[0])
    assert found.events["t"][-1] > 2**34


@pytest.mark.parametrize("t_us", [[5, 2**31 + 6], [0, 2**32 - 1], [7, 2**32 - 7, 2**32 + 7]])
def test_a_gap_of_more_than_half_the_clock_is_told_until_it_wraps(t_us, tmp_path):
    counter = np.array(t_us) % 2**32
    np.testing.assert_array_equal(unwrap(counter.astype(np.uint32), 32, -1), t_us)
    events = np.zeros(len(t_us), EVENT)
    events["t"], events["p"] = t_us, 1
    if t_us[-1] < 2**32:
        write_events(tmp_path / "events.dat", events, 1280, 720, "dat")
        np.testing.assert_array_equal(read_events(tmp_path / "events.dat").events, events)


@pytest.mark.parametrize(("format", "until_us"), [("dat", 2**32), ("evt2", 2**34), ("evt3", 2**24)])
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 300), dense=st.booleans())
@settings(max_examples=25, deadline=None)
def test_what_is_written_is_read(tmp_path_factory, format, until_us, seed, count, dense):
    path = tmp_path_factory.mktemp("a") / "events.out"
    events = some_events(seed, count, 1280, 720, 200 if dense else until_us)
    write_events(path, events, 1280, 720, format)
    back = read_events(path)
    assert back.events.tobytes() == events.tobytes()
    assert (back.format, back.width, back.height, back.late, back.skipped) == (format, 1280, 720, 0, 0)


def test_evt3_counts_the_turns_of_its_clock_through_a_gap_of_minutes(tmp_path):
    events = some_events(0, 4, 640, 480, 100)
    events["t"] = [0, 2**24 - 1, 2**24, 200_000_000]
    write_events(tmp_path / "a.raw", events, 640, 480)
    assert read_events(tmp_path / "a.raw").events["t"].tolist() == events["t"].tolist()


@pytest.mark.parametrize(
    ("format", "t_us", "rule"),
    [
        ("dat", 2**32, "clock of 32 bits"),
        ("evt2", 2**34, "clock of 34 bits"),
        ("evt3", 2**24, "clock of 24 bits"),
    ],
)
def test_a_time_that_the_clock_cannot_hold_is_refused_and_nothing_written(format, t_us, rule, tmp_path):
    events = np.array([(t_us, 0, 0, 1)], EVENT)
    with pytest.raises(ValueError, match=rule):
        write_events(tmp_path / "a", events, 8, 8, format)
    events["t"] -= 1
    write_events(tmp_path / "a", events, 8, 8, format)
    assert read_events(tmp_path / "a").events["t"].tolist() == [t_us - 1]


def test_a_gap_of_years_or_a_sensor_too_wide_is_refused_and_nothing_written(tmp_path):
    events = np.array([(0, 0, 0, 1), (2**45, 0, 0, 1)], EVENT)
    with pytest.raises(ValueError, match="choose npz or hdf5"):
        write_events(tmp_path / "a", events, 8, 8, "evt3")
    with pytest.raises(ValueError, match="at most 2048 pixels"):
        write_events(tmp_path / "a", events[:1], 2049, 8, "evt2")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("header", "size"),
    [
        ("format EVT3;height=48;width=64", (64, 48)),
        ("evt 3.0\n% geometry 64x48", (64, 48)),
        ("evt 3.0\n% plugin_name hal_plugin_gen31_fx3", (640, 480)),
        ("evt 3.0\n% plugin_name hal_plugin_imx636_evk4", (1280, 720)),
        ("evt 3.0", (None, None)),
    ],
)
def test_the_size_of_the_sensor_is_what_the_header_says(header, size, tmp_path):
    path = raw(tmp_path / "a.raw", np.array([0x8000, 0x0001, 0x2001], "<u2"), header)
    file = read_events(path)
    assert (file.width, file.height) == size
    assert tuples(file.events) == [(0, 1, 1, -1)]


@pytest.mark.parametrize(
    ("content", "format", "rule"),
    [
        (b"% evt 4.0\n", None, "encoded as '4.0'"),
        (b"% evt 3.0\n", "evt2", "says evt3 and the caller says evt2"),
        (b"% format EVT21;endianness=big\n", None, "big-endian"),
        (b"% Date today\n", None, "names no encoding"),
        (b"% evt 3.0", None, "header without end"),
        (b"% Data file containing CD events\n% Version 1\n", None, "version 1"),
        (b"% Data file containing CD events\n% Version 2\n\x0e\x08", None, "type 14 and 8 bytes"),
        (b"% Data file containing CD events\n% Version 2\n", None, "type 0 and 0 bytes"),
        (words3(*[0x1000] * 17), None, "has 17 of 17 words of types that this encoding does not have"),
    ],
)
def test_a_file_that_breaks_a_rule_is_refused_by_name(content, format, rule, tmp_path):
    (tmp_path / "a.raw").write_bytes(content)
    with pytest.raises(ValueError, match=rule) as caught:
        read_events(tmp_path / "a.raw", format)
    assert "a.raw" in str(caught.value)


def test_words_and_pixels_that_do_not_exist_are_left_out_and_counted(tmp_path):
    good = [0x8000, 1, *[0x2000 | x for x in range(20)]]
    for content, damage in (
        (b"% evt 3.0\n\x00", {CUT: 1}),
        (words3(*good, 0x3000 | 2037, 0x4800), {OUTSIDE: 1}),
        (words3(*good, 0x3000 | 2027, 0x4000, 0x5000, 0x5001), {}),
        (words3(*good, 0x3000 | 2036, 0x4000, 0x5001), {OUTSIDE: 1}),
        (words3(*good, 0x1000, 0xB000), {RESERVED: 2}),
        (EVT21_GOOD + EVT21_BEYOND, {OUTSIDE: 1}),
        (b"% evt 2.0\n\x00\x00\x00\x20", {RESERVED: 1}),
        (b"% Data file containing CD events\n% Version 2\n\x0c\x08abc", {CUT: 3}),
    ):
        (tmp_path / "a.raw").write_bytes(content)
        file = read_events(tmp_path / "a.raw")
        assert file.damage == damage, content
        assert len(file.events) in (0, 20, 21)
        if damage:
            with pytest.raises(ValueError, match=r"a\.raw: is damaged .*read it without strict"):
                read_events(tmp_path / "a.raw", strict=True)


def test_a_pixel_outside_the_sensor_is_left_out_and_a_wrong_size_is_refused(tmp_path):
    words = np.array([0x8000, 0x0001, *[0x2000 | x for x in (1, 2, 64)]], "<u2")
    path = raw(tmp_path / "a.raw", words, "format EVT3;height=48;width=64")
    file = read_events(path)
    assert (file.events["x"].tolist(), file.damage) == ([1, 2], {OUTSIDE: 1})
    with pytest.raises(ValueError, match="says width=64 and the caller says 65"):
        read_events(path, width=65)
    path = raw(tmp_path / "b.raw", words, "evt 3.0")
    with pytest.raises(
        ValueError, match=r"x=64, y=1, 2 of 3 outside the sensor of 2x9; give the right width"
    ):
        read_events(path, width=2, height=9)
    assert len(read_events(path, width=65, height=9).events) == 3


def test_times_a_little_out_of_order_are_sorted(tmp_path):
    def words(*highs: int) -> np.ndarray:
        return np.array(
            [word for high in highs for word in (0x8000 | high, 0x0001, 0x2000 | high & 7)], "<u2"
        )

    file = read_events(raw(tmp_path / "a.raw", words(1, 3, 2, 3), "evt 3.0"))
    assert tuples(file.events) == [(4096, 1, 1, -1), (8192, 2, 1, -1), (12288, 3, 1, -1), (12288, 3, 1, -1)]
    assert (file.late, file.damage) == (1, {})


METAVISION_DAT = b"% Height 720\n% Version 2\n% Width 1280\n% date 2026-11-22 10:11:12\n% end\n"


@pytest.mark.parametrize(
    "head",
    [
        METAVISION_DAT,
        METAVISION_DAT.replace(b"% end\n", b""),
        b"% date 2026-11-22 10:11:12\n% geometry 1280x720\n" + METAVISION_DAT,
        b"% Data file containing Event2D events.\n% Version 2\n% Height 720\n% Width 1280\n",
    ],
)
@pytest.mark.parametrize(("name", "format"), [("a.dat", None), ("a", None), ("a", "dat")])
def test_the_headers_of_metavisions_dat_files_are_read(head, name, format, tmp_path):
    words = np.array([(5, 1279 | 719 << 14 | 1 << 28)], [("t", "<u4"), ("data", "<u4")])
    (tmp_path / name).write_bytes(head + bytes((12, 8)) + words.tobytes())
    file = read_events(tmp_path / name, format)
    assert (file.format, file.width, file.height) == ("dat", 1280, 720)
    assert file.events.tolist() == [(5, 1279, 719, 1)]


@pytest.mark.parametrize("format", ["evt2", "evt3"])
@given(seed=st.integers(0, 2**32 - 1), flips=st.integers(1, 3), first=st.booleans())
@example(seed=1004, flips=1, first=True)
@settings(max_examples=40)
def test_a_flipped_time_is_counted_and_moves_no_event_by_a_turn(tmp_path_factory, format, seed, flips, first):
    """Whatever bits of high parts flip: the file is refused, or all is near where it was."""
    rng, path = np.random.default_rng(seed), tmp_path_factory.mktemp("a") / "events.out"
    events = some_events(seed, 4000, 640, 480, 3_000_000)
    events["t"] += rng.integers(0, 10_000_000)
    write_events(path, events, 640, 480, format)
    step_us, width, word = (64, 28, "<u4") if format == "evt2" else (4096, 12, "<u2")
    head = path.read_bytes().partition(b"% end\n")[0] + b"% end\n"
    words = np.frombuffer(path.read_bytes()[len(head) :], word).copy()
    highs = np.flatnonzero(words >> width == 8)
    # Damage of far bits, in places apart from each other; a flip by less is disorder.
    far = np.arange(int(np.log2(1e6 / step_us)) + 1, width)
    places = highs[rng.choice(np.arange(0 if first else 1, len(highs) - 1), flips, replace=False)]
    words[places] ^= (1 << rng.choice(far, flips)).astype(word)
    path.write_bytes(head + words.tobytes())
    file = read_events(path)
    later_flip = not first or highs[0] not in places
    assert file.strays == flips or not later_flip
    if later_flip:  # else events in front of the first time that can be believed are skipped
        moved_us = np.sort(file.events["t"]) - events["t"]
        assert np.abs(moved_us).max() <= 5000 * flips + 50_000 * (format == "evt2")
    assert len(file.events) == len(events) - file.skipped


def test_a_stray_time_of_a_recording_moves_nothing_after_it(tmp_path):
    def words(*highs: int) -> np.ndarray:
        triples = [(0x8000 | high, 1, 0x2000 | n) for n, high in enumerate(highs)]
        return np.array(triples, "<u2").ravel()

    for wrong in (4000, 3000, 2056, 700):
        file = read_events(raw(tmp_path / "a.raw", words(6, 7, wrong, 8, 9), "evt 3.0"))
        assert file.events["t"].tolist() == [4096 * high for high in (6, 7, 7, 8, 9)]
        assert (file.strays, file.late, file.skipped) == (1, 0, 0)
    file = read_events(raw(tmp_path / "a.raw", words(3000, 6, 7, 8), "evt 3.0"))  # the first of all
    assert file.events["t"].tolist() == [4096 * high for high in (6, 7, 8)]
    assert (file.strays, file.skipped) == (1, 1)
    gap = read_events(raw(tmp_path / "a.raw", words(6, 7, 1000, 1001, 1002), "evt 3.0"))
    assert gap.events["t"].tolist() == [4096 * high for high in (6, 7, 1000, 1001, 1002)]
    turn = read_events(raw(tmp_path / "a.raw", words(4094, 4095, 0, 1), "evt 3.0"))
    assert turn.events["t"].tolist() == [4096 * high for high in (4094, 4095, 4096, 4097)]
    assert gap.strays == turn.strays == 0


def test_a_file_may_hold_two_events_for_each_byte_unless_the_caller_allows_more(tmp_path):
    assert usual_events(5) == usual_events(5_000_000) == 10_000_000
    assert usual_events(9_400_000) == 18_800_000
    assert usual_events(1 << 33) == 100_000_000
    words = np.full(4_000_000, 0x4FFF, "<u2")  # 24 MB that would be 24 million events
    words[:3], words[3::100] = [0x8000, 1, 0x3000], 0x3000
    path = raw(tmp_path / "a.raw", words, "evt 3.0")
    with pytest.raises(ValueError, match="at most max_events=16000032 are read; raise max_events"):
        read_events(path)
    path.unlink()


def test_more_events_than_asked_for_are_refused_before_memory_is_taken(tmp_path):
    words = np.array([0x8000, 0x0001, 0x3000, *[0x4FFF] * 100], "<u2")
    path = raw(tmp_path / "a.raw", words, "evt 3.0")
    assert len(read_events(path, max_events=1200).events) == 1200
    with pytest.raises(ValueError, match="contains 1200 events or more and at most max_events=1199"):
        read_events(path, max_events=1199)
