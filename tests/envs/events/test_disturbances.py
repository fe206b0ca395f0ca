import numpy as np
import pytest

from envs.config import FaultsConfig
from envs.events.camera import EVENT
from envs.events.disturbances import disturb

SHAPE = (12, 16)


def random_events(count=4000):
    rng = np.random.default_rng(0)
    events = np.zeros(count, EVENT)
    events["t"] = np.sort(rng.integers(0, 5000, count))
    events["x"], events["y"] = rng.integers(0, SHAPE[1], count), rng.integers(0, SHAPE[0], count)
    events["p"] = rng.choice([-1, 1], count)
    return events[np.lexsort((events["x"], events["y"], events["t"]))]


def disturbed(**shares):
    return disturb(random_events(), FaultsConfig(**shares), SHAPE, np.random.default_rng(1))


@pytest.mark.parametrize("share", [0.1, 0.5, 1.0])
def test_displaced_events_keep_time_and_polarity_and_go_to_a_neighbour(share):
    before, after = random_events(), disturbed(displaced=share)
    np.testing.assert_array_equal(before["t"], after["t"])
    assert after["x"].max() < SHAPE[1]
    assert after["y"].max() < SHAPE[0]
    for t in np.unique(before["t"]):
        then, now = (events[events["t"] == t] for events in (before, after))
        assert sorted(then["p"]) == sorted(now["p"])
        if len(then) == 1:
            step = abs(int(now["x"][0]) - int(then["x"][0])), abs(int(now["y"][0]) - int(then["y"][0]))
            assert max(step) <= 1
    alone = np.isin(
        before["t"], [t for t, n in zip(*np.unique(before["t"], return_counts=True), strict=True) if n == 1]
    )
    moved = (before[alone] != after[alone]).mean()
    assert moved == pytest.approx(share, abs=0.03)


def test_displaced_events_go_every_way_alike():
    events = np.zeros(8000, EVENT)
    events["t"], events["x"], events["y"] = np.arange(8000), 5, 5
    moved = disturb(events, FaultsConfig(displaced=1.0), SHAPE, np.random.default_rng(2))
    _, numbers = np.unique(moved[["x", "y"]], return_counts=True)
    assert len(numbers) == 8
    assert np.abs(numbers - 1000).max() < 150


@pytest.mark.parametrize("share", [0.1, 0.5, 1.0])
def test_flipped_events_stay_where_and_when_they_were(share):
    before, after = random_events(), disturbed(flipped=share)
    for name in ("t", "x", "y"):
        np.testing.assert_array_equal(before[name], after[name])
    assert (before["p"] != after["p"]).mean() == pytest.approx(share, abs=0.03)
    assert set(after["p"]) == {-1, 1}


def test_nothing_is_drawn_without_a_share_and_the_events_given_stay_as_they_are():
    events, rng = random_events(), np.random.default_rng(3)
    assert disturb(events, FaultsConfig(), SHAPE, rng) is events
    assert rng.bit_generator.state == np.random.default_rng(3).bit_generator.state
    disturb(events, FaultsConfig(displaced=0.5, flipped=0.5), SHAPE, rng)
    np.testing.assert_array_equal(events, random_events())


def test_the_result_is_sorted():
    after = disturbed(displaced=0.7, flipped=0.2)
    order = np.lexsort((after["x"], after["y"], after["t"]))
    np.testing.assert_array_equal(after, after[order])
