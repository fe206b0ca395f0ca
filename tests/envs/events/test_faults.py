import numpy as np
import pytest

from envs.config import ADDED_FAULTS, CameraConfig, FaultsConfig
from envs.events import EVENT, EventCamera, RealSensor, apply_faults, draw_pixel_faults
from envs.events.disturbances import disturb

SHAPE = (8, 12)
SIZE = 96
NO_EVENTS = np.empty(0, EVENT)
SECOND = 10**6
ALL_NOISE = {
    "background_activity": 0.5,
    "background_activity_hz": 1000.0,
    "hot_pixel_share": 0.1,
    "hot_pixel_hz": 5000.0,
}


def some_events(count=1000, seed=0):
    rng = np.random.default_rng(seed)
    events = np.empty(count, EVENT)
    events["t"] = np.sort(rng.integers(1, 5001, count))
    events["x"], events["y"] = rng.integers(0, SHAPE[1], count), rng.integers(0, SHAPE[0], count)
    events["p"] = rng.choice([-1, 1], count)
    return events[np.lexsort((events["x"], events["y"], events["t"]))]


def faulty(events, t0_us, t1_us, seed=0, **fields):
    """The pixels' faults, and the events that they leave and make."""
    faults, rng = FaultsConfig(**fields), np.random.default_rng(seed)
    pixels = draw_pixel_faults(SHAPE, faults, rng)
    return pixels, apply_faults(events, t0_us, t1_us, faults, pixels, rng)


def near(number, mean):
    """Within 4 standard deviations of a Poisson number."""
    return abs(number - mean) <= 4 * np.sqrt(mean)


def test_a_sensor_without_faults_hands_its_events_on_and_draws_nothing():
    events, rng = some_events(), np.random.default_rng(0)
    pixels = draw_pixel_faults(SHAPE, FaultsConfig(), rng)
    assert apply_faults(events, 0, 5000, FaultsConfig(), pixels, rng) is events
    assert rng.random() == np.random.default_rng(0).random()
    assert not pixels.dead.any()
    assert pixels.hot.size == 0


@pytest.mark.parametrize(("sparsity", "dead"), [(0.2, 19), (0.75, 72), (1.0, 96)])
def test_sparsity_kills_that_fraction_of_the_pixels_and_dead_ones_make_no_noise(sparsity, dead):
    events = some_events()
    pixels, kept = faulty(events, 0, 5000, sparsity=sparsity)
    assert pixels.dead.sum() == dead
    assert np.array_equal(kept, events[[not pixels.dead[e["y"], e["x"]] for e in events]])
    noisy = faulty(events, 0, 5000, sparsity=sparsity, **ALL_NOISE)[1]
    assert not pixels.dead[noisy["y"], noisy["x"]].any()
    pixels, noise = faulty(NO_EVENTS, 0, SECOND, sparsity=sparsity, hot_pixel_share=1.0, hot_pixel_hz=5.0)
    assert np.array_equal(pixels.hot, np.flatnonzero(~pixels.dead)), "no more are hot than alive"
    assert near(noise.size, (SIZE - dead) * 5.0)


def test_every_pixel_is_as_likely_to_be_dead_or_hot():
    faults, rng = FaultsConfig(sparsity=0.25, hot_pixel_share=0.25), np.random.default_rng(0)
    draws = [draw_pixel_faults(SHAPE, faults, rng) for _ in range(1000)]
    error = 4.5 * np.sqrt(0.25 * 0.75 / 1000)
    assert np.abs(np.mean([pixels.dead for pixels in draws], axis=0) - 0.25).max() < error
    hot = np.bincount(np.concatenate([pixels.hot for pixels in draws]), minlength=SIZE) / 1000
    assert np.abs(hot - 0.25).max() < error


def test_the_same_seed_gives_the_same_bytes():
    fields = {**ALL_NOISE, "sparsity": 0.3, "event_dropout": 0.2}
    first, again, other = (faulty(some_events(), 0, 5000, seed=seed, **fields)[1] for seed in (5, 5, 6))
    assert first.tobytes() == again.tobytes() != other.tobytes()


def test_the_shortest_interval_holds_noise_at_its_end_and_an_empty_one_is_refused():
    noise = faulty(NO_EVENTS, 41, 42, background_activity_hz=1e6, hot_pixel_share=0.5, hot_pixel_hz=1e6)[1]
    assert noise.size > 100
    assert (noise["t"] == 42).all()
    with pytest.raises(ValueError, match="t1_us > t0_us; got 42 and 42"):
        faulty(NO_EVENTS, 42, 42, background_activity_hz=1.0)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("sparsity", 1.2),
        ("event_dropout", -0.1),
        ("hot_pixel_share", np.nan),
        ("leak_hz", 1e7),
        ("shot_noise_hz", True),
    ],
)
def test_faults_out_of_range_are_refused(name, value):
    with pytest.raises(ValueError, match=name):
        FaultsConfig(**{name: value})


def sensed(labels, faults, **fields):
    """Batches of a sensor's events, and their labels, of some events a step."""
    config = CameraConfig(width=SHAPE[1], height=SHAPE[0], **fields)
    camera = EventCamera(config)
    camera.reset(np.ones(SHAPE, np.float32), 0)
    state = camera.state, camera.pixels
    sensor = RealSensor(config, faults, state, np.random.default_rng(0), 0, labels=labels)
    batches, is_noise = [], []
    for step in range(4):
        events = some_events(300, seed=step)
        events["t"] += 5000 * step
        batches.append(sensor.events(events, 5000 * step, 5000 * (step + 1)))
        is_noise.append(sensor.is_noise)
    return np.concatenate(batches), np.concatenate(is_noise)


@pytest.mark.parametrize("fields", [{}, {"latency_us": 900, "latency_jitter_us": 50.0}, {"readout_hz": 1e5}])
def test_labels_change_no_event_and_mark_every_one_that_was_added(fields):
    """A readout delays, reorders and loses events; each keeps its label."""
    faults = FaultsConfig(**ALL_NOISE, event_dropout=0.3)
    plain, none = sensed(False, faults, **fields)
    events, is_noise = sensed(True, faults, **fields)
    assert none.size == 0
    assert events.dtype == EVENT
    assert events.tobytes() == plain.tobytes()
    assert is_noise.shape == events.shape
    assert 0 < is_noise.sum() < is_noise.size
    if not fields:
        true = np.concatenate([some_events(300, seed=step) for step in range(4)])
        true["t"] += np.repeat(np.arange(4) * 5000, 300)
        assert np.isin(events[~is_noise], true).all()
        assert np.isin(events[is_noise], true).mean() < 0.05  # by chance
    clean, unlabelled = sensed(True, FaultsConfig(), **fields)
    assert not unlabelled.any()
    assert near((~is_noise).sum(), 0.7 * len(clean)) or "readout_hz" in fields


def test_what_a_fault_of_a_plug_in_adds_is_noise_and_what_it_keeps_is_as_it_was(monkeypatch):
    def make(amount, shape, rng):
        def apply(events, t0_us, t1_us):
            added = np.array([(t1_us, 3, 2, 1)], EVENT)
            return np.concatenate((events[::2], added))

        return apply

    monkeypatch.setitem(ADDED_FAULTS, "halve", make)
    events, is_noise = sensed(True, FaultsConfig(background_activity_hz=1000.0, added={"halve": 1.0}))
    before, was_noise = sensed(True, FaultsConfig(background_activity_hz=1000.0))
    ends = np.isin(events["t"], [5000, 10_000, 15_000, 20_000]) & (events["x"] == 3) & (events["y"] == 2)
    assert ends.sum() >= 4
    assert is_noise[ends].sum() >= 4
    assert np.isin(events[~is_noise], before[~was_noise]).all()
    assert np.isin(events[is_noise & ~ends], before[was_noise]).all()


def added_by_numpy(events, t0_us, t1_us, faults, pixels, rng):
    """What `apply_faults` should return, by numpy alone, drawn in the same order.

    Background: a share of the true events left, and a rate per live pixel; a rate per hot pixel; at uniform
    times, with uniform polarities.
    """
    events = events[~pixels.dead[events["y"], events["x"]]]
    events = events[rng.random(events.size) >= faults.event_dropout]
    seconds = (t1_us - t0_us) * 1e-6
    mean = faults.background_activity * events.size
    mean += faults.background_activity_hz * seconds * pixels.live.size
    kinds = [(pixels.live, mean), (pixels.hot, faults.hot_pixel_hz * seconds * pixels.hot.size)]
    places = [where[rng.integers(0, where.size, rng.poisson(mean))] for where, mean in kinds]
    false = np.empty(sum(map(len, places)), EVENT)
    drawn = [(rng.integers(t0_us, t1_us, len(at)) + 1, 2 * rng.integers(0, 2, len(at)) - 1) for at in places]
    false["t"], false["p"] = (np.concatenate(part) for part in zip(*drawn, strict=True))
    false["y"], false["x"] = np.divmod(np.concatenate(places), SHAPE[1])
    both = np.concatenate((events, false))
    return both[np.lexsort((both["x"], both["y"], both["t"]))]


# numpy draws small and large Poisson numbers in two ways
@pytest.mark.parametrize(("rate", "dead"), [(1.0, "sparsity"), (30.0, "dead_block"), (3000.0, "sparsity")])
def test_losses_and_false_events_are_drawn_as_numpy_draws_them(rate, dead):
    faults = FaultsConfig(
        event_dropout=0.3, background_activity=0.2, background_activity_hz=rate,
        hot_pixel_share=0.05, hot_pixel_hz=20 * rate, **{dead: 0.2},
    )  # fmt: skip
    pixels = draw_pixel_faults(SHAPE, faults, np.random.default_rng(0))
    streams = [np.random.default_rng(1) for _ in range(2)]
    for seed in range(8):
        told = some_events(50, seed=seed), 0, 5000, faults, pixels
        found, expected = apply_faults(*told, streams[0]), added_by_numpy(*told, streams[1])
        assert found.tobytes() == expected.tobytes()
    assert streams[0].random() == streams[1].random()


@pytest.mark.parametrize(("share", "sides"), [(0.25, (4, 6)), (1.0, SHAPE), (1e-4, (0, 0))])
def test_a_dead_block_is_one_rectangle_of_the_image_s_proportions(share, sides):
    rng, tops = np.random.default_rng(0), set()
    for _ in range(400):
        dead = draw_pixel_faults(SHAPE, FaultsConfig(dead_block=share), rng).dead
        assert dead.sum() == sides[0] * sides[1]
        if dead.any():
            rows, columns = dead.any(axis=1), dead.any(axis=0)
            assert (rows.sum(), columns.sum()) == sides  # no gap: as many dead as the rectangle has
            assert np.ptp(np.flatnonzero(rows)) == sides[0] - 1
            assert np.ptp(np.flatnonzero(columns)) == sides[1] - 1
            tops.add((int(rows.argmax()), int(columns.argmax())))
    if sides[0]:
        assert len(tops) == (SHAPE[0] - sides[0] + 1) * (SHAPE[1] - sides[1] + 1)  # any place


BURSTS = {"burst_hz": 20.0, "burst_ms": 3.0, "burst_activity_hz": 500.0}


def burst_events(seed, ends_us, **fields):
    """What a camera in the dark reports until each of these times."""
    camera = CameraConfig(width=SHAPE[1], height=SHAPE[0])
    eye, rng = EventCamera(camera), np.random.default_rng(seed)
    eye.reset(np.zeros(SHAPE, np.float32), 0)
    real = RealSensor(camera, FaultsConfig(**BURSTS | fields), (eye.state, eye.pixels), rng, 0)
    begins = [0, *ends_us[:-1]]
    return [real.events(NO_EVENTS, begin, end) for begin, end in zip(begins, ends_us, strict=True)]


def test_bursts_are_bursts_of_as_many_events_as_their_rates_say_however_time_is_divided():
    each = 3e-3 * 500.0 * SIZE
    number = 20.0 * 12  # of bursts in 12 s
    mean, sigma = number * each, np.sqrt(number * (each + each**2))  # of a compound Poisson number
    for step_us in (SECOND, 5_000):
        events = np.concatenate(burst_events(1, list(range(step_us, 12 * SECOND + 1, step_us))))
        assert abs(events.size - mean) < 4 * sigma
        assert (np.diff(events["t"]) >= 0).all()
    begins = events["t"][np.concatenate(([True], np.diff(events["t"]) > 500))]
    assert near(begins.size, number * np.exp(-20.0 * 3e-3))  # what begins while none is under way
    filled = np.unique(events["t"] // 1000).size / 12_000
    assert abs(filled - (1 - np.exp(-20.0 * 4e-3))) < 0.02  # 3 ms touch 4 of the clock's milliseconds
    assert abs(events["p"].mean()) < 0.02


def test_bursts_that_lack_a_number_are_off_and_draw_nothing():
    for off in BURSTS:
        assert sum(events.size for events in burst_events(0, [SECOND], **{off: 0.0})) == 0


def test_rates_that_would_fill_the_memory_are_refused_with_the_number():
    with pytest.raises(ValueError, match=r"16777216 .*e\+09 .*Lower the rates"):
        faulty(NO_EVENTS, 0, 100 * SECOND, background_activity_hz=1e6)
    with pytest.raises(ValueError, match="Lower the rates"):
        burst_events(0, [10 * SECOND], burst_hz=1e3, burst_ms=1e3, burst_activity_hz=1e6)


@pytest.mark.parametrize("share", [0.1, 1.0])
def test_displaced_events_keep_time_and_polarity_and_go_to_a_neighbour(share):
    before = some_events(4000)
    after = disturb(before, FaultsConfig(displaced=share), SHAPE, np.random.default_rng(1))
    np.testing.assert_array_equal(before, some_events(4000))
    np.testing.assert_array_equal(before["t"], after["t"])
    np.testing.assert_array_equal(after, after[np.lexsort((after["x"], after["y"], after["t"]))])
    assert after["x"].max() < SHAPE[1]
    assert after["y"].max() < SHAPE[0]
    for events in (before, after):
        events.sort(order=("t", "p"))
    np.testing.assert_array_equal(before["p"], after["p"])
    times, numbers = np.unique(before["t"], return_counts=True)
    alone = np.isin(before["t"], times[numbers == 1])
    for axis in "xy":
        assert np.abs(before[axis][alone].astype(int) - after[axis][alone]).max() <= 1
    assert (before[alone] != after[alone]).mean() == pytest.approx(share, abs=0.03)


def test_displaced_events_go_every_way_alike():
    events = np.zeros(8000, EVENT)
    events["t"], events["x"], events["y"] = np.arange(8000), 5, 5
    moved = disturb(events, FaultsConfig(displaced=1.0), SHAPE, np.random.default_rng(2))
    _, numbers = np.unique(moved[["x", "y"]], return_counts=True)
    assert len(numbers) == 8
    assert np.abs(numbers - 1000).max() < 150


@pytest.mark.parametrize("share", [0.1, 1.0])
def test_flipped_events_stay_where_and_when_they_were(share):
    before = some_events(4000)
    after = disturb(before, FaultsConfig(flipped=share), SHAPE, np.random.default_rng(1))
    np.testing.assert_array_equal(before, some_events(4000))
    for name in ("t", "x", "y"):
        np.testing.assert_array_equal(before[name], after[name])
    assert (before["p"] != after["p"]).mean() == pytest.approx(share, abs=0.03)
    assert set(after["p"]) == {-1, 1}
