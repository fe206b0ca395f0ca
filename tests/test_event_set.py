import numpy as np
import pytest
import torch

from models.event_set import EVENTS, TIMES, EventSet, thinned


def addresses(count, seed=0, width=40, height=30):
    rng = np.random.default_rng(seed)
    code = rng.integers(0, 2 * width * height, count)
    return np.stack([code, np.sort(rng.integers(0, TIMES, count))]).astype(np.int32)


def network(stack=3):
    torch.manual_seed(0)
    return EventSet(stack, (40, 30))


def rows_of(*windows):
    """One stack (1, stack, EVENTS, 4) of windows given as addresses."""
    return torch.from_numpy(np.stack([thinned(window, 40, 30) for window in windows]))[None]


@pytest.mark.parametrize("count", [0, 1, EVENTS - 1, EVENTS, EVENTS + 1, 5000])
def test_the_events_that_are_kept_are_events_of_the_window_in_order(count):
    address = addresses(count)
    rows = thinned(address, 40, 30)
    kept = rows[rows[:, 0] > 0]
    assert len(kept) == min(count, EVENTS)
    assert not rows[len(kept) :].any()
    code = (kept[:, 0] == 1) * 1200 + kept[:, 3].astype(int) * 40 + kept[:, 2]
    pairs = list(zip(code.tolist(), kept[:, 1].tolist(), strict=True))
    places = [address.T.tolist().index(list(pair)) for pair in pairs]
    assert places == sorted(places)
    if count > EVENTS:
        gaps = np.diff([-1, *places, count])
        assert gaps[1:-1].max() <= count / EVENTS + 1  # evenly: none of the window is left out
        assert max(gaps[0], gaps[-1]) <= count / (2 * EVENTS) + 1.5


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
