import os
import struct
from pathlib import Path

import numpy as np
import pytest

from envs.recordings import read_events, read_frames, read_imu, read_parts
from envs.recordings.event_file import CUT_PACKETS, Request, Tally
from envs.recordings.event_packets import ROWS as DECODERS
from envs.recordings.event_packets import EventPacket, PacketDecoder
from tests.support.event_files import some_events

pytest.importorskip("rosbags", reason="the package rosbags reads and writes bags")
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_typestore

from tests.support.bags import BASE_US, davis, header, store_of, write_bag

DATA = (
    Path(os.environ.get("EVADE_DATA", Path(__file__).resolve().parents[4] / "shared" / "data")) / "ros_events"
)
needs_bags = pytest.mark.skipif(not DATA.is_dir(), reason=f"no {DATA}; set EVADE_DATA")
KINDS = [(True, None), (False, StoragePlugin.SQLITE3), (False, StoragePlugin.MCAP)]


def dated(count: int) -> np.ndarray:
    events = some_events(1, count, 240, 180, 100_000)
    events["t"] += BASE_US
    return events


@pytest.mark.parametrize(
    ("package", "is_ros1", "plugin"),
    [*(("dvs_msgs", *kind) for kind in KINDS), ("prophesee_event_msgs", *KINDS[0])],
)
def test_arrays_of_events_are_read_from_every_bag(package, is_ros1, plugin, tmp_path):
    events = dated(301)
    store, part = davis(events, package, is_ros1)
    path = write_bag(tmp_path / "davis.bag", {"/dvs/events": part}, store, is_ros1, plugin)
    file = read_events(path)
    assert (file.format, file.width, file.height, file.damage) == ("ros", 240, 180, {})
    assert file.events.tobytes() == events.tobytes()
    if not is_ros1:
        (inner,) = (one for one in path.iterdir() if one.suffix in (".db3", ".mcap"))
        assert read_events(inner).events.tobytes() == events.tobytes()
        (path / "metadata.yaml").unlink()  # as a crash leaves it
        assert read_events(path).events.tobytes() == events.tobytes()


def test_a_bag_without_events_is_refused_with_its_topics(tmp_path):
    store = get_typestore(Stores.ROS1_NOETIC)
    words = ("std_msgs/msg/String", [store.types["std_msgs/msg/String"](data="x")])
    path = write_bag(tmp_path / "a.bag", {"/words": words}, store, True)
    with pytest.raises(ValueError, match=r"no topic of events .* its topics are /words \(std_msgs/String\)"):
        read_events(path)


@pytest.mark.parametrize(("is_ros1", "plugin"), [KINDS[0], KINDS[2]])
def test_a_bag_that_was_cut_off_has_its_whole_messages(is_ros1, plugin, tmp_path):
    events = dated(3000)
    store, part = davis(events, "dvs_msgs", is_ros1)
    path = write_bag(tmp_path / "a.bag", {"/dvs/events": part}, store, is_ros1, plugin)
    if not is_ros1:
        (path,) = (one for one in path.iterdir() if one.suffix == ".mcap")
    whole = path.read_bytes()
    for share in (0.4, 0.7):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.warns(UserWarning, match="cut off"):
            file = read_events(path)
        n = len(file.events)
        assert file.events.tobytes() == events[:n].tobytes()
        assert 100 < n < 3000
        assert file.damage[CUT_PACKETS] >= 1
        with pytest.raises(ValueError, match="read it without strict"):
            read_events(path, strict=True)
    path.write_bytes(whole[:40])
    assert len(read_events(path).events) == 0


@needs_bags
@pytest.mark.parametrize("name", ["evk_ros1.bag", "evk_ros2_db3"])
def test_the_evk_recording_has_the_sums_of_its_own_tests(name):
    file = read_events(DATA / name)
    assert (file.width, file.height, len(file.triggers), file.skipped) == (640, 480, 4157, 4157)
    assert (np.sum(file.events["p"] < 0), np.sum(file.events["p"] > 0)) == (218_291, 125_183)
    assert file.events["t"].sum() == 2_851_601_611_994
    assert file.events["t"].sum() + file.triggers["t"].sum() == 2_885_601_049_874
    parts = list(read_parts(DATA / name, part_events=30_000))
    assert np.concatenate([part.events for part in parts]).tobytes() == file.events.tobytes()


@needs_bags
def test_the_davis_recording_in_mcap_has_the_counts_of_its_own_tests():
    file = read_events(DATA / "evk_ros2_mcap")
    assert (file.width, file.height) == (346, 260)
    assert (np.sum(file.events["p"] < 0), np.sum(file.events["p"] > 0)) == (360_223, 211_043)
    assert file.events["t"][0] == 1_744_227_144_732_712


def decoded(encoding: str, base_us: int, body: bytes) -> list[tuple[int, ...]]:
    packet = EventPacket(64, 48, base_us * 1000, encoding, body)
    return [tuple(column) for column in DECODERS[encoding](packet, Tally()).T.tolist()]


def test_packets_decode_as_their_descriptions_say():
    row = struct.pack("<Ii", 5 << 17 | 6 << 2 | 1 << 1 | 1, 7) + struct.pack("<Ii", 9 << 17 | 3 << 2 | 1, 3)
    assert decoded("libcaer", 1000, row) == [(1007, 5, 6, 1), (1000 + 2**31 + 3, 9, 3, 0)]
    mono = struct.pack("<IHH", 5000, 3, 4 | 0x8000) + struct.pack("<IHH", 9000, 5, 6)
    assert decoded("mono", 1000, mono) == [(1005, 3, 4, 1), (1009, 5, 6, 0)]
    words = [0x0001, 0x1002, 0x2000 | 7, 0x3800 | 9, 0x4000 | 20, 0x5000 | 0b101, 0x5000 | 1]
    assert decoded("libcaer_cmp", 1000, np.array(words, "<u2").tobytes()) == [
        (1000 + 4096 + 2, 7, 9, 1), (5098, 7, 20, 0), (5098, 7, 22, 0), (5098, 7, 28, 0)
    ]  # fmt: skip


def test_packets_of_several_encodings_lose_none():
    decoder = PacketDecoder(Request(Path("a.bag"), 64, 48))
    evt2 = np.array([8 << 28 | 1, 1 << 28 | 5 << 22 | 7 << 11 | 9], "<u4")  # high bits of the time, then ON
    evt3 = np.array([8 << 12, 6 << 12 | 70, 20, 2 << 12 | 1 << 11 | 11], "<u2")  # time, row, ON in a column
    mono = struct.pack("<IHH", 90_000, 3, 4 | 0x8000)
    for encoding, body in (("evt2", evt2.tobytes()), ("evt3", evt3.tobytes()), ("mono", mono)):
        decoder.add(EventPacket(64, 48, 0, encoding, body))
    events = decoder.taken().events
    assert events[["t", "x", "y", "p"]].tolist() == [(69, 7, 9, 1), (70, 11, 20, 1), (90, 3, 4, 1)]
    assert decoder.taken().events.size == 0


def test_an_encoding_that_is_not_known_is_refused_by_name(tmp_path):
    store = store_of("dvs_msgs", True)
    kind = "event_camera_msgs/msg/EventPacket"
    packet = store.types[kind](
        header=header(store, BASE_US, True), height=48, width=64, seq=0, time_base=0, encoding="evt9",
        is_bigendian=False, events=np.zeros(4, np.uint8),
    )  # fmt: skip
    path = write_bag(tmp_path / "a.bag", {"/e": (kind, [packet])}, store, True)
    known = "evt2, evt21, evt3, libcaer, libcaer_cmp, mono"
    with pytest.raises(ValueError, match=f"encoding 'evt9'; {known} are read: record it with one"):
        read_events(path)


@pytest.mark.parametrize(("is_ros1", "plugin"), KINDS[:2])
def test_images_and_inertial_samples_come_from_the_same_bag(is_ros1, plugin, tmp_path):
    store, part = davis(dated(10), "dvs_msgs", is_ros1)
    types = store.types
    picture = np.arange(12, dtype=np.uint8)
    image = types["sensor_msgs/msg/Image"](
        header=header(store, BASE_US + 5, is_ros1), height=3, width=4, encoding="mono8", is_bigendian=0,
        step=4, data=picture,
    )  # fmt: skip
    three = types["geometry_msgs/msg/Vector3"]
    kinds = ("orientation", "angular_velocity", "linear_acceleration")
    imu = types["sensor_msgs/msg/Imu"](
        header=header(store, BASE_US + 6, is_ros1),
        orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
        angular_velocity=three(x=1.0, y=2.0, z=3.0),
        linear_acceleration=three(x=4.0, y=5.0, z=6.0),
        **{f"{kind}_covariance": np.zeros(9) for kind in kinds},
    )
    topics = {"/image_raw": ("sensor_msgs/msg/Image", [image]), "/imu": ("sensor_msgs/msg/Imu", [imu])}
    path = write_bag(tmp_path / "a.bag", {"/events": part, **topics}, store, is_ros1, plugin)
    (frame,) = read_frames(path)
    assert frame.t_us == BASE_US + 5
    assert frame.values.tolist() == picture.reshape(3, 4).tolist()
    (sample,) = read_imu(path)
    assert (sample["t"], sample["rotation"].tolist(), sample["acceleration"].tolist()) == (
        BASE_US + 6, [1, 2, 3], [4, 5, 6]
    )  # fmt: skip
    assert len(read_events(path).events) == 10
