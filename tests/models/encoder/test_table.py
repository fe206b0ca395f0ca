import dataclasses
import functools
import pickle
import tracemalloc

import numpy as np
import pytest
import torch

from models.encoder.event_batch import batch_windows
from models.encoder.table import EncoderTable, dense
from tests.support.encoders import WINDOW_US, make_evae, make_events


def pack(events, capacity):
    window = np.zeros((capacity + 1, 4), np.int32)
    window[0] = [len(events), 0, WINDOW_US, 0]
    for column, name in enumerate("txyp"):
        window[1 : len(events) + 1, column] = events[name]
    return window


def read(table, events):
    """Context and latent of a window."""
    return table.update(table.empty(), events, 0, WINDOW_US), table.encode(events, 0, WINDOW_US)


KINDS = [  # variant, coding, pool rank
    ("bytestream", "additive", 1),
    ("bytestream", "eventnet", 1),
    ("bytestream", "none", 1),
    ("bytestream_xy", "additive", 1),
    ("bytestream", "additive", 3),
]
evae_of = functools.lru_cache(
    lambda variant, coding, rank: make_evae(variant, coding=coding, pool_rank=rank)
)  # which nothing here changes


@pytest.fixture(
    scope="module",
    params=[(KINDS[0], "model"), (KINDS[0], "int8"), (KINDS[1], "model"), (KINDS[1], "int16"),
            (KINDS[3], "int16"), (KINDS[4], "model"), (KINDS[4], "int8")],
    ids=str,
)  # fmt: skip
def table(request):
    """One for each way to raise a context, of numbers and of integers."""
    kind, precision = request.param
    return EncoderTable.from_evae(evae_of(*kind), precision)


@pytest.mark.parametrize(("variant", "coding", "rank"), KINDS)
@pytest.mark.parametrize(
    ("dtype", "norm", "context_bound", "mu_bound"),
    [("float64", "none", 1e-12, 1e-13), ("float32", "batch", 1e-5, 2e-6)],
)
def test_the_table_is_the_module(variant, coding, rank, dtype, norm, context_bound, mu_bound):
    own = {"coding": coding, "pool_rank": rank, "octaves": 3 if rank > 1 else 0}
    evae = make_evae(variant, getattr(torch, dtype), norm=norm, **own)
    table = EncoderTable.from_evae(evae)
    for count in (0, 1, 2, 300):
        events = make_events(count, seed=count)
        expected = evae.ecn.plain(batch_windows([(events, 0, WINDOW_US)], evae.grid))
        mu = evae.encoder(expected).chunk(2, dim=-1)[0][0].numpy()
        context, latent = read(table, events)
        assert context.dtype == latent.dtype == np.dtype(dtype)
        if rank > 1:
            assert (np.diff(context, axis=0) <= 0).all()
            context = context[-1]
        elif coding == "eventnet":
            context = (context[0] * table.phase[:, context[1].astype(int)]).ravel()
        assert np.abs(context - expected[0].numpy()).max() <= context_bound
        assert np.abs(latent - mu).max() <= mu_bound


@pytest.mark.parametrize(("precision", "bound"), [("int16", 2.0**-11), ("int8", 0.06)])
@pytest.mark.parametrize("kind", [KINDS[0], KINDS[1], KINDS[4]])
def test_a_rounded_table_is_off_by_one_unit_at_the_most_and_smaller(kind, precision, bound):
    exact, rounded = EncoderTable.from_evae(evae_of(*kind)), EncoderTable.from_evae(evae_of(*kind), precision)
    assert rounded.features.nbytes * (2 if precision == "int16" else 4) == exact.features.nbytes
    highest = exact.features.max() + 1.0
    # What one unit is worth follows from the weights that take a context in units.
    unit = (np.abs(rounded.hidden[0]).max(0) / np.abs(exact.hidden[0]).max(0))[:128]
    assert unit.max() <= max(bound, 2 * highest / 2**15)
    for count in (exact.pool_rank, 7, 300):
        events = make_events(count, seed=count)
        (context, mu), (units, latent) = read(exact, events), read(rounded, events)
        if exact.phase is not None:  # magnitudes; which of two near ones wins may change
            units, context = units[0], context[0]
        assert (np.abs(units * unit - context) <= 1.001 * unit).all()
        assert 0 < np.abs(latent - mu).max() < 2 * bound


def test_large_features_widen_the_unit_of_int16_and_none_overflows():
    evae = make_evae(norm="none")
    with torch.no_grad():
        evae.ecn.layers[-1].weight *= 1e4
    exact, rounded = EncoderTable.from_evae(evae), EncoderTable.from_evae(evae, "int16")
    assert exact.features.max() > 100.0
    (_, mu), (units, latent) = (read(table, make_events(300)) for table in (exact, rounded))
    # Two of 32767 units of the largest feature; the weights of the first layer are below 0.1.
    assert np.abs(latent - mu).max() < 0.05
    assert (units >= 0).all()


def test_a_table_with_more_time_bins_comes_closer_to_exact_time():
    evae, events = make_evae(time_bins=4096), make_events(300)
    exact = EncoderTable.from_evae(evae).encode(events, 0, WINDOW_US)
    coarse = [EncoderTable.from_evae(evae, time_bins=bins) for bins in (8, 64, 512)]
    errors = [np.abs(table.encode(events, 0, WINDOW_US) - exact).max() for table in coarse]
    assert errors[0] > 4 * errors[1] > 16 * errors[2] > 0


@pytest.mark.parametrize(
    ("dtype", "wrong", "rule"),
    [
        (torch.float32, {"precision": "float8"}, "precision"),
        (torch.float32, {"time_bins": 0}, "time_bins"),
        (torch.float32, {"time_bins": 65537}, "time_bins"),
        (torch.float16, {}, "must be float32 or float64, got"),
    ],
)
def test_a_table_that_cannot_be_made_is_refused_with_the_rule(dtype, wrong, rule):
    with pytest.raises(ValueError, match=rule):
        EncoderTable.from_evae(make_evae().to(dtype), **wrong)


@pytest.mark.parametrize("reverse", [False, True])
def test_of_equal_magnitudes_eventnet_keeps_the_phase_of_the_newest(reverse):
    table = EncoderTable.from_evae(evae_of(*KINDS[1]))
    features = np.full(table.features.shape, 0.5, np.float32)
    features[0] = 0.75
    codes = np.repeat(np.arange(64, dtype=np.float32)[:, None] / 64 - 1, 128, axis=1)
    table = dataclasses.replace(table, features=features, embedding=codes)
    events = make_events(2)
    # Cell 0 in bin 40 and another cell in bin 56 have the same magnitude.
    events["t"], events["x"], events["y"], events["p"] = [40.5 / 64 * 5000, 56.5 / 64 * 5000], [0, 1], 0, -1
    context, _ = read(table, events[::-1] if reverse else events)
    assert set(context[0]) == {0.375}
    assert set(context[1]) == {56}
    assert not read(table, events[:0])[0].any()


def test_many_events_take_no_more_memory_than_their_addresses():
    table, events = EncoderTable.from_evae(evae_of(*KINDS[0])), make_events(200_000)
    tracemalloc.start()
    table.encode(events, 0, WINDOW_US)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20 * len(events)  # 8 bytes an event, where a feature for each would take 512


def test_making_a_table_leaves_the_model_as_it_was_and_uses_its_running_statistics():
    evae = make_evae().requires_grad_(True).train()
    before = {name: value.clone() for name, value in evae.state_dict().items()}
    table = EncoderTable.from_evae(evae)
    assert all(torch.equal(before[name], value) for name, value in evae.state_dict().items())
    assert evae.training
    assert np.array_equal(EncoderTable.from_evae(evae.freeze()).features, table.features)


@pytest.mark.parametrize("chunks", [1, 3, 50])
def test_any_chunks_of_a_window_in_any_order_give_the_same_context_bit_for_bit(table, chunks):
    events, rng = make_events(300, seed=4), np.random.default_rng(chunks)
    whole, latent = read(table, events)
    context = table.empty()
    for part in np.split(rng.permutation(events), np.sort(rng.integers(0, 301, chunks - 1))):
        before = context.copy()
        raised = table.update(context, part, 0, WINDOW_US)
        assert np.array_equal(context, before)
        context = raised
    assert np.array_equal(context, whole)
    assert np.array_equal(table.latent(context), latent)


def test_an_event_2000_times_is_the_event_as_often_as_the_rank_bit_for_bit(table):
    event = make_events(1).repeat(table.pool_rank)
    assert np.array_equal(table.encode(event, 0, WINDOW_US), table.encode(event.repeat(2000), 0, WINDOW_US))


def test_only_the_time_within_the_window_counts(table):
    here, there = make_events(100, start_us=0), make_events(100, start_us=10**15)
    assert np.array_equal(table.encode(here, 0, WINDOW_US), table.encode(there, 10**15, WINDOW_US))


def test_packed_windows_have_the_latents_of_their_events_bit_for_bit_in_any_batch(table):
    windows = [make_events(count, seed=count) for count in (0, 1, 40, 300, 5)]
    expected = np.stack([table.encode(events, 0, WINDOW_US) for events in windows])
    assert expected.dtype == np.float32
    assert len(np.unique(expected, axis=0)) >= 4
    for packed in (np.stack([pack(events, 300) for events in windows]), [pack(w, len(w)) for w in windows]):
        for first, last in ((0, 5), (1, 4), (4, 5), (2, 2)):
            assert np.array_equal(table.encode_windows(packed[first:last]), expected[first:last])


def test_the_layers_after_the_maximum_are_matrix_products():
    rng = np.random.default_rng(0)
    for windows, inputs, outputs in ((1, 128, 1), (4, 33, 7), (5, 64, 8)):
        contexts, weight = rng.normal(size=(windows, inputs)), rng.normal(size=(outputs, inputs))
        bias = rng.normal(size=outputs)
        np.testing.assert_allclose(dense(contexts, weight, bias), contexts @ weight.T + bias, rtol=1e-12)


def test_an_event_off_the_sensor_and_a_context_of_another_table_are_refused(table):
    with pytest.raises(ValueError, match="start from empty"):
        table.update(np.zeros(64, np.float32), make_events(1), 0, WINDOW_US)
    events = make_events(3)
    events["x"][1] = 16
    for use in (
        lambda: table.update(table.empty(), events, 0, WINDOW_US),
        lambda: table.encode(events, 0, WINDOW_US),
        lambda: table.encode_windows(pack(events, 5)[None]),
    ):
        with pytest.raises(ValueError, match=r"event 1 has .*x=16"):
            use()


def test_the_table_cannot_be_written_and_survives_pickling(table):
    with pytest.raises(ValueError, match="read-only"):
        table.features[0, 0] = 1
    events = make_events(20)
    copied = pickle.loads(pickle.dumps(table))
    assert np.array_equal(copied.encode(events, 0, WINDOW_US), table.encode(events, 0, WINDOW_US))
