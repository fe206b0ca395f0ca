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
KINDS = [  # variant, coding, pool rank
    ("bytestream", "additive", 1),
    ("bytestream", "eventnet", 1),
    ("bytestream", "none", 1),
    ("bytestream_xy", "additive", 1),
    ("bytestream", "additive", 2),
    ("bytestream_xy", "additive", 3),
]
CASES = [(*kind, norm) for kind in KINDS for norm in ("batch", "none")]


def make_batch(seed, sizes=SIZES, grid=GRID):
    rng = np.random.default_rng(seed)
    offsets = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    code = rng.integers(0, 2 * grid.width * grid.height, offsets[-1], dtype=np.int32)
    return EventBatch(grid, code, rng.integers(0, grid.time_bins, offsets[-1], dtype=np.int32), offsets)


def make_network(
    variant="bytestream", norm="batch", dtype=torch.float64, context=48, coding="additive", rank=1, octaves=0
):
    torch.manual_seed(1)
    network = EventContextNetwork(GRID, variant, context, norm, coding, rank, octaves).to(dtype)
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
@pytest.mark.parametrize("training", [True, False])
def test_the_fused_form_is_the_plain_formula_in_float64(variant, coding, rank, norm, training):
    network = make_network(variant, norm, coding=coding, rank=rank, octaves=rank - 1).train(training)
    differences = relative_differences(network, [make_batch(0), make_batch(1, [500, 3])])
    assert max(differences.values()) < 1e-10, differences


@pytest.mark.usefixtures("fused_form")
@pytest.mark.parametrize(("variant", "coding", "rank", "norm"), CASES)
def test_the_fused_form_is_the_plain_formula_in_float32_to_its_rounding(variant, coding, rank, norm):
    network = make_network(variant, norm, torch.float32, coding=coding, rank=rank)
    differences = relative_differences(network, [make_batch(0)])
    assert differences["context"] < 5e-6
    assert max(differences.values()) < 5e-5, differences


@pytest.mark.usefixtures("fused_form")
@pytest.mark.parametrize("form", ["forward", "plain"])
def test_eventnet_keeps_the_complex_number_of_largest_magnitude(form):
    network = make_network(coding="eventnet").eval()
    batch = make_batch(0, [1, 60, 7])
    squashed = network.cell_features().detach().numpy()[batch.code]
    assert 0 <= squashed.min() < 0.01 < 0.3 < squashed.max() < 1
    age = 1 - (batch.bin[:, None] + 0.5) / GRID.time_bins
    numbers = np.maximum(squashed - age, 0) * np.exp(-2j * np.pi * age)
    context = getattr(network, form)(batch).detach().numpy()
    assert context.shape == (3, 96)
    for row, part in zip(context, np.split(numbers, batch.offsets[1:-1]), strict=True):
        largest = part[np.abs(part).argmax(0), np.arange(48)]
        assert np.abs(row - np.concatenate([largest.real, largest.imag])).max() < 1e-12


@pytest.mark.parametrize("form", ["forward", "plain"])
def test_eventnet_forgets_an_event_older_than_its_feature_is_large(form):
    network, batch = make_network(coding="eventnet").eval(), make_batch(0, [300])
    oldest = EventBatch(GRID, batch.code, batch.bin * 0, batch.offsets)
    assert getattr(network, form)(batch).any()
    assert not getattr(network, form)(oldest).any()


def test_of_equals_the_newest_comes_first_and_windows_stay_together():
    events = Events(np.arange(5), np.array([3, 7, 5, 0, 2]), np.array([0, 3, 3, 5]), np.empty((0, 0)))
    cell, bins, offsets, _ = newest_first(events)
    assert cell.tolist() == [1, 2, 0, 4, 3]
    assert bins.tolist() == [7, 5, 3, 2, 0]
    assert offsets.tolist() == [0, 3, 3, 5]


@pytest.mark.usefixtures("fused_form")
@pytest.mark.parametrize("rank", [1, 2, 3, 8])
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
@pytest.mark.parametrize("rank", [2, 3])
def test_fewer_false_events_than_the_rank_raise_no_feature_above_the_largest_of_the_others(form, rank):
    network = make_network(dtype=torch.float32, rank=rank).eval()
    largest = make_network(dtype=torch.float32).eval()
    events, false = make_batch(0, [60]), make_batch(1, [rank - 1])
    both = EventBatch(
        GRID, np.append(events.code, false.code), np.append(events.bin, false.bin), np.array([0, 59 + rank])
    )
    clean, seen = getattr(network, form)(events), getattr(network, form)(both)
    assert (seen >= clean).all()
    assert (seen <= getattr(largest, form)(events)).all()
    assert (getattr(largest, form)(both) > getattr(largest, form)(events)).any()


@pytest.mark.parametrize("form", ["forward", "plain"])
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_refused(form, dtype):
    with pytest.raises(ValueError, match="must be float32 or float64, got torch"):
        getattr(make_network(dtype=dtype), form)(make_batch(0))


@pytest.mark.usefixtures("fused_form")
def test_the_fused_form_of_float32_is_close_to_the_plain_formula_of_float64():
    network = make_network(dtype=torch.float32)
    exact = run(copy.deepcopy(network).double(), "plain", [make_batch(0)])
    # The embedding is tabulated in each dtype, so that it differs by one rounding as well.
    rounded = run(network, "forward", [make_batch(0)])
    assert (exact["context"] - rounded["context"]).abs().max() < 1e-5


@pytest.mark.usefixtures("fused_form")
def test_the_appendix_sizes_agree_as_well():
    network = make_network(context=1024)
    assert max(relative_differences(network, [make_batch(3)]).values()) < 1e-10


@pytest.mark.usefixtures("fused_form")
@pytest.mark.parametrize("form", ["forward", "plain"])
@pytest.mark.parametrize("coding", ["additive", "eventnet"])
def test_an_empty_window_has_the_zero_context(form, coding):
    context = getattr(make_network(coding=coding), form)(make_batch(0))
    assert not context[1].any()
    assert not context[5].any()
    assert context[0].any()


@pytest.mark.usefixtures("fused_form")
@pytest.mark.parametrize("form", ["forward", "plain"])
@pytest.mark.parametrize(("coding", "size"), [("additive", 48), ("eventnet", 96)])
def test_a_batch_of_empty_windows_alone_is_defined_in_eval_mode(form, coding, size):
    context = getattr(make_network(coding=coding).eval(), form)(make_batch(0, [0, 0]))
    assert context.shape == (2, size)
    assert not context.any()


@pytest.mark.parametrize("form", ["forward", "plain"])
@pytest.mark.parametrize("sizes", [[1], [0], [0, 1]])
def test_batch_statistics_of_fewer_than_two_events_are_refused(form, sizes):
    with pytest.raises(ValueError, match="at least two events"):
        getattr(make_network(), form)(make_batch(0, sizes))


@pytest.mark.parametrize("form", ["forward", "plain"])
def test_one_event_needs_no_statistics_in_eval_mode_or_without_normalisation(form):
    assert getattr(make_network().eval(), form)(make_batch(0, [1])).any()
    assert getattr(make_network(norm="none"), form)(make_batch(0, [1])).any()


@pytest.mark.parametrize("form", ["forward", "plain"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("coding", ["additive", "eventnet", "none"])
def test_equal_events_have_no_variance_and_finite_gradients(form, dtype, coding):
    one = np.full(50, 17, np.int32)
    batch = EventBatch(GRID, one, one, np.array([0, 50]))
    for name, value in run(make_network(dtype=dtype, coding=coding), form, [batch]).items():
        assert torch.isfinite(value).all(), name
        if "running_var" in name:
            assert (value > 0).all(), name


def test_in_eval_mode_an_event_repeated_2000_times_is_the_event_once():
    network = make_network().eval()
    single = make_batch(0, [1])
    many = EventBatch(GRID, single.code.repeat(2000), single.bin.repeat(2000), np.array([0, 2000]))
    assert torch.equal(network(single), network(many))


@pytest.mark.parametrize(("coding", "rank"), [("additive", 1), ("additive", 3), ("eventnet", 1), ("none", 1)])
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


@pytest.mark.parametrize("coding", ["additive", "eventnet"])
def test_with_time_the_bins_do_matter(coding):
    network, batch = make_network(coding=coding).eval(), make_batch(0)
    assert not torch.equal(
        network(batch), network(EventBatch(GRID, batch.code, batch.bin * 0, batch.offsets))
    )


def test_batch_statistics_weigh_a_cell_by_its_events():
    code = np.array([3, 3, 3, 90], np.int32)
    network = make_network("bytestream_xy")
    network(EventBatch(GRID, code, code * 0, np.array([0, 4])))
    h = torch.tensor(
        [[2 * (c % 12) / 11 - 1, 2 * (c // 12 % 9) / 8 - 1] for c in code.tolist()], dtype=torch.float64
    )
    h = h @ network.layers[0].weight.T
    assert torch.allclose(network.norms[0].running_mean, 0.1 * h.mean(0), atol=1e-14)
    assert torch.allclose(network.norms[0].running_var, 0.9 + 0.1 * h.var(0), atol=1e-14)


@pytest.mark.parametrize("form", ["forward", "plain"])
def test_a_frozen_network_keeps_its_running_statistics_in_train_mode(form):
    network = make_network().requires_grad_(False).train()
    before = copy.deepcopy(network.state_dict())
    getattr(network, form)(make_batch(0))
    assert all(torch.equal(before[name], value) for name, value in network.state_dict().items())


def test_the_feature_of_a_cell_is_what_a_window_of_it_shows():
    network = make_network("bytestream_xy").eval()
    features = network.cell_features()
    code = np.arange(108, dtype=np.int32)
    assert torch.allclose(network(EventBatch(GRID, code, code * 0, np.arange(109))), features, atol=1e-14)


def test_a_batch_of_another_grid_is_refused():
    with pytest.raises(ValueError, match="make it with the model's grid"):
        make_network()(make_batch(0, [2], Grid(4, 4, 32)))


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


def test_octaves_tell_places_apart_that_coordinates_alone_confuse():
    """A network of one size learns which columns of pixels are even, by octaves better than by x and y."""

    def error(octaves):
        torch.manual_seed(0)
        network = EventContextNetwork(Grid(16, 2, 4), "bytestream_xy", 8, "none", "none", 1, octaves)
        even = torch.from_numpy((np.arange(32) % 16 % 2).astype(np.float32))
        optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
        for _ in range(150):
            loss = (network.cell_features()[:, 0] - even).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        return float(loss)

    assert error(4) < 0.1 * error(0)


def test_a_single_pixel_sensor_is_at_the_origin():
    grid = Grid(1, 1, 4)
    network = EventContextNetwork(grid, "bytestream", 8, "none")
    batch = make_batch(0, [5], grid)
    assert torch.allclose(network(batch), network.plain(batch), atol=1e-6)
