import numpy as np
import pytest
from hypothesis import given, settings, strategies

from core.neighbour_filter import filter_all, filter_neighbours, quiet_sensor
from envs.events import EVENT
from models.policy.event_filter import EventFilter
from tests.support.event_files import some_events

WIDTH, HEIGHT, TAU_US = 7, 5, 300

streams = strategies.tuples(strategies.integers(0, 2**32 - 1), strategies.integers(0, 120))
supports = strategies.integers(1, 8)


def make_stream(seed, count, end_us=3000):
    return some_events(seed, count, WIDTH, HEIGHT, end_us)


def passing(events, support, tau_us=TAU_US):
    return filter_neighbours(events, quiet_sensor(WIDTH, HEIGHT), support, tau_us)


def plain(events, support, tau_us):
    """The rule, looking back at every earlier event."""
    kept = []
    for n, event in enumerate(events):
        fired = {
            (int(other["x"]), int(other["y"]))
            for other in events[:n]
            if event["t"] - other["t"] <= tau_us
            and max(abs(int(other["x"]) - int(event["x"])), abs(int(other["y"]) - int(event["y"]))) == 1
        }
        if len(fired) >= support:
            kept.append(event)
    return np.array(kept, EVENT)


@settings(max_examples=40)
@given(streams, supports, strategies.integers(0, 3000))
def test_events_pass_by_the_plain_rule(stream, support, tau_us):
    events = make_stream(*stream)
    np.testing.assert_array_equal(passing(events, support, tau_us), plain(events, support, tau_us))


@settings(max_examples=40)
@given(streams, supports, strategies.lists(strategies.integers(0, 120), max_size=6))
def test_any_pieces_of_a_stream_pass_the_same_events(stream, support, cuts):
    events, last_us = make_stream(*stream), quiet_sensor(WIDTH, HEIGHT)
    pieces = [filter_neighbours(p, last_us, support, TAU_US) for p in np.split(events, sorted(cuts))]
    np.testing.assert_array_equal(np.concatenate(pieces), passing(events, support))


def test_no_support_passes_every_event_and_notes_none():
    events, last_us = make_stream(0, 50), quiet_sensor(WIDTH, HEIGHT)
    assert filter_neighbours(events, last_us, 0, TAU_US) is events
    np.testing.assert_array_equal(last_us, quiet_sensor(WIDTH, HEIGHT))


def test_polarity_says_nothing_and_the_time_is_inclusive():
    events = np.zeros(2, EVENT)
    events["x"], events["p"] = [2, 3], [1, -1]
    for later_us, passes in ((TAU_US, 1), (TAU_US + 1, 0), (0, 1)):
        events["t"] = [40, 40 + later_us]
        assert len(passing(events, 1)) == passes
    assert len(passing(events, 2)) == 0


@pytest.mark.parametrize(("support", "tau_us"), [(-1, 10), (9, 10), (1, -1)])
def test_settings_out_of_range_are_refused(support, tau_us):
    with pytest.raises(ValueError, match=f"got {support} and {tau_us}"):
        passing(make_stream(0, 3), support, tau_us)


@settings(max_examples=30)
@given(streams, streams, supports)
def test_sensors_side_by_side_are_filtered_as_each_by_itself(one, two, support):
    parts = [make_stream(*one), make_stream(*two), make_stream(*one)]
    ends = np.cumsum([0, *(part.size for part in parts)])
    maps = np.stack([quiet_sensor(WIDTH, HEIGHT)] * 3)
    supports = np.array([support, 0, support])
    kept, kept_ends = filter_all(np.concatenate(parts), ends, maps, supports, np.full(3, TAU_US))
    expected = [passing(parts[0], support), parts[1], passing(parts[2], support)]
    for b, own in enumerate(expected):
        assert kept[kept_ends[b] : kept_ends[b + 1]].tobytes() == own.tobytes()


@settings(max_examples=30)
@given(streams, supports)
def test_a_policy_that_is_shown_raw_events_filters_as_the_environment(stream, support):
    events, own = make_stream(*stream), EventFilter(support, TAU_US, quiet_sensor(WIDTH, HEIGHT))
    half = events.size // 2
    kept = [own(part) for part in (events[:half], events[half:])]
    expected = passing(events, support)
    for name in ("t", "x", "y", "p"):
        assert np.array_equal(np.concatenate([part[name] for part in kept]), expected[name])


def test_an_event_outside_the_sensor_is_refused():
    events = make_stream(0, 5)
    events["x"][3] = WIDTH
    with pytest.raises(ValueError, match=f"within {WIDTH} x {HEIGHT} pixels; event 3 is at x={WIDTH}"):
        EventFilter(1, TAU_US, quiet_sensor(WIDTH, HEIGHT))(events)
