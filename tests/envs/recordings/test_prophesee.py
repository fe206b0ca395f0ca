import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.events import EVENT
from envs.recordings import read_events, write_events
from envs.recordings.event_file import Request, finish, unwrap
from envs.recordings.evt_decoders import decode_dat, decode_evt3

DATA = Path(os.environ.get("EVADE_DATA", Path(__file__).resolve().parents[4] / "shared" / "data"))
EVT3_SAMPLE = DATA / "expelliarmus_evt" / "evt3_sample.raw"
needs_sample = pytest.mark.skipif(not EVT3_SAMPLE.is_file(), reason=f"no {EVT3_SAMPLE}; set EVADE_DATA")

OFF, ON, TIME_HIGH, TRIGGER, VENDOR = 0, 1, 8, 10, 14
RESERVED = (1, 9, 11, 12, 13)  # types of words that EVT 3.0 does not have


def slow_evt3(words: list[int]) -> list[tuple[int, int, int, int]]:  # noqa: C901
    """The published table, one word at a time, written without a look at the kernel."""
    events, row, base, time, turns, high, low = [], None, None, None, 0, None, 0
    for word in words:
        kind, value = divmod(word, 4096)
        if kind == 0x0:
            row = value % 2048
        elif kind in (0x2, 0x3):
            base = [value % 2048, 1 if value >= 2048 else -1]
        elif kind == 0x6:
            low = value
        elif kind == 0x8:
            if high is not None and high - value > 2048:
                turns += 1
            if value != high:
                low = 0
            high = value
        if high is not None:
            time = turns * 2**24 + high * 4096 + low
        length = {0x2: 1, 0x4: 12, 0x5: 8}.get(kind, 0)
        for bit in range(length):
            if (kind == 0x2 or (value >> bit) % 2) and None not in (time, row, base):
                events.append((time, base[0] + bit, row, base[1]))
        if kind in (0x4, 0x5) and base is not None:
            base[0] += length
    return events


def slow_evt2(words: list[int], width: int = 1) -> list[tuple[int, int, int, int]]:
    """EVT 2.0 (width 1), or EVT 2.1 as (upper half, mask) pairs (width 32)."""
    events, high, turns = [], None, 0
    for word in words:
        upper, mask = (word, 1) if width == 1 else word
        kind = upper // 2**28
        if kind == TIME_HIGH:
            value = upper % 2**28
            if high is not None and high - value > 2**27:
                turns += 1
            high = value
        elif kind in (OFF, ON) and high is not None:
            time = turns * 2**34 + high * 64 + upper // 2**22 % 64
            for bit in range(width):
                if mask >> bit & 1:
                    events.append((time, upper // 2**11 % 2**11 + bit, upper % 2**11, 2 * kind - 1))
    return events


def raw(path: Path, words: np.ndarray, header: str) -> Path:
    path.write_bytes(f"% {header}\n% end\n".encode() + words.tobytes())
    return path


def tuples(events: np.ndarray) -> list[tuple[int, int, int, int]]:
    return events.tolist()


def some_events(seed: int, count: int, width: int, height: int, until_us: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    events = np.empty(count, EVENT)
    events["t"] = np.sort(rng.integers(0, until_us, count))
    events["x"], events["y"] = rng.integers(0, width, count), rng.integers(0, height, count)
    events["p"] = rng.choice([-1, 1], count)
    return events


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


@pytest.mark.parametrize("seed", range(8))
def test_evt3_words_in_any_order_decode_as_by_the_published_table(seed, tmp_path):
    rng = np.random.default_rng(seed)
    kinds = rng.choice([0, 2, 2, 3, 4, 4, 5, 6, 7, 10, 14, 15], 3000)
    words = (kinds << 12 | rng.integers(0, 4096, 3000)).astype("<u2")
    words[words >> 12 == 0] &= 0x07FF
    clock = np.flatnonzero(rng.random(3000) < 0.05)  # a clock that goes round and round
    words[clock] = 0x8000 | np.arange(len(clock)) * (40 + 20 * seed) & 0xFFF
    words[words >> 12 == 6] &= 0xF07F  # no way back of more than a second in a test of 4 ms steps
    expected = sorted(slow_evt3(words.tolist()), key=lambda event: event[0])
    found = read_events(raw(tmp_path / "a.raw", words, "format EVT3;height=2048;width=4096"))
    assert tuples(found.events) == expected
    assert len(expected) > 3000


@given(seed=st.integers(0, 2**32 - 1), length=st.integers(0, 100), bad_words=st.integers(0, 1))
def test_any_evt3_words_give_the_events_the_skipped_ones_and_the_bad_word_of_the_table(
    seed, length, bad_words
):
    rng = np.random.default_rng(seed)
    kinds = rng.choice([0, 2, 3, 4, 5, 6, 7, 8, 8, 10, 14, *RESERVED[: 2 * bad_words]], length)
    array = (kinds << 12 | rng.integers(0, 4096, length) & rng.choice([1, 4095], length)).astype("<u2")
    words = array.tolist()
    count, skipped, bad = decode_evt3(array, np.empty(0, EVENT))
    assert bad == next((i for i, word in enumerate(words) if word >> 12 in RESERVED), -1)
    if bad < 0:
        events, expected = np.empty(count, EVENT), slow_evt3(words)
        decode_evt3(array, events)
        assert tuples(events) == expected
        masks = {0x2: lambda _: 1, 0x4: lambda value: value, 0x5: lambda value: value % 256}
        entries = [masks[word >> 12](word % 4096) for word in words if word >> 12 in masks]
        assert count + skipped == sum(mask.bit_count() for mask in entries)


@given(seed=st.integers(0, 2**32 - 1))
def test_dat_entries_give_the_columns_of_the_published_table(seed):
    rng = np.random.default_rng(seed)
    entries = np.empty(100, [("t", "<u4"), ("data", "<u4")])
    steps = rng.integers(-(2**31), 2**31, 100) if seed % 2 else rng.integers(-1000, 2**31, 100)
    entries["t"] = np.cumsum(steps) % 2**32
    entries["data"] = rng.integers(0, 2**32, 100)
    events = np.empty(100, EVENT)
    decode_dat(entries, events)
    data = entries["data"].tolist()
    assert tuples(events) == [
        (t, d % 2**14, d // 2**14 % 2**14, 1 if d // 2**28 % 2 else -1)
        for t, d in zip(unwrap(entries["t"], 32).tolist(), data, strict=True)
    ]


@pytest.mark.parametrize("endianness", ["little", "legacy"])
def test_evt21_vectors_decode_as_by_the_published_table_in_both_orders_of_halves(endianness, tmp_path):
    rng = np.random.default_rng(1)
    uppers = (rng.choice([OFF, ON, TRIGGER, VENDOR], 500) << 28 | rng.integers(0, 2**28, 500)).astype("<u4")
    masks = rng.integers(0, 2**32, 500, dtype="<u4")
    clock = np.arange(5, 500, 20)  # the first words have no time
    uppers[clock] = TIME_HIGH << 28 | np.arange(2**28 - 10, 2**28 - 10 + len(clock)) & 2**28 - 1
    halves = (uppers, masks) if endianness == "legacy" else (masks, uppers)
    path = raw(tmp_path / "a.raw", np.stack(halves, axis=1), f"format EVT21;endianness={endianness}")
    found = read_events(path)
    expected = slow_evt2(list(zip(uppers.tolist(), masks.tolist(), strict=True)), 32)
    assert tuples(found.events) == sorted(expected, key=lambda event: event[0])
    assert expected[-1][0] > 2**34 > expected[0][0]
    first = (uppers[:5] >> 28 <= 1) * np.array([bin(mask).count("1") for mask in masks[:5].tolist()])
    assert found.skipped == first.sum() > 0


def test_evt2_words_decode_as_by_the_published_table(tmp_path):
    rng = np.random.default_rng(2)
    words = (rng.choice([OFF, ON, TRIGGER, VENDOR, 15], 500) << 28 | rng.integers(0, 2**28, 500)).astype(
        "<u4"
    )
    clock = np.arange(3, 500, 20)
    words[clock] = TIME_HIGH << 28 | np.arange(2**28 - 10, 2**28 - 10 + len(clock)) & 2**28 - 1
    found = read_events(raw(tmp_path / "a.raw", words, "evt 2.0"))
    assert tuples(found.events) == sorted(slow_evt2(words.tolist()), key=lambda event: event[0])
    assert found.events["t"][-1] > 2**34


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


@needs_sample
@pytest.mark.parametrize("format", ["dat", "evt2", "evt3"])
def test_the_street_recording_survives_each_format(format, tmp_path):
    events = read_events(EVT3_SAMPLE).events
    write_events(tmp_path / "a", events, 1280, 720, format)
    assert read_events(tmp_path / "a").events.tobytes() == events.tobytes()


def test_evt3_counts_the_turns_of_its_clock_through_a_gap_of_minutes(tmp_path):
    events = some_events(0, 4, 640, 480, 100)
    events["t"] = [0, 2**24 - 1, 2**24, 200_000_000]
    write_events(tmp_path / "a.raw", events, 640, 480)
    assert read_events(tmp_path / "a.raw").events["t"].tolist() == events["t"].tolist()


def test_the_clock_of_a_dat_file_is_unwrapped(tmp_path):
    entries = np.zeros(3, [("t", "<u4"), ("data", "<u4")])
    entries["t"] = [2**32 - 2, 2**32 - 1, 5]
    head = b"% Data file containing CD events.\n% Version 2\n% Width 10\n% Height 10\n"
    (tmp_path / "a.dat").write_bytes(head + bytes([12, 8]) + entries.tobytes())
    assert read_events(tmp_path / "a.dat").events["t"].tolist() == [2**32 - 2, 2**32 - 1, 2**32 + 5]


def test_the_low_part_of_the_time_is_written_again_after_a_new_high_part(tmp_path):
    events = some_events(0, 3, 640, 480, 100)
    events["t"] = [4096 + 7, 2 * 4096 + 7, 5 * 4096 + 7]
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
        (b"% evt 3.0\n\x00", None, "is truncated"),
        (b"% evt 3.0\n\x00\x10", None, "word 0 is of no type"),
        (b"% evt 2.0\n\x00\x00\x00\x20", None, "word 0 is of no type"),
        (b"% evt 4.0\n", None, "encoded as '4.0'"),
        (b"% evt 3.0\n", "evt2", "says evt3 and the caller says evt2"),
        (b"% format EVT21;endianness=big\n", None, "big-endian"),
        (b"% Date today\n", None, "names no encoding"),
        (b"% evt 3.0", None, "header without end"),
        (b"% Data file containing CD events\n% Version 1\n", None, "version 1"),
        (b"% Data file containing CD events\n% Version 2\n\x0e\x08", None, "type 14 and 8 bytes"),
        (b"% Data file containing CD events\n% Version 2\n", None, "type 0 and 0 bytes"),
        (b"% Data file containing CD events\n% Version 2\n\x0c\x08abc", None, "is truncated"),
    ],
)
def test_a_file_that_breaks_a_rule_is_refused_by_name(content, format, rule, tmp_path):
    (tmp_path / "a.raw").write_bytes(content)
    with pytest.raises(ValueError, match=rule) as caught:
        read_events(tmp_path / "a.raw", format)
    assert "a.raw" in str(caught.value)


def test_a_pixel_outside_the_sensor_and_a_wrong_size_are_refused(tmp_path):
    words = np.array([0x8000, 0x0001, 0x2000 | 64], "<u2")
    path = raw(tmp_path / "a.raw", words, "format EVT3;height=48;width=64")
    with pytest.raises(ValueError, match="event 0 has x=64 outside the sensor of 64x48"):
        read_events(path)
    with pytest.raises(ValueError, match="says width=64 and the caller says 65"):
        read_events(path, width=65)


def test_times_a_little_out_of_order_are_sorted_and_a_reset_clock_is_refused(tmp_path):
    def words(*highs: int) -> np.ndarray:
        return np.array(
            [word for high in highs for word in (0x8000 | high, 0x0001, 0x2000 | high & 7)], "<u2"
        )

    file = read_events(raw(tmp_path / "a.raw", words(1, 3, 2, 3), "evt 3.0"))
    assert tuples(file.events) == [(4096, 1, 1, -1), (8192, 2, 1, -1), (12288, 3, 1, -1), (12288, 3, 1, -1)]
    assert file.late == 1
    with pytest.raises(ValueError, match="reset clock or damage"):
        read_events(raw(tmp_path / "b.raw", words(1, 300, 2), "evt 3.0"))


@given(steps_us=st.lists(st.integers(-400, 500), min_size=1, max_size=50))
def test_late_events_are_counted_and_sorted_in_with_ties_in_the_order_of_the_file(steps_us):
    t_us = 30_000 + np.cumsum(steps_us)
    events = some_events(0, len(t_us), 640, 480, 1)
    events["t"] = t_us
    file = finish(Request(Path("a"), 640, 480), "evt3", events)
    assert file.late == sum(t < max(t_us[: i + 1]) for i, t in enumerate(t_us))
    assert tuples(file.events) == sorted(tuples(events), key=lambda event: event[0])


def test_more_events_than_asked_for_are_refused_before_memory_is_taken(tmp_path):
    words = np.array([0x8000, 0x0001, 0x3000, *[0x4FFF] * 100], "<u2")
    path = raw(tmp_path / "a.raw", words, "evt 3.0")
    assert len(read_events(path, max_events=1200).events) == 1200
    with pytest.raises(ValueError, match="holds 1200 events and at most max_events=1199"):
        read_events(path, max_events=1199)


def test_a_request_names_its_file():
    assert "x.raw: is wrong" in str(Request(Path("x.raw")).refusal("is wrong"))
