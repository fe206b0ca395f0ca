import numpy as np
import pytest

from envs.config import FaultsConfig
from envs.events import EVENT
from envs.faults import add_background, dead_pixels, drop_dead

SHAPE = (8, 12)
NONE_DEAD = np.zeros(SHAPE, bool)


def some_events(count=1000, seed=0):
    rng = np.random.default_rng(seed)
    events = np.empty(count, EVENT)
    events["t"] = np.sort(rng.integers(1, 5001, count))
    events["x"], events["y"] = rng.integers(0, SHAPE[1], count), rng.integers(0, SHAPE[0], count)
    events["p"] = rng.choice([-1, 1], count)
    return events[np.lexsort((events["x"], events["y"], events["t"]))]


@pytest.mark.parametrize(("sparsity", "dead"), [(0.0, 0), (0.2, 19), (0.5, 48), (1.0, 96)])
def test_sparsity_kills_that_fraction_of_the_pixels(sparsity, dead):
    assert dead_pixels(SHAPE, sparsity, np.random.default_rng(0)).sum() == dead


@pytest.mark.parametrize("sparsity", [1.2, -0.1, np.nan])
def test_a_sparsity_that_is_no_fraction_is_refused(sparsity):
    with pytest.raises(ValueError, match="sparsity"):
        dead_pixels(SHAPE, sparsity, np.random.default_rng(0))


def test_the_same_stream_kills_the_same_pixels_and_another_kills_others():
    first, again, other = (dead_pixels(SHAPE, 0.5, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_every_pixel_is_as_likely_to_die():
    rng = np.random.default_rng(0)
    share = np.mean([dead_pixels(SHAPE, 0.25, rng) for _ in range(2000)], axis=0)
    assert np.abs(share - 0.25).max() < 0.05


def test_dead_pixels_are_silent_and_all_others_keep_every_event():
    events = some_events()
    mask = dead_pixels(SHAPE, 0.5, np.random.default_rng(0))
    kept = drop_dead(events, mask)
    assert not mask[kept["y"], kept["x"]].any()
    assert np.array_equal(kept, [e for e in events if not mask[e["y"], e["x"]]])
    assert drop_dead(events, ~NONE_DEAD).size == 0


@pytest.mark.parametrize("fraction", [0.1, 1.0, 10.0])
def test_background_activity_is_a_fraction_of_the_true_events(fraction):
    events, faults = some_events(), FaultsConfig(background_activity=fraction)
    noisy = add_background(events, 0, 5000, faults, NONE_DEAD, np.random.default_rng(0))
    expected = fraction * len(events)
    assert abs(len(noisy) - len(events) - expected) < 5 * np.sqrt(expected)
    assert add_background(events[:0], 0, 5000, faults, NONE_DEAD, np.random.default_rng(0)).size == 0


def test_background_rate_counts_live_pixels_and_time_also_in_a_still_scene():
    dead = dead_pixels(SHAPE, 0.5, np.random.default_rng(0))
    faults = FaultsConfig(background_activity_hz=10.0)
    noise = add_background(np.empty(0, EVENT), 7, 7 + 10**7, faults, dead, np.random.default_rng(0))
    assert abs(len(noise) - 10 * 48 * 10) < 5 * np.sqrt(4800)
    assert not dead[noise["y"], noise["x"]].any()
    assert noise["t"].min() > 7
    assert noise["t"].max() <= 7 + 10**7
    assert abs(noise["t"].mean() / 1e7 - 0.5) < 0.02
    assert abs(noise["p"].mean()) < 0.08
    counts = np.zeros(SHAPE, int)
    np.add.at(counts, (noise["y"], noise["x"]), 1)
    assert counts[~dead].min() > 50


def test_noise_is_merged_in_total_order_and_keeps_every_true_event():
    events = some_events()
    faults = FaultsConfig(background_activity=0.5)
    noisy = add_background(events, 0, 5000, faults, NONE_DEAD, np.random.default_rng(0))
    assert np.array_equal(np.lexsort((noisy["x"], noisy["y"], noisy["t"])), np.arange(len(noisy)))
    both, count = np.unique(np.concatenate((events, noisy)), return_counts=True)
    assert (count[np.isin(both, events)] >= 2).all()


def test_the_shortest_interval_holds_noise_at_its_end():
    faults = FaultsConfig(background_activity_hz=1e6)
    noise = add_background(np.empty(0, EVENT), 41, 42, faults, NONE_DEAD, np.random.default_rng(0))
    assert noise.size > 0
    assert (noise["t"] == 42).all()
    with pytest.raises(ValueError, match="t1_us > t0_us"):
        add_background(noise, 42, 42, faults, NONE_DEAD, np.random.default_rng(0))


def test_a_sensor_without_a_live_pixel_makes_no_noise():
    faults = FaultsConfig(background_activity_hz=1e3)
    assert add_background(np.empty(0, EVENT), 0, 5000, faults, ~NONE_DEAD, np.random.default_rng(0)).size == 0
