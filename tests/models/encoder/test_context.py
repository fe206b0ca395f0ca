import copy
import itertools

import numpy as np
import pytest
import torch

from models.encoder import context as room
from models.encoder.context import EventContextNetwork, Events, newest_first
from models.encoder.event_batch import EventBatch, Grid

GRID = Grid(width=12, height=9, time_bins=32)
SIZES = [40, 0, 1, 300, 7, 0]
CASES = [  # variant, coding, pool rank, norm
    ("bytestream", "additive", 1, "batch"),
    ("bytestream", "eventnet", 1, "batch"),
    ("bytestream", "none", 1, "none"),
    ("bytestream_xy", "additive", 1, "batch"),
    ("bytestream", "additive", 2, "none"),
    ("bytestream_xy", "additive", 3, "batch"),
]


def make_batch(seed, sizes=SIZES, grid=GRID):
    rng = np.random.default_rng(seed)
    offsets = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    code = rng.integers(0, 2 * grid.width * grid.height, offsets[-1], dtype=np.int32)
    return EventBatch(grid, code, rng.integers(0, grid.time_bins, offsets[-1], dtype=np.int32), offsets)


def make_network(
    variant="bytestream", norm="batch", dtype=torch.float64, coding="additive", rank=1, octaves=0
):
    torch.manual_seed(1)
    network = EventContextNetwork(GRID, variant, 48, norm, coding, rank, octaves).to(dtype)
    for normalisation in network.norms:
        torch.nn.init.uniform_(normalisation.weight, 0.5, 1.5)
        torch.nn.init.uniform_(normalisation.bias, -0.3, 0.3)
    return network


def run(network, form, batches):
    """Context of the last batch, gradients and buffers after all of them, as one dict."""
    network = copy.deepcopy(network)
    for batch in batches:
        context = getattr(network, form)(batch)
        direction = torch.from_numpy(np.random.default_rng(5).standard_normal(context.shape)).to(context)
        (context * direction).sum().backward()
    values = {"context": context.detach()}
    values |= {f"gradient {name}": p.grad for name, p in network.named_parameters()}
    return values | dict(network.named_buffers())


@pytest.fixture(params=["processor", "device"])
def fused_form(request, monkeypatch):
    """Both fused forms, that of a device on the processor too."""
    if request.param == "device":
        monkeypatch.setattr(room.MaxContext, "apply", room.max_on_device)


def relative_differences(network, batches):
    plain, fused = run(network, "plain", batches), run(network, "forward", batches)
    assert plain.keys() == fused.keys()
    return {
        name: ((plain[name] - fused[name]).abs().max() / plain[name].abs().max().clamp_min(1e-30)).item()
        for name in plain
    }


@pytest.mark.usefixtures("fused_form")
@pytest.mark.parametrize(("variant", "coding", "rank", "norm"), CASES)
@pytest.mark.parametrize(
    ("dtype", "training", "bounds"),
    [
        (torch.float64, True, (1e-10, 1e-10)),
        (torch.float64, False, (1e-10, 1e-10)),
        (torch.float32, True, (5e-6, 5e-5)),
    ],
)
def test_the_fused_form_is_the_plain_formula(variant, coding, rank, norm, dtype, training, bounds):
    network = make_network(variant, norm, dtype, coding, rank, octaves=rank - 1).train(training)
    batches = [make_batch(0), make_batch(1, [500, 3])] if dtype == torch.float64 else [make_batch(0)]
    differences = relative_differences(network, batches)
    assert differences["context"] < bounds[0]
    assert max(differences.values()) < bounds[1], differences


@pytest.mark.usefixtures("fused_form")
def test_eventnet_keeps_the_complex_number_of_largest_magnitude():
    network = make_network(coding="eventnet").eval()
    batch = make_batch(0, [1, 60, 7])
    squashed = network.cell_features().detach().numpy()[batch.code]
    assert 0 <= squashed.min() < 0.01 < 0.3 < squashed.max() < 1
    age = 1 - (batch.bin[:, None] + 0.5) / GRID.time_bins
    numbers = np.maximum(squashed - age, 0) * np.exp(-2j * np.pi * age)
    context = network(batch).detach().numpy()
    assert context.shape == (3, 96)
    for row, part in zip(context, np.split(numbers, batch.offsets[1:-1]), strict=True):
        largest = part[np.abs(part).argmax(0), np.arange(48)]
        assert np.abs(row - np.concatenate([largest.real, largest.imag])).max() < 1e-12


def test_of_equals_the_newest_comes_first_and_windows_stay_together():
    events = Events(np.arange(5), np.array([3, 7, 5, 0, 2]), np.array([0, 3, 3, 5]), np.empty((0, 0)))
    cell, bins, offsets, _ = newest_first(events)
    assert cell.tolist() == [1, 2, 0, 4, 3]
    assert bins.tolist() == [7, 5, 3, 2, 0]
    assert offsets.tolist() == [0, 3, 3, 5]


@pytest.mark.usefixtures("fused_form")
@pytest.mark.parametrize("rank", [1, 2, 8])
def test_of_equal_sums_the_first_wins_in_windows_of_any_size(rank):
    """Few values make many equal sums; the gradient of the bias counts winners with a feature above 0."""
    rng, sizes = np.random.default_rng(3), [*range(12), 40]
    offsets = np.cumsum([0, *sizes])
    cell, bins = rng.integers(0, 6, offsets[-1], dtype=np.int32), rng.integers(0, 5, offsets[-1])
    h, weight, bias = torch.eye(6), torch.from_numpy(rng.integers(0, 3, (16, 6))).float(), torch.zeros(16)
    codes = rng.integers(-2, 2, (5, 16)).astype(np.float32)
    inputs = [value.requires_grad_() for value in (h, weight, bias)]
    events = Events(cell, bins, offsets, codes)
    context, winning_bin = room.MaxContext.apply(*inputs, events, False, rank)
    context.sum().backward()
    value = weight.detach().numpy().T[cell] + codes[bins]
    counted = np.zeros((6, 16))
    for b, (first, stop) in enumerate(itertools.pairwise(offsets)):
        own = value[first:stop]
        order = np.argsort(-own, axis=0, kind="stable")
        winners = order[rank - 1] if len(own) >= rank else np.zeros(16, int)
        best = own[winners, np.arange(16)].clip(0) if len(own) >= rank else np.zeros(16)
        assert np.array_equal(context[b].detach(), best)
        for j in np.flatnonzero(best > 0):
            winner = first + winners[j]
            assert winning_bin[b, j] == bins[winner]
            counted[cell[winner], j] += weight[j, cell[winner]] > 0
        assert not winning_bin[b][torch.from_numpy(best <= 0)].any()
    assert np.array_equal(weight.grad.T, counted)
    assert np.array_equal(bias.grad, counted.sum(0))


@pytest.mark.parametrize("form", ["forward", "plain"])
@pytest.mark.parametrize(
    ("dtype", "batch", "rule"),
    [
        (torch.float16, make_batch(0), "must be float32 or float64, got torch"),
        (torch.float32, make_batch(0, [1]), "at least two events"),
        (torch.float32, make_batch(0, [0]), "at least two events"),
        (torch.float32, make_batch(0, [2], Grid(4, 4, 32)), "make it with the model's grid"),
    ],
)
def test_weights_and_batches_that_do_not_fit_are_refused_with_the_rule(dtype, batch, rule, form):
    with pytest.raises(ValueError, match=rule):
        getattr(make_network(dtype=dtype), form)(batch)


@pytest.mark.usefixtures("fused_form")
@pytest.mark.parametrize("form", ["forward", "plain"])
@pytest.mark.parametrize(("coding", "size"), [("additive", 48), ("eventnet", 96)])
def test_in_eval_mode_windows_without_events_have_the_zero_context_and_one_event_suffices(form, coding, size):
    network = make_network(coding=coding).eval()
    for sizes in ([0, 0], [40, 0, 1, 0]):
        batch = make_batch(0, sizes)
        batch.bin[:] = GRID.time_bins - 1  # the newest, which no coding forgets
        context = getattr(network, form)(batch)
        assert context.shape == (len(sizes), size)
        assert context.any(1).tolist() == [events > 0 for events in sizes]


@pytest.mark.parametrize("form", ["forward", "plain"])
@pytest.mark.parametrize("coding", ["additive", "eventnet"])
def test_equal_events_have_no_variance_and_finite_gradients(form, coding):
    one = np.full(50, 17, np.int32)
    batch = EventBatch(GRID, one, one, np.array([0, 50]))
    for name, value in run(make_network(dtype=torch.float32, coding=coding), form, [batch]).items():
        assert torch.isfinite(value).all(), name
        if "running_var" in name:
            assert (value > 0).all(), name


@pytest.mark.parametrize(("coding", "rank"), [("additive", 3), ("eventnet", 1)])
def test_the_order_of_events_in_a_window_does_not_matter(coding, rank):
    network, batch = make_network(dtype=torch.float32, coding=coding, rank=rank).eval(), make_batch(0, [300])
    order = np.random.default_rng(2).permutation(300)
    assert torch.equal(
        network(batch), network(EventBatch(GRID, batch.code[order], batch.bin[order], batch.offsets))
    )


@pytest.mark.parametrize(("variant", "coding"), [("bytestream_xy", "additive"), ("bytestream", "none")])
def test_without_time_the_bins_do_not_matter(variant, coding):
    network, batch = make_network(variant, coding=coding).eval(), make_batch(0)
    assert torch.equal(network(batch), network(EventBatch(GRID, batch.code, batch.bin * 0, batch.offsets)))


def test_octaves_are_the_sines_and_cosines_of_a_place_with_half_the_period_each():
    network = make_network(octaves=3)
    cells = np.array([0, GRID.width - 1, GRID.width * (GRID.height - 1)])
    inputs = network._inputs(cells).numpy()
    assert inputs[:, :2].tolist() == [[-1, -1], [1, -1], [-1, 1]]
    for k in range(3):
        sin_x, cos_x, sin_y, cos_y = inputs[:, 3 + 4 * k : 7 + 4 * k].T
        for sine, cosine, place in ((sin_x, cos_x, inputs[:, 0]), (sin_y, cos_y, inputs[:, 1])):
            assert np.allclose(sine, np.sin(0.5 * np.pi * 2**k * place))
            assert np.allclose(sine**2 + cosine**2, 1)


def test_a_single_pixel_sensor_is_at_the_origin():
    network = EventContextNetwork(Grid(1, 1, 4), "bytestream", 8, "none")
    assert network._inputs(np.array([0, 1])).tolist() == [[0, 0, -1], [0, 0, 1]]
