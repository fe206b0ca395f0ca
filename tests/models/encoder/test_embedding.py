from functools import partial

import numpy as np
import pytest

from models.encoder.embedding import embedding_table, eventnet_phase, temporal_embedding, time_bin, time_code


def test_the_embedding_is_sines_then_cosines_of_the_published_frequencies():
    times, context = np.array([[0.0, 0.37, 1.0]]), 1024
    embedded = temporal_embedding(times, context)
    assert embedded.shape == (1, 3, context)
    for i in (0, 1, 200, 511):
        w = 100.0 / 1000.0 ** (i / context)
        assert embedded[..., i] == pytest.approx(np.sin(w * times), abs=1e-13)
        assert embedded[..., 512 + i] == pytest.approx(np.cos(w * times), abs=1e-13)


REFUSED = [
    *((partial(temporal_embedding, 0.5, context), "context must be even") for context in (0, 7)),
    *((partial(temporal_embedding, [0.5, t], 8), "must lie in") for t in (-1e-9, 1.001, np.nan)),
    (partial(time_code, 0.5, 8, "sum"), "coding must be one of additive, eventnet, none, got 'sum'"),
]


@pytest.mark.parametrize(("call", "rule"), REFUSED)
def test_what_has_no_code_is_refused_with_the_rule(call, rule):
    with pytest.raises(ValueError, match=rule):
        call()


def test_the_table_holds_the_bin_centres_rounded_once_and_cannot_be_written():
    table = embedding_table(16, 8, "float64")
    assert np.array_equal(table, temporal_embedding((np.arange(16) + 0.5) / 16, 8))
    assert np.array_equal(embedding_table(16, 8), table.astype(np.float32))
    with pytest.raises(ValueError, match="read-only"):
        table[0, 0] = 1


def test_eventnet_takes_the_age_off_every_feature_and_none_adds_nothing():
    times = np.array([0.0, 0.3, 1.0])
    assert np.allclose(time_code(times, 4, "eventnet"), np.repeat([[-1.0], [-0.7], [0.0]], 4, axis=1))
    assert np.array_equal(time_code(times, 4, "none"), np.zeros((3, 4)))
    assert embedding_table(8, 4, "float64", "eventnet")[:, 0].tolist() == [-0.9375 + i / 8 for i in range(8)]
    assert np.array_equal(embedding_table(8, 4, "float32", "none"), np.zeros((1, 4), np.float32))


def test_eventnet_turns_once_backwards_over_the_window():
    phase = eventnet_phase(8, "float64")
    age = 1 - (np.arange(8) + 0.5) / 8
    assert np.allclose(phase[0] + 1j * phase[1], np.exp(-2j * np.pi * age), atol=1e-15)
    with pytest.raises(ValueError, match="read-only"):
        phase[0, 0] = 1


def test_bins_are_the_floor_of_time_times_bins_with_the_window_end_in_the_last():
    bins = [time_bin(t, 1000, 8, 4) for t in range(1000, 1009)]
    assert bins == [0, 0, 1, 1, 2, 2, 3, 3, 3]


def test_an_event_outside_its_window_takes_the_nearest_bin():
    assert [time_bin(t, 0, 5000, 1024) for t in (-(2**63), -1, 0)] == [0, 0, 0]
    assert [time_bin(t, 0, 5000, 1024) for t in (5000, 5001, 2**63 - 1)] == [1023, 1023, 1023]


@pytest.mark.parametrize("bins", [1024, 65536])
def test_bins_are_exact_microseconds_on_a_clock_of_years(bins):
    start, window = 10**15, 1 << 46
    edge = start + 5 * (window // bins)
    assert (time_bin(edge - 1, start, window, bins), time_bin(edge, start, window, bins)) == (4, 5)
