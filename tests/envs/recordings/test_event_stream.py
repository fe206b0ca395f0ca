"""Event Stream files, against the format's description and its authors' library."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.events import EVENT
from envs.recordings import read_events
from tests.support.event_files import es, some_events


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 200), until_us=st.sampled_from([5, 200, 10**6]))
@settings(max_examples=25)
def test_events_are_decoded_as_by_the_description(tmp_path_factory, seed, count, until_us):
    events = some_events(seed, count, 640, 480, until_us)
    file = read_events(es(tmp_path_factory.mktemp("a") / "a.es", events, 640, 480))
    assert file.events.tobytes() == events.tobytes()
    assert (file.format, file.width, file.height, file.skipped) == ("es", 640, 480, 0)


def test_resets_are_nothing_and_exposures_of_an_atis_are_passed_over(tmp_path):
    path = es(tmp_path / "a.es", some_events(0, 0, 640, 480, 5), 8, 6)
    path.write_bytes(path.read_bytes() + b"\xfe\xfe\xfe" + struct.pack("<BHH", 3 << 1 | 1, 7, 5))
    assert read_events(path).events.tolist() == [(3, 7, 0, 1)]
    assert read_events(es(tmp_path / "none.es", some_events(0, 0, 640, 480, 5), 0, 0)).events.size == 0
    head = b"Event Stream" + bytes((2, 0, 0, 2)) + struct.pack("<HH", 8, 6)
    rows = [(5 << 2 | 2, 1, 0), (1 << 2 | 3, 1, 1), (1 << 2 | 0, 2, 5)]
    path.write_bytes(head + b"\xfe" + b"".join(struct.pack("<BHH", *row) for row in rows))
    file = read_events(path)  # 0xfe counts two longest times
    assert file.events.tolist() == [(126 + 5, 1, 5, 1), (126 + 7, 2, 0, -1)]
    assert file.skipped == 1


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        (lambda raw: raw[:19], "no header"),
        (lambda raw: raw[:15] + b"\4" + raw[16:], "type 4"),
        (lambda raw: raw[:18] + b"\1\0" + raw[20:], "1 of 1 outside the sensor of 640x1"),
        (lambda raw: raw[:16] + b"\1\0" + raw[18:], "1 of 1 outside the sensor of 1x480"),
    ],
)
def test_a_file_that_breaks_a_rule_is_refused_by_name(change, rule, tmp_path):
    events = np.array([(5, 3, 3, 1)], EVENT)
    path = es(tmp_path / "a.es", events, 640, 480)
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(ValueError, match=rule) as caught:
        read_events(path)
    assert "a.es" in str(caught.value)


@pytest.mark.parametrize("kind", ["dvs", "atis"])
def test_the_authors_library_writes_what_is_read(kind, tmp_path):
    library = pytest.importorskip("event_stream", reason="the package event_stream is the authors' writer")
    events = some_events(1, 5000, 640, 480, 10**6)
    dtype = {"dvs": library.dvs_dtype, "atis": library.atis_dtype}[kind]
    theirs = np.zeros(len(events), dtype)
    theirs["t"], theirs["x"], theirs["y"] = events["t"], events["x"], 479 - events["y"]
    theirs["p"] = events["p"] > 0
    if kind == "atis":
        theirs["e"] = np.arange(len(events)) % 3 == 0
        events = events[~theirs["e"]]
    with library.Encoder(str(tmp_path / "a.es"), kind, 640, 480) as encoder:
        encoder.write(theirs)
    file = read_events(tmp_path / "a.es")
    assert file.events.tobytes() == events.tobytes()
    assert file.skipped == len(theirs) - len(events)
