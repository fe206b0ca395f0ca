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
def test_the_fused_and_the_plain_form_are_the_formula(dtype, bound):
    net = network().to(dtype)
    windows = [addresses(count, seed) for seed, count in enumerate((500, 0, 256, 1, 30, 0))]
    windows[4] = windows[4][:, [0] * 20 + [3] * 10]  # the same event many times
    stacks = torch.cat([rows_of(*windows[:3]), rows_of(*windows[3:])])
    expected = outcome(net, lambda stacks: oracle(net, stacks), stacks)
    for read in (net.forward, net.plain):
        for found, wanted in zip(outcome(net, read, stacks), expected, strict=True):
            assert (found - wanted).abs().max() <= bound * wanted.abs().max().clamp_min(1e-30)


def test_tables_give_the_features_of_the_network_and_the_same_bytes_in_any_batch():
    net = network()
    windows = [addresses(count, seed) for seed, count in enumerate((500, 0, 256, 1, 30, 0))]
    stacks = torch.cat([rows_of(*windows[:3]), rows_of(*windows[3:]), rows_of(*windows[1:4])])
    tables = EventTables(net)
    with torch.no_grad():
        expected = net.plain(stacks).numpy()
        net.join[0].weight.add_(1.0)  # what the network learns later does not reach them
    found = tables(stacks.numpy())
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)
    for first, last in ((0, 1), (1, 3), (2, 2)):
        assert np.array_equal(tables(stacks[first:last].numpy()), found[first:last])
    stacks[0, 1, 2] = torch.tensor((1, 0, 40, 0))
    with pytest.raises(ValueError, match="row 258 of events has kind=1"):
        tables(stacks.numpy())


@pytest.mark.parametrize("row", [(1, 0, 40, 0), (1, 0, 0, 30), (2, TIMES, 0, 0), (3, 0, 0, 0), (1, 0, -1, 0)])
def test_a_row_that_is_no_event_of_the_sensor_is_refused(row):
    stacks = rows_of(addresses(5), addresses(5), addresses(5))
    stacks[0, 1, 2] = torch.tensor(row, dtype=torch.int16)
    with pytest.raises(ValueError, match=f"row 258 of events has kind={row[0]}, time={row[1]}, x={row[2]}"):
        network()(stacks)


def test_the_order_of_rows_does_not_matter_and_empty_rows_say_nothing():
    stacks = rows_of(addresses(100), addresses(0), addresses(3, seed=1))
    shuffled = stacks[:, :, torch.randperm(EVENTS)]
    junk = stacks.clone()
    junk[..., 1:] = torch.where(junk[..., :1] == 0, torch.tensor(9, dtype=torch.int16), junk[..., 1:])
    found = network()(stacks)
    torch.testing.assert_close(network()(shuffled), found, atol=1e-5, rtol=1e-5)
    assert torch.equal(network()(junk), found)


def test_place_time_polarity_number_and_the_window_of_an_event_all_matter():
    one = np.array([[1200 + 5 * 40 + 7], [300]], np.int32)
    base = network()(rows_of(one, one, one))
    others = {"x": [[1200 + 5 * 40 + 8], [300]], "y": [[1200 + 6 * 40 + 7], [300]]}
    others |= {"polarity": [[5 * 40 + 7], [300]], "time": [[1200 + 5 * 40 + 7], [900]]}
    others |= {"number": [[1200 + 5 * 40 + 7] * 2, [300] * 2]}
    for name, other in others.items():
        changed = network()(rows_of(one, one, np.array(other, np.int32)))
        assert not torch.equal(changed, base), name
        earlier = network()(rows_of(np.array(other, np.int32), one, one))
        assert not torch.equal(changed, earlier), name


def test_gradients_of_empty_windows_are_finite():
    net = network()
    net(rows_of(addresses(0), addresses(0), addresses(0))).square().sum().backward()
    assert all(torch.isfinite(value.grad).all() for value in net.parameters())
