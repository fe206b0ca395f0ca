import dataclasses
import pickle
import tracemalloc

import numpy as np
import pytest
import torch

from models.encoder.event_batch import batch_windows
from models.encoder.table import PRECISIONS, EncoderTable, dense
from tests.support.encoders import WINDOW_US, make_evae, make_events

EVENT = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "i1")])


def pack(events, capacity):
    window = np.zeros((capacity + 1, 4), np.int32)
    window[0] = [len(events), 0, WINDOW_US, 0]
    for column, name in enumerate("txyp"):
        window[1 : len(events) + 1, column] = events[name]
    return window


def module_mu(evae, events, form="plain"):
    context = getattr(evae.ecn, form)(batch_windows([(events, 0, WINDOW_US)], evae.grid))
    return context[0].numpy(), evae.encoder(context).chunk(2, dim=-1)[0][0].numpy()


KINDS = [  # variant, coding, pool rank
    ("bytestream", "additive", 1),
    ("bytestream", "eventnet", 1),
    ("bytestream", "none", 1),
    ("bytestream_xy", "additive", 1),
    ("bytestream", "additive", 3),
]
OCTAVES = 3


@pytest.fixture(params=KINDS, ids=str)
def evae(request):
    variant, coding, rank = request.param
    return make_evae(variant, coding=coding, pool_rank=rank)


@pytest.fixture(params=PRECISIONS)
def table(evae, request):
    return EncoderTable.from_evae(evae, request.param)


@pytest.mark.parametrize(("variant", "coding", "rank"), KINDS)
@pytest.mark.parametrize("norm", ["batch", "none"])
@pytest.mark.parametrize(
    ("dtype", "context_bound", "mu_bound"), [("float64", 1e-12, 1e-13), ("float32", 1e-5, 2e-6)]
)
def test_the_table_is_the_module(variant, coding, rank, norm, dtype, context_bound, mu_bound):
    own = {"coding": coding, "pool_rank": rank, "octaves": OCTAVES if rank > 1 else 0}
    evae = make_evae(variant, getattr(torch, dtype), norm=norm, **own)
    table = EncoderTable.from_evae(evae)
    for count in (0, 1, 2, 300):
        events = make_events(count, seed=count)
        context, mu = module_mu(evae, events)
        updated = table.update(table.empty(), events, 0, WINDOW_US)
        latent = table.encode(events, 0, WINDOW_US)
        assert updated.dtype == latent.dtype == np.dtype(dtype)
        if rank > 1:
            assert (np.diff(updated, axis=0) <= 0).all()
            updated = updated[-1]
        elif coding == "eventnet":
            updated = (updated[0] * table.phase[:, updated[1].astype(int)]).ravel()
        assert np.abs(updated - context).max() <= context_bound
        assert np.abs(latent - mu).max() <= mu_bound


@pytest.mark.parametrize(("precision", "bound"), [("int16", 2.0**-11), ("int8", 0.06)])
@pytest.mark.parametrize(("variant", "coding", "rank"), KINDS)
def test_a_rounded_table_is_off_by_one_unit_at_the_most_and_smaller(variant, coding, rank, precision, bound):
    evae = make_evae(variant, coding=coding, pool_rank=rank)
    exact, rounded = EncoderTable.from_evae(evae), EncoderTable.from_evae(evae, precision)
    assert rounded.features.nbytes * (2 if precision == "int16" else 4) == exact.features.nbytes
    highest = exact.features.max() + 1.0
    for count in (rank, 7, 300):
        events = make_events(count, seed=count)
        context, mu = (exact.update(exact.empty(), events, 0, WINDOW_US), exact.encode(events, 0, WINDOW_US))
        # What one unit is worth follows from the weights that take a context in units.
        unit = (np.abs(rounded.hidden[0]).max(0) / np.abs(exact.hidden[0]).max(0))[:128]
        assert unit.max() <= max(bound, 2 * highest / 2**15)
        units = rounded.update(rounded.empty(), events, 0, WINDOW_US)
        if coding == "eventnet":  # magnitudes; which of two near ones wins may change
            units, context = units[0], context[0]
        assert (np.abs(units * unit - context) <= 1.001 * unit).all()
        assert 0 < np.abs(rounded.encode(events, 0, WINDOW_US) - mu).max() < 2 * bound


def test_large_features_widen_the_unit_of_int16_and_none_overflows():
    evae = make_evae(norm="none")
    with torch.no_grad():
        evae.ecn.layers[-1].weight *= 1e4
    exact, rounded = EncoderTable.from_evae(evae), EncoderTable.from_evae(evae, "int16")
    events = make_events(300)
    assert exact.features.max() > 100.0
    # Two of 32767 units of the largest feature; the weights of the first layer are below 0.1.
    assert np.abs(rounded.encode(events, 0, WINDOW_US) - exact.encode(events, 0, WINDOW_US)).max() < 0.05
    assert (rounded.update(rounded.empty(), events, 0, WINDOW_US) >= 0).all()


def test_a_table_with_more_time_bins_comes_closer_to_exact_time():
    evae, events = make_evae(time_bins=4096), make_events(300)
    exact = EncoderTable.from_evae(evae).encode(events, 0, WINDOW_US)
    coarse = [EncoderTable.from_evae(evae, time_bins=bins) for bins in (8, 64, 512)]
    errors = [np.abs(table.encode(events, 0, WINDOW_US) - exact).max() for table in coarse]
    assert errors[0] > 4 * errors[1] > 16 * errors[2] > 0


@pytest.mark.parametrize("wrong", [{"precision": "float8"}, {"time_bins": 0}, {"time_bins": 65537}])
def test_a_table_of_unknown_precision_or_bins_is_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        EncoderTable.from_evae(make_evae(), **wrong)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_a_table_of_half_precision_weights_is_refused(dtype):
    with pytest.raises(ValueError, match="must be float32 or float64, got"):
        EncoderTable.from_evae(make_evae().to(dtype))


@pytest.mark.parametrize("reverse", [False, True])
def test_of_equal_magnitudes_eventnet_keeps_the_phase_of_the_newest(reverse):
    table = EncoderTable.from_evae(make_evae(coding="eventnet"))
    features = np.full(table.features.shape, 0.5, np.float32)
    features[0] = 0.75
    codes = np.repeat(np.arange(64, dtype=np.float32)[:, None] / 64 - 1, 128, axis=1)
    table = dataclasses.replace(table, features=features, embedding=codes)
    events = make_events(2)
    # Cell 0 in bin 40 and another cell in bin 56 have the same magnitude.
    events["t"], events["x"], events["y"], events["p"] = [40.5 / 64 * 5000, 56.5 / 64 * 5000], [0, 1], 0, -1
    context = table.update(table.empty(), events[::-1] if reverse else events, 0, WINDOW_US)
    assert set(context[0]) == {0.375}
    assert set(context[1]) == {56}
    assert not table.update(table.empty(), events[:0], 0, WINDOW_US).any()


def test_a_million_events_take_no_more_memory_than_their_addresses():
    evae = make_evae()
    table, events = EncoderTable.from_evae(evae), make_events(1_000_000)
    tracemalloc.start()
    latent = table.encode(events, 0, WINDOW_US)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20e6  # 8 bytes an event, where a feature for each would take 512
    halves = table.empty()
    for part in np.array_split(np.random.default_rng(0).permutation(events), 3):
        halves = table.update(halves, part, 0, WINDOW_US)
    assert np.array_equal(table.latent(halves), latent)
    fused = evae(batch_windows([(events, 0, WINDOW_US)], evae.grid))[1][0].numpy()
    assert np.abs(fused - latent).max() < 2e-6


def test_times_that_are_not_integers_are_refused(table):
    for value in (np.nan, 1.5):
        fields = {name: make_events(3)[name] for name in "xyp"} | {"t": np.array([1.0, value, 2.0])}
        with pytest.raises(ValueError, match="field t must hold integers"):
            table.encode(fields, 0, WINDOW_US)


def test_making_a_table_leaves_the_model_as_it_was(evae):
    before = {name: value.clone() for name, value in evae.state_dict().items()}
    EncoderTable.from_evae(evae)
    assert all(torch.equal(before[name], value) for name, value in evae.state_dict().items())
    assert not evae.training


def test_a_table_of_a_model_in_training_uses_its_running_statistics():
    evae = make_evae()
    frozen = EncoderTable.from_evae(evae)
    training = EncoderTable.from_evae(evae.requires_grad_(True).train())
    assert np.array_equal(frozen.features, training.features)


@pytest.mark.parametrize("chunks", [2, 3, 7, 50, 300])
def test_any_chunks_of_a_window_give_the_same_context_bit_for_bit(table, chunks):
    events = make_events(300, seed=4)
    whole = table.update(table.empty(), events, 0, WINDOW_US)
    cuts = np.sort(np.random.default_rng(chunks).integers(0, 301, chunks - 1))
    context = table.empty()
    for part in np.split(events, cuts):
        context = table.update(context, part, 0, WINDOW_US)
    assert np.array_equal(context, whole)
    assert np.array_equal(table.latent(context), table.encode(events, 0, WINDOW_US))


def test_the_order_of_events_does_not_matter_bit_for_bit(table):
    events = make_events(300, seed=5)
    shuffled = np.random.default_rng(0).permutation(events)
    assert np.array_equal(table.encode(events, 0, WINDOW_US), table.encode(shuffled, 0, WINDOW_US))


def test_an_event_2000_times_is_the_event_as_often_as_the_rank_bit_for_bit(table):
    event = make_events(1).repeat(table.pool_rank)
    assert np.array_equal(table.encode(event, 0, WINDOW_US), table.encode(event.repeat(2000), 0, WINDOW_US))


def test_equal_times_are_defined(table):
    events = make_events(50)
    events["t"] = 17
    assert np.isfinite(table.encode(events, 0, WINDOW_US)).all()


def test_only_the_time_within_the_window_counts(table):
    here, there = make_events(100, start_us=0), make_events(100, start_us=10**15)
    assert np.array_equal(table.encode(here, 0, WINDOW_US), table.encode(there, 10**15, WINDOW_US))


def test_an_update_leaves_its_context_as_it_was(table):
    context = table.empty()
    assert table.update(context, make_events(10), 0, WINDOW_US).any()
    assert not context.any()


def test_an_empty_window_is_the_encoder_at_the_zero_context(evae, table):
    expected = evae.encoder(torch.zeros(1, evae.encoder[0].in_features))[0, :8].numpy()
    assert np.allclose(table.encode(make_events(0), 0, WINDOW_US), expected, atol=1e-6)
    assert np.allclose(table.encode_windows(np.zeros((1, 5, 4), np.int32))[0], expected, atol=1e-6)


def test_packed_windows_have_the_latents_of_their_events_bit_for_bit(table):
    windows = [make_events(count, seed=count) for count in (0, 1, 40, 300)]
    expected = np.stack([table.encode(events, 0, WINDOW_US) for events in windows])
    assert expected.dtype == np.float32
    for packed in (np.stack([pack(events, 300) for events in windows]), [pack(w, len(w)) for w in windows]):
        assert np.array_equal(table.encode_windows(packed), expected)


def test_a_latent_does_not_depend_on_the_other_windows_of_its_batch(table):
    windows = [pack(make_events(count % 7 * 9, seed=count), 60) for count in range(20)]
    whole = table.encode_windows(windows)
    assert len(np.unique(whole, axis=0)) > 15
    for first, last in ((0, 1), (9, 11), (4, 7), (5, 20), (19, 20)):
        assert np.array_equal(table.encode_windows(windows[first:last]), whole[first:last])
    assert table.encode_windows([]).shape == (0, whole.shape[1])


def test_the_layers_after_the_maximum_are_matrix_products():
    rng = np.random.default_rng(0)
    for windows, inputs, outputs in ((1, 128, 1), (4, 33, 7), (5, 64, 8)):
        contexts, weight = rng.normal(size=(windows, inputs)), rng.normal(size=(outputs, inputs))
        bias = rng.normal(size=outputs)
        np.testing.assert_allclose(dense(contexts, weight, bias), contexts @ weight.T + bias, rtol=1e-12)


@pytest.mark.parametrize(("field", "value"), [("x", 16), ("y", 12), ("p", 0), ("x", 65535)])
def test_an_event_off_the_sensor_is_refused(table, field, value):
    events = make_events(3)
    events[field][1] = value
    with pytest.raises(ValueError, match=f"event 1 has .*{field}={value}"):
        table.encode(events, 0, WINDOW_US)
    with pytest.raises(ValueError, match="event 1 has"):
        table.encode_windows(pack(events, 5)[None])


def test_a_context_of_another_table_is_refused(table):
    with pytest.raises(ValueError, match="start from empty"):
        table.update(np.zeros(64, np.float32), make_events(1), 0, WINDOW_US)


def test_the_table_cannot_be_written_and_survives_pickling(table):
    with pytest.raises(ValueError, match="read-only"):
        table.features[0, 0] = 1
    events = make_events(20)
    copied = pickle.loads(pickle.dumps(table))
    assert np.array_equal(copied.encode(events, 0, WINDOW_US), table.encode(events, 0, WINDOW_US))
