import base64
import os
import resource
import struct
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pyarrow
import pytest

from envs.recordings import read_events, write_events
from envs.recordings.event_file import CUT_PACKETS
from tests.support.event_files import LZ4_FILE, ZSTD_FILE, aedat2, aedat3, some_events

DATA = Path(os.environ.get("EVADE_DATA", Path(__file__).resolve().parents[4] / "shared" / "data"))
CHECKERBOARDS = DATA / "dvs128_checkerboard"
needs_samples = pytest.mark.skipif(not CHECKERBOARDS.is_dir(), reason=f"no {CHECKERBOARDS}; set EVADE_DATA")


def xml(streams: int = 1, width: int = 8) -> bytes:
    nodes = "".join(
        f'<node name="{number}"><attr key="typeIdentifier">EVTS</attr><node name="info">'
        f'<attr key="sizeX">{width}</attr><attr key="sizeY">6</attr></node></node>'
        for number in range(streams)
    )
    return f'<dv version="2.0"><node name="outInfo">{nodes}</node></dv>'.encode()


def aedat4(path: Path, packets: list[tuple[int, bytes]], codec: int = 0, text: bytes | None = None) -> Path:
    """A file by the published schema, its flatbuffers laid out by hand."""
    text = xml() if text is None else text
    table = struct.pack("<HHHHH2x", 10, 16, 4, 0, 8)  # vtable: its size, the table's, three fields
    header = struct.pack("<I", 16) + table + struct.pack("<iiiI", 12, codec, 4, len(text)) + text
    body = b"".join(struct.pack("<ii", stream, len(packet)) + packet for stream, packet in packets)
    path.write_bytes(b"#!AER-DAT4.0\r\n" + struct.pack("<I", len(header)) + header + body)
    return path


def packet(events: list[tuple[int, int, int, int]], count: int | None = None) -> bytes:
    """One size-prefixed flatbuffer of events, not compressed."""
    table = struct.pack("<I4sHHH2x", 16, b"EVTS", 6, 8, 4)
    start = struct.pack("<iII", 8, 4, len(events) if count is None else count)
    body = table + start + b"".join(struct.pack("<qhhB3x", *event) for event in events)
    return struct.pack("<I", len(body)) + body


@needs_samples
def test_a_checkerboard_decodes_as_by_the_description():
    path = CHECKERBOARDS / "checkerboard_3.aedat"
    file = read_events(path)
    assert (file.format, file.width, file.height, file.late) == ("aedat2", 128, 128, 0)
    assert len(file.events) == 49_724
    assert file.events["t"][-1] - file.events["t"][0] == 111_580
    with path.open("rb") as raw:
        while (line := raw.readline()).startswith(b"#"):
            pass
        body = line + raw.read()
    expected = [
        (t_us, 127 - (address >> 1 & 127), 127 - (address >> 8 & 127), 1 - 2 * (address & 1))
        for address, t_us in struct.iter_unpack(">II", body)
    ]
    assert file.events.tolist() == expected


def test_a_davis_is_read_with_the_addresses_that_simulators_write_for_it(tmp_path):
    """The mapping of v2e's AEDAT 2.0 output: mirrored columns, rows from below."""
    pixels = [(0, 0, 1), (345, 259, -1), (17, 200, 1)]
    entries = [(345 - x << 12 | 259 - y << 22 | (p > 0) << 11, 100 + x) for x, y, p in pixels]
    frames = [(1 << 31 | 5, 100), (1 << 10, 200)]  # a sample of a frame, an external event
    path = aedat2(tmp_path / "a.aedat", [*frames, *entries], "eu.seebetter.ini.chips.davis.Davis346blue")
    file = read_events(path)
    assert (file.width, file.height, file.skipped) == (346, 260, 2)
    assert sorted(file.events.tolist()) == sorted((100 + x, x, y, p) for x, y, p in pixels)
    unnamed = aedat2(tmp_path / "b.aedat", entries)
    assert read_events(unnamed, width=346, height=260).events.tobytes() == file.events.tobytes()
    outside = aedat2(tmp_path / "c.aedat", [(300 << 12, 1)], "x.DAVIS240C")
    with pytest.raises(ValueError, match="1 of 1 outside the sensor of 240x180"):
        read_events(outside)


def test_special_events_of_a_dvs128_are_passed_over_and_its_clock_unwrapped(tmp_path):
    path = aedat2(tmp_path / "a.aedat", [(0, 2**32 - 1), (0x8000, 0), (1, 3)])
    file = read_events(path)
    assert file.events.tolist() == [(2**32 - 1, 127, 127, 1), (2**32 + 3, 127, 127, -1)]
    assert file.skipped == 1


def test_jaers_end_of_header_lets_the_first_address_begin_like_a_comment(tmp_path):
    head = b"#!AER-DAT2.0\r\n# AEChip: x.DAVIS640\r\n#End Of ASCII Header\r\n"
    (tmp_path / "a.aedat").write_bytes(head + struct.pack(">II", 0x23000000, 7))
    assert read_events(tmp_path / "a.aedat").events["t"].tolist() == [7]


def test_aedat3_has_events_triggers_and_a_clock_that_turns(tmp_path):
    def polarity(t, x, y, on):
        return struct.pack("<Ii", x << 17 | y << 2 | on << 1 | 1, t)

    invalid = struct.pack("<Ii", 5 << 17, 11)
    triggers = struct.pack("<Ii", 2 << 1 | 1, 22) + struct.pack("<Ii", 3 << 1 | 1, 24)
    packets = [
        (1, 0, 8, polarity(10, 1, 4, 1) + invalid + polarity(20, 2, 5, 0)),
        (0, 0, 8, triggers),
        (1, 1, 8, polarity(35, 3, 6, 1)),
    ]
    path = aedat3(tmp_path / "a.aedat", packets)
    file = read_events(path)
    assert (file.format, file.width, file.height, file.skipped) == ("aedat3", 128, 128, 2)
    assert file.events.tolist() == [(10, 1, 4, 1), (20, 2, 5, -1), (2**31 + 35, 3, 6, 1)]
    assert file.triggers.tolist() == [(22, 0, 1), (24, 0, -1)]
    path.write_bytes(path.read_bytes()[:-3])
    assert read_events(path, stream=1).events.tolist() == [(10, 1, 4, 1), (20, 2, 5, -1)]


@pytest.mark.parametrize("text", [LZ4_FILE, ZSTD_FILE], ids=["lz4", "zstd"])
def test_a_file_by_the_makers_library_is_read(text, tmp_path):
    (tmp_path / "a.aedat4").write_bytes(zlib.decompress(base64.b85decode(text)))
    file = read_events(tmp_path / "a.aedat4")
    assert (file.format, file.width, file.height) == ("aedat4", 346, 260)
    assert file.events.tolist() == [
        (1_700_000_000_000_000 + 100 * i * i, 37 * i % 346, 29 * i % 260, 1 if i % 3 == 0 else -1)
        for i in range(12)
    ]


def test_packets_of_other_streams_are_passed_over_whatever_they_hold(tmp_path):
    events = [(5, 1, 2, 1), (7, 3, 4, 0)]
    path = aedat4(tmp_path / "a.aedat4", [(0, packet(events[:1])), (9, b"junk"), (0, packet(events[1:]))])
    assert read_events(path).events.tolist() == [(5, 1, 2, 1), (7, 3, 4, -1)]
    assert read_events(aedat4(tmp_path / "b.aedat4", [])).events.tolist() == []


@pytest.mark.parametrize(
    ("packets", "codec", "text", "rule"),
    [
        ([(0, packet([(5, 1, 2, 1)], count=2))], 0, None, "declares 2 entries and has no room"),
        ([(0, packet([(5, 1, 2, 1)])[:20])], 0, None, "damaged"),
        ([(0, packet([(5, 8, 2, 1)]))], 0, None, "1 of 1 outside the sensor of 8x6"),
        ([(0, packet([(-5, 1, 2, 1)]))], 0, None, "t must lie in"),
        ([(0, b"no lz4 frame")], 1, None, "damaged"),
        ([(0, bytes(64))], 0, None, "where a packet of EVTS should be is one of"),
        ([(0, packet([]).replace(b"EVTS", b"FRME"))], 0, None, "should be is one of b'FRME'"),
        ([], 0, xml(0), "has no stream  of kind EVTS; its streams are none"),
        ([], 0, b"<!DOCTYPE x [<!ENTITY a 'b'>]><dv>&a;</dv>", "XML entities"),
        ([], 0, xml().replace(b">8<", b">wide<"), "damaged"),
    ],
)
def test_an_aedat4_file_that_breaks_a_rule_is_refused(packets, codec, text, rule, tmp_path):
    with pytest.raises(ValueError, match=rule) as caught:
        read_events(aedat4(tmp_path / "a.aedat4", packets, codec, text))
    assert "a.aedat4" in str(caught.value)


def test_a_packet_longer_than_the_file_is_counted_and_a_header_refused(tmp_path):
    path = aedat4(tmp_path / "a.aedat4", [(0, packet([(5, 1, 2, 1)]))])
    raw = path.read_bytes()
    path.write_bytes(raw[:-1])  # cut off: nothing is left but a word about it
    assert (len(read_events(path).events), read_events(path).damage) == (0, {CUT_PACKETS: 1})
    path.write_bytes(raw[:14] + struct.pack("<I", 1 << 31) + raw[18:])
    with pytest.raises(ValueError, match="its header declares 2147483648 bytes"):
        read_events(path)


def test_a_packet_that_unpacks_to_gigabytes_takes_no_memory(tmp_path):
    def packed(size: int) -> bytes:
        sink = pyarrow.BufferOutputStream()
        with pyarrow.CompressedOutputStream(sink, "zstd") as out:
            out.write(struct.pack("<I", size) + b"\0\0\0\0EVTS")
            for _ in range(256):
                out.write(bytes(1 << 20))
        return sink.getvalue().to_pybytes()

    small = aedat4(tmp_path / "a.aedat4", [(0, packed(100))], 3)
    large = aedat4(tmp_path / "b.aedat4", [(0, packed(1 << 30))], 3)
    before_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert read_events(small).events.tolist() == []  # a table without fields
    with pytest.raises(ValueError, match="at most 268435456 are unpacked"):
        read_events(large)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kib < 64 << 10


def test_packets_that_hold_one_event_and_megabytes_of_nothing_are_let_go(tmp_path):
    size, number = 16 << 20, 5
    one = packet([(5, 1, 2, 1)])
    sink = pyarrow.BufferOutputStream()
    with pyarrow.CompressedOutputStream(sink, "zstd") as out:
        out.write(struct.pack("<I", size) + one[4:] + bytes(size - len(one) + 4))
    path = aedat4(tmp_path / "a.aedat4", [(0, sink.getvalue().to_pybytes())] * number, 3)
    assert path.stat().st_size < 1 << 20
    tracemalloc.start()
    try:
        assert read_events(path).events.tolist() == [(5, 1, 2, 1)] * number
        assert tracemalloc.get_traced_memory()[1] < 3 * size
    finally:
        tracemalloc.stop()


def test_a_table_of_packets_that_is_not_where_the_header_says_is_refused(tmp_path):
    whole = zlib.decompress(base64.b85decode(LZ4_FILE))
    table = whole.rindex(b"\x04\x22\x4d\x18")  # the last LZ4 frame
    place = whole.index(struct.pack("<q", table))
    first = 18 + int.from_bytes(whole[14:18], "little")
    for wrong in (first, first + 8, table + 4, 0, -2):
        bad = whole[:place] + struct.pack("<q", wrong) + whole[place + 8 :]
        (tmp_path / "a.aedat4").write_bytes(bad)
        with pytest.raises(ValueError, match=r"a\.aedat4: is damaged"):
            read_events(tmp_path / "a.aedat4")


@pytest.mark.parametrize("count", [0, 1 << 14, 40_000])
def test_another_reader_gives_the_events_that_were_written(count, tmp_path):
    aedat = pytest.importorskip("aedat", reason="the package aedat reads AEDAT 4.0 independently")
    path, events = tmp_path / "a.aedat4", some_events(count, count, 346, 260, 10 * count + 1)
    events["t"] += 1_700_000_000_000_000
    write_events(path, events, 346, 260)
    parts = [part["events"] for part in aedat.Decoder(path) if "events" in part]
    assert sum(map(len, parts)) == count
    for name in "txyp" if count else "":
        theirs = np.concatenate([part["on" if name == "p" else name] for part in parts])
        assert np.array_equal(theirs, events[name] > 0 if name == "p" else events[name])
    assert read_events(path).events.tobytes() == events.tobytes()


@pytest.mark.parametrize("count", [0, 40_000])
def test_the_makers_library_reads_what_is_written(count, tmp_path):
    dv = pytest.importorskip("dv_processing", reason="the package dv-processing is the maker's reader")
    events = some_events(count, count, 346, 260, 10 * count + 1)
    write_events(tmp_path / "a.aedat4", events, 346, 260)
    reader = dv.io.MonoCameraRecording(str(tmp_path / "a.aedat4"))
    assert tuple(reader.getEventResolution()) == (346, 260)
    parts = []
    while (part := reader.getNextEventBatch()) is not None:
        parts.append(part.numpy())
    for name, theirs in (("t", "timestamp"), ("x", "x"), ("y", "y"), ("p", "polarity")):
        found = np.concatenate([np.empty(0), *(part[theirs] for part in parts)])
        assert np.array_equal(found, events[name] > 0 if name == "p" else events[name])
