"""HDF5 files in the layout of Prophesee's Metavision, whose filter is decoded here and never run."""

import struct

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from envs.events import EVENT
from envs.recordings import read_events, read_recording
from envs.recordings.ecf import decode_ecf
from tests.support.event_files import METAVISION_ROW, ecf_chunk, metavision, packed_events


def rows(events: np.ndarray) -> np.ndarray:
    values = np.zeros(len(events), METAVISION_ROW)
    for name in "txy":
        values[name] = events[name]
    values["p"] = events["p"] > 0
    return values


@pytest.mark.parametrize("way", [0, 1, 2])
def test_each_way_of_packing_by_the_makers_library_is_decoded(way, tmp_path):
    assert struct.unpack_from("<I", ecf_chunk(way))[0] == 150 << 2 | way
    file = read_events(metavision(tmp_path / "a.h5", [ecf_chunk(way)]))
    assert file.events.tobytes() == packed_events(way).tobytes()
    assert (file.format, file.width, file.height) == ("hdf5", 1280, 720)


def test_chunks_follow_each_other_and_one_may_be_stored_as_it_is(tmp_path):
    file = read_events(metavision(tmp_path / "a.h5", [ecf_chunk(1), ecf_chunk(1)], 300))
    assert sorted(file.events.tolist()) == sorted(2 * packed_events(1).tolist())
    plain = metavision(tmp_path / "b.h5", [rows(packed_events(2)).tobytes()], 150, unpacked=1)
    assert read_events(plain).events.tobytes() == packed_events(2).tobytes()
    with h5py.File(tmp_path / "c.h5", "w") as out:
        out.create_dataset("CD/events", data=rows(packed_events(2)), compression="gzip")
    assert read_events(tmp_path / "c.h5").events.tobytes() == packed_events(2).tobytes()
    assert read_events(metavision(tmp_path / "d.h5", [], 0)).events.size == 0
    unsized = read_events(metavision(tmp_path / "e.h5", [ecf_chunk(0)], geometry="wide"), width=1280)
    assert (unsized.width, unsized.height) == (1280, None)


@pytest.mark.parametrize("way", [0, 1, 2])
@given(seed=st.integers(0, 2**32 - 1))
def test_a_cut_chunk_is_refused_and_a_damaged_one_writes_only_where_it_may(way, seed):
    rng, whole = np.random.default_rng(seed), np.frombuffer(ecf_chunk(way), np.uint8)
    assert not decode_ecf(whole[: rng.integers(0, len(whole))], np.empty(150, EVENT))
    bad = whole.copy()
    bad[rng.integers(4, len(bad), 5)] = rng.integers(0, 256, 5)
    guarded = np.zeros(170, EVENT)
    decode_ecf(bad, guarded[10:160])
    assert not guarded[:10].tobytes().strip(b"\0")
    assert not guarded[160:].tobytes().strip(b"\0")


@pytest.mark.parametrize("size", [0, 2**64 - 16])
def test_a_heap_of_texts_that_leads_in_a_circle_is_refused_and_not_read_for_ever(size, tmp_path):
    path = metavision(tmp_path / "a.h5", [ecf_chunk(0)])
    whole = bytearray(path.read_bytes())
    place = whole.index(b"GCOL") + 16
    while whole[place] or whole[place + 1]:  # to the free space after the texts
        place += 16 + -(-int.from_bytes(whole[place + 8 : place + 16], "little") // 8) * 8
    whole[place + 8 : place + 16] = size.to_bytes(8, "little")
    path.write_bytes(whole)
    for read in (read_events, read_recording):
        with pytest.raises(ValueError, match=r"a\.h5.* leads in a circle"):
            read(path)


@pytest.mark.parametrize(
    ("chunks", "options", "rule"),
    [
        ([ecf_chunk(0)[:-1]], {}, "the chunk at event 0 is damaged"),
        ([ecf_chunk(0)], {"count": 149}, "the chunk at event 0 is damaged"),
        ([ecf_chunk(0), bytes(12)], {"count": 300}, "the chunk at event 150 is damaged"),
        ([ecf_chunk(0)], {"count": 300}, "is no readable HDF5 event file"),
        ([bytes(2399)], {"unpacked": 1}, "is no readable HDF5 event file"),
        ([ecf_chunk(0)], {"geometry": "640x8"}, "outside the sensor of 640x8"),
        ([], {"count": 10**12}, "at most max_events=10000000 are read"),
    ],
)
def test_a_file_that_breaks_a_rule_is_refused_by_name(chunks, options, rule, tmp_path):
    with pytest.raises(ValueError, match=rule) as caught:
        read_events(metavision(tmp_path / "a.h5", chunks, **options))
    assert "a.h5" in str(caught.value)
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["CD/events"] = np.zeros(3)
    with pytest.raises(ValueError, match="not rows of x, y, p and t"):
        read_events(tmp_path / "b.h5")
