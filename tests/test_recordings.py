import h5py
import numpy as np
import pytest

from envs.events import EVENT
from envs.recordings import Recording, milliseconds_to_index, read_recording, write_recording


@pytest.fixture
def recording() -> Recording:
    rng = np.random.default_rng(0)
    events = np.empty(5000, EVENT)
    events["t"] = np.sort(rng.integers(10**13, 10**13 + 40_000, 5000))
    events["x"], events["y"] = rng.integers(0, 64, (2, 5000))
    events["p"] = rng.choice([-1, 1], 5000)
    return Recording(events, {"step_t_us": np.arange(8) * 5000}, {"sensor": {"width": 64}, "seed": 3})


def test_what_is_written_is_read(recording, tmp_path):
    write_recording(tmp_path / "a.h5", recording)
    back = read_recording(tmp_path / "a.h5")
    assert back.events.tobytes() == recording.events.tobytes()
    assert back.about == recording.about
    assert np.array_equal(back.index["step_t_us"], recording.index["step_t_us"])
    assert not list(tmp_path.glob("*.part"))


def test_a_recording_without_events_is_read_too(tmp_path):
    write_recording(tmp_path / "a.h5", Recording(np.empty(0, EVENT), {}, {}))
    assert len(read_recording(tmp_path / "a.h5").events) == 0


def test_milliseconds_point_at_the_first_event_not_before_them(recording):
    t_us = recording.t_us - recording.t_us[0]
    index = milliseconds_to_index(t_us)
    for ms, first in enumerate(index):
        assert t_us[first] >= 1000 * ms
        assert first == 0 or t_us[first - 1] < 1000 * ms


def test_events_out_of_order_or_of_another_type_are_refused(recording, tmp_path):
    with pytest.raises(ValueError, match="sorted by t"):
        write_recording(tmp_path / "a.h5", Recording(recording.events[::-1], {}, {}))
    with pytest.raises(ValueError, match="EVENT"):
        write_recording(tmp_path / "a.h5", Recording(np.zeros(3), {}, {}))
    assert not list(tmp_path.iterdir())


def test_a_truncated_file_is_refused_by_name(recording, tmp_path):
    path = tmp_path / "a.h5"
    write_recording(path, recording)
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(ValueError, match=r"a\.h5 is no readable event recording"):
        read_recording(path)


def test_a_file_that_declares_more_than_memory_holds_is_refused_before_reading(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name in "txyp":
            file.create_dataset(f"events/{name}", (10**12,), "i8", chunks=(1024,), fillvalue=1)
        file["t_offset"] = 0
    with pytest.raises(ValueError, match="declares 1000000000000 entries"):
        read_recording(tmp_path / "a.h5")


def test_a_link_to_another_file_is_not_followed(recording, tmp_path):
    write_recording(tmp_path / "a.h5", recording)
    with h5py.File(tmp_path / "b.h5", "w") as file:
        for name in ("events", "index", "t_offset"):
            file[name] = h5py.ExternalLink("a.h5", f"/{name}")
        file.attrs["about"] = "{}"
    with pytest.raises(ValueError, match="events is missing or a link"):
        read_recording(tmp_path / "b.h5")
