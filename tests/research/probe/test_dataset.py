import numpy as np
import pytest

from envs.config import EnvConfig
from envs.scene.range_scan import sector_proximity
from models.encoder.event_batch import Grid
from models.encoder.table import EncoderTable
from models.policy.features import push_features
from research.probe import dataset as probe_data
from research.probe.dataset import (
    SECTORS,
    ProbeData,
    cell_features,
    column_features,
    latents,
    nothing,
    record_probe_data,
    stacked,
)
from tests.support.encoders import make_evae

GRID = Grid(64, 64, 1024)


PLACES = []  # where `seen` looked for obstacles


def recorded(seed=0, split="train"):
    config = EnvConfig(observation="events", split=split, time_limit_s=0.05)
    return record_probe_data(config, 25, seed, lambda count: None)


@pytest.fixture(scope="module")
def seen():
    def look(scene, pose, fov_deg, sectors):
        PLACES.append(pose)
        return sector_proximity(scene, pose, fov_deg, sectors)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(probe_data, "sector_proximity", look)
        return recorded()


def test_flights_are_whole_and_follow_each_other(seen):
    assert seen.episode.tolist() == [0] * 10 + [1] * 10 + [2] * 5
    for number in range(3):
        windows = [seen.windows[step] for step in np.flatnonzero(seen.episode == number)]
        assert [start for _, start, _ in windows] == list(range(0, 5000 * len(windows), 5000))
        assert {length for *_, length in windows} == {5000}
        for events, start, length in windows:
            assert ((events["t"] > start) & (events["t"] <= start + length)).all()


def test_the_same_seed_sees_the_same_and_other_seeds_and_splits_see_others(seen):
    again, other, elsewhere = recorded(), recorded(seed=1), recorded(split="validation")
    assert np.array_equal(again.proximity, seen.proximity)
    assert all(np.array_equal(a[0], b[0]) for a, b in zip(again.windows, seen.windows, strict=True))
    for part in (other, elsewhere):
        assert not np.array_equal(part.proximity[:10], seen.proximity[:10])


def test_the_truth_is_that_of_the_place_where_the_step_ends(seen):
    assert len(PLACES) == 25
    for number in range(3):
        y_m = np.array([PLACES[step][1] for step in np.flatnonzero(seen.episode == number)])
        assert (np.diff(np.concatenate([[0.0], y_m])) > 0.07).all()  # 0.1 m a step, or 45 degrees to a side
    assert seen.proximity.shape == (25, SECTORS)
    assert 0 <= seen.proximity.min() < seen.proximity.max() <= 1
    assert np.allclose(seen.bearing_deg, -seen.bearing_deg[::-1])
    assert np.array_equal(seen.alarm, seen.proximity.max(1) >= np.exp(-1.5))


def test_representations_have_a_row_for_each_step(seen):
    evae = make_evae()
    grid = evae.grid
    cropped = [
        (events[(events["x"] < grid.width) & (events["y"] < grid.height)], *rest)
        for events, *rest in seen.windows
    ]
    small = ProbeData(cropped, seen.episode, seen.proximity, seen.bearing_deg)
    table = EncoderTable.from_evae(evae)
    assert np.array_equal(latents(small, evae)[7], table.encode(*cropped[7]))
    assert nothing(seen).tolist() == [[0.0]] * 25
    counts = np.expm1(cell_features(seen, GRID, 16))
    assert counts.shape == (25, 512)
    np.testing.assert_allclose(counts.sum(1), [len(events) for events, *_ in seen.windows], rtol=1e-5)
    by_column = np.expm1(column_features(seen, GRID)).reshape(25, 2, 16, 4).sum(3)  # ON, then OFF
    np.testing.assert_allclose(counts.reshape(25, 2, 16, 16).sum(2)[:, ::-1], by_column, rtol=1e-4, atol=1e-4)


def test_stacked_rows_are_those_of_a_policy(seen):
    features = np.random.default_rng(0).normal(size=(25, 3)).astype(np.float32)
    stack = np.zeros((1, 4, 3), np.float32)
    rows = stacked(features, seen.episode, 4)
    for step, number in enumerate(seen.episode):
        first = np.array([step == 0 or seen.episode[step - 1] != number])
        stack = push_features(stack, features[step : step + 1], first)
        assert np.array_equal(rows[step], stack.ravel())
