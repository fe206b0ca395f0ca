import numpy as np
import pytest

from research.probe import readout as probes
from research.probe.dataset import SECTORS, ProbeData
from research.probe.readout import inner_episodes, network, per_episode, probe, ratio_interval, ridge, scores

BEARINGS = np.linspace(-43, 43, SECTORS)


def probe_data(flights, steps, seed):
    """Flights towards one obstacle each: a bump of proximity at a bearing that drifts."""
    rng = np.random.default_rng(seed)
    flight = np.repeat(np.arange(flights), steps)
    centre = np.repeat(rng.uniform(-40, 40, flights), steps) + rng.normal(0, 5, flights * steps)
    height = np.tile(np.linspace(0.1, 0.9, steps), flights)
    near = height[:, None] * np.exp(-(((BEARINGS - centre[:, None]) / 8) ** 2))
    return ProbeData([], flight, near, BEARINGS)


TRAIN, HELD_OUT = probe_data(40, 50, 0), probe_data(12, 50, 1)


def standard(x):
    return ((x - x.mean(0)) / x.std(0)).astype(np.float32)


def told(make):
    return scores([probe(make(TRAIN), TRAIN, make(HELD_OUT), HELD_OUT, 0)], HELD_OUT)


def test_a_representation_that_is_the_geometry_tells_everything():
    result = told(lambda part: part.proximity.astype(np.float32))
    assert result.ridge[0] > 0.9999
    assert result.network[0] > 0.97
    assert result.bearing_deg[0] < 1.0


def noise(part):
    return np.random.default_rng(len(part.episode)).normal(size=(len(part.episode), 6))


def a_constant(part):
    return np.ones((len(part.episode), 2))


def other_flights(part):
    order = np.random.default_rng(2).permutation(part.episode.max() + 1)
    return part.proximity.reshape(len(order), -1, SECTORS)[order].reshape(-1, SECTORS)


@pytest.mark.parametrize("make", [noise, a_constant, other_flights])
def test_what_does_not_depend_on_the_flight_tells_nothing(make):
    result = told(make)
    assert -0.3 < result.ridge[0] < 0.05
    assert -0.3 < result.network[0] < 0.05
    assert result.bearing_deg[0] > 15


def test_a_network_reads_what_no_line_can():
    def make(part):
        return BEARINGS[part.proximity.argmax(1)][:, None] / 40

    result = told(make)
    assert result.network[0] > result.ridge[0] + 0.2
    assert result.bearing_deg[0] < 6


def test_ridge_finds_a_linear_map_exactly():
    rng, rows = np.random.default_rng(0), probes.ROWS + 100  # more than are added up at once
    x, weights = standard(rng.normal(size=(rows, 7))), rng.normal(size=(7, 3))
    inner = np.arange(rows) >= 0.8 * rows
    y = x @ weights + 5.0
    new = rng.normal(size=(50, 7)).astype(np.float32)
    np.testing.assert_allclose(ridge(x, y, inner, new), new @ weights + 5.0, atol=1e-6)


def test_ridge_takes_the_penalty_that_serves_other_flights_and_redundant_columns():
    rng = np.random.default_rng(0)
    x = standard(rng.normal(size=(60, 50)))
    inner = np.arange(60) >= 48
    y = rng.normal(size=(60, 1))
    assert np.abs(ridge(x, y, inner, x)).mean() < 0.7 * np.abs(y).mean()  # noise is not learnt by heart
    twice = np.concatenate([x[:, :3], x[:, :3], 0 * x[:, :1]], axis=1)
    truth = x[:, :3].sum(axis=1, keepdims=True)
    np.testing.assert_allclose(ridge(twice, truth, inner, twice), truth, atol=1e-5)


def test_the_same_seed_gives_the_same_network_and_another_seed_another():
    x, y = TRAIN.proximity[:400, ::4].astype(np.float32), TRAIN.proximity[:400]
    inner = inner_episodes(TRAIN.episode[:400])
    one, again, other = (network(x, y, inner, x, seed) for seed in (0, 0, 1))
    assert np.array_equal(one, again)
    assert not np.array_equal(one, other)


def test_the_network_kept_is_the_one_that_served_other_flights_best(monkeypatch):
    monkeypatch.setattr(probes, "PATIENCE", 1000)
    monkeypatch.setattr(probes, "LEARNING_RATE", 1e-2)
    rng = np.random.default_rng(0)
    x, y = standard(rng.normal(size=(300, 40))), rng.normal(size=(300, 1))
    inner = np.arange(300) >= 200
    noise = network(x, y, inner, x, 0)  # it would learn this by heart
    assert np.square(noise[inner] - y[inner]).mean() < 1.1 * np.square(y[inner] - y.mean()).mean()


def test_inner_episodes_are_whole_and_last():
    flight = np.repeat(np.arange(10), [3, 1, 4, 1, 5, 9, 2, 6, 5, 3])
    assert np.array_equal(inner_episodes(flight), flight >= 8)
    assert inner_episodes(np.array([4, 4, 7])).tolist() == [False, False, True]
    with pytest.raises(ValueError, match=r"two training episodes or more, got 1; raise probe.num_steps"):
        inner_episodes(np.zeros(5, int))


def test_an_interval_is_over_flights_and_trainings():
    assert per_episode(np.array([1.0, 2.0, 4.0]), np.array([3, 3, 8])).tolist() == [3.0, 4.0]
    top, bottom = np.array([[1.0, 2.0, 3.0]]), np.array([2.0, 4.0, 6.0])
    assert ratio_interval(top, bottom) == pytest.approx((0.5, 0.5, 0.5))
    middle, low, high = ratio_interval(np.array([[1.0, 3.0, 2.0]]), bottom)
    assert (middle, low, high) == pytest.approx((0.5, 1 / 3, 0.75))
    middle, low, high = ratio_interval(np.array([[1.0, 2.0, 3.0], [2.0, 4.0, 6.0]]), bottom)
    assert (middle, low, high) == pytest.approx((0.75, 0.5, 1.0))
    rng = np.random.default_rng(0)
    few, many = (ratio_interval(rng.normal(1, 0.5, (1, size)), np.ones(size)) for size in (10, 1000))
    assert many[2] - many[1] < 0.25 * (few[2] - few[1])
    assert np.isnan(ratio_interval(top, np.zeros(3))).all()


def test_a_representation_that_is_not_finite_is_refused():
    x = np.full((len(TRAIN.episode), 2), np.nan)
    with pytest.raises(ValueError, match="representation must be finite"):
        probe(x, TRAIN, x, TRAIN, 0)
