import math

import numpy as np
import pytest
import torch

from models.encoder.event_batch import EventBatch, Grid, event_rows, thin
from models.policy.event_set import EVENTS, TIMES, EventSet, EventTables


def addresses(count, seed=0, width=40, height=30):
    rng = np.random.default_rng(seed)
    code = rng.integers(0, 2 * width * height, count)
    return np.stack([code, np.sort(rng.integers(0, TIMES, count))]).astype(np.int32)


def network(stack=3):
    torch.manual_seed(0)
    return EventSet(stack, (40, 30))


def rows_of(*windows):
    """One stack (1, stack, EVENTS, 4) of windows given as addresses."""
    offsets = np.cumsum([0, *(window.shape[1] for window in windows)])
    batch = EventBatch(Grid(40, 30, TIMES), *np.concatenate(windows, axis=1), offsets)
    return torch.from_numpy(event_rows(thin(batch, EVENTS), EVENTS))[None]


def stacks_of_any_sizes():
    """Three stacks of windows of no event to more than a window keeps; one event is there many times."""
    windows = [addresses(count, seed) for seed, count in enumerate((500, 0, 256, 1, 30, 0))]
    windows[4] = windows[4][:, [0] * 20 + [3] * 10]
    none = addresses(0)
    return torch.cat([rows_of(*windows[:3]), rows_of(*windows[3:]), rows_of(none, none, none)])


def oracle(net, stacks):
    """The network row by row, written down a second time."""
    kind, time = stacks[..., :1], stacks[..., 1:2].to(net.gate[0].weight) / TIMES
    place = [stacks[..., axis + 2].to(time) * 2.0 / (side - 1) - 1.0 for axis, side in enumerate((40, 30))]
    phases = torch.stack(
        [math.pi * 2.0 ** (octave - 1) * along for along in place for octave in range(5)], -1
    )
    on = (kind == 1).to(time) - (kind == 2).to(time)
    there = (kind != 0).to(time)
    inputs = torch.cat([torch.stack(place, -1), on, phases.sin(), phases.cos()], dim=-1)
    features = net.place(inputs) * net.gate(time) * there
    number = there.sum(-2)
    mean = features.sum(-2) / number.clamp_min(1.0)
    return net.join(torch.cat([features.amax(-2), mean, number / EVENTS], dim=-1).flatten(1))


def outcome(net, read, stacks):
    """Outputs and gradients of all parameters."""
    net.zero_grad()
    found = read(stacks)
    direction = torch.from_numpy(np.random.default_rng(5).standard_normal(found.shape)).to(found)
    (found * direction).sum().backward()
    return [found.detach(), *(value.grad.clone() for value in net.parameters())]


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
@pytest.mark.parametrize("stacks", [stacks_of_any_sizes(), stacks_of_any_sizes()[2:]], ids=["any", "empty"])
def test_the_fused_and_the_plain_form_are_the_formula_in_any_order_whatever_empty_rows_hold(
    stacks, dtype, bound
):
    net = network().to(dtype)
    mixed = stacks[:, :, torch.randperm(EVENTS, generator=torch.Generator().manual_seed(0))]
    mixed[..., 1:] = torch.where(mixed[..., :1] == 0, torch.tensor(9, dtype=torch.int16), mixed[..., 1:])
    expected = outcome(net, lambda stacks: oracle(net, stacks), stacks)
    for read in (net.forward, net.plain):
        for found, wanted in zip(outcome(net, read, mixed), expected, strict=True):
            assert (found - wanted).abs().max() <= bound * wanted.abs().max().clamp_min(1e-30)


def test_tables_give_the_features_of_the_network_and_the_same_bytes_in_any_batch():
    net, stacks = network(), stacks_of_any_sizes()
    tables = EventTables(net)
    with torch.no_grad():
        expected = net.plain(stacks).numpy()
        net.join[0].weight.add_(1.0)  # what the network learns later does not reach them
    found = tables(stacks.numpy())
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)
    for first, last in ((0, 1), (1, 3), (2, 2)):
        assert np.array_equal(tables(stacks[first:last].numpy()), found[first:last])


@pytest.mark.parametrize("row", [(1, 0, 40, 0), (1, 0, 0, 30), (2, TIMES, 0, 0), (3, 0, 0, 0), (1, 0, -1, 0)])
def test_a_row_that_is_no_event_of_the_sensor_is_refused(row):
    stacks = rows_of(addresses(5), addresses(5), addresses(5))
    stacks[0, 1, 2] = torch.tensor(row, dtype=torch.int16)
    with pytest.raises(ValueError, match=f"row 258 of events has kind={row[0]}, time={row[1]}, x={row[2]}"):
        network()(stacks)
    with pytest.raises(ValueError, match="row 258 of events has"):
        EventTables(network())(stacks.numpy())
