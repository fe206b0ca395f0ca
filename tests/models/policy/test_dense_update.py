import copy
import math

import numpy as np
import pytest
import torch

from models.policy.dense_update import Rows, Settings, update_dense
from models.policy.networks import mlp
from tests.support.ppo_steps import by_tensors, flat

PLAIN = Settings(
    minibatch_size=16,
    clip_param=0.2,
    vf_loss_coeff=0.5,
    vf_clip_param=math.inf,
    entropy_coeff=0.0,
    grad_clip=math.inf,
    lr=1e-3,
    beta1=0.9,
    beta2=0.999,
    eps=1e-8,
)
INPUTS, ACTIONS, COUNT = 6, 3, 40


def make(hidden=(16, 16), privileged=2):
    """Two networks, Adam, rows whose ratios lie within and beyond the clip, and the orders of two epochs."""
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    networks = [mlp(INPUTS, hidden, ACTIONS), mlp(INPUTS + privileged, hidden, 1)]
    optimizer = torch.optim.Adam([value for one in networks for value in one.parameters()], fused=True)
    stacks, logps, advantages, targets = (
        rng.normal(size=shape).astype("f4") for shape in ((COUNT, INPUTS), COUNT, COUNT, COUNT)
    )
    actions, told = rng.integers(0, ACTIONS, COUNT), rng.normal(size=(COUNT, privileged)).astype("f4")
    rows = Rows(stacks, told, actions, 0.3 * logps - 1.1, advantages, 3.0 * targets)
    return networks, optimizer, rows, np.stack([rng.permutation(COUNT) for _ in range(2)])


def in_torch(networks):
    """The same networks in double precision, and an Adam of their own."""
    exact = [copy.deepcopy(one).double() for one in networks]
    return exact, torch.optim.Adam([value for one in exact for value in one.parameters()])


@pytest.mark.parametrize(
    ("hidden", "privileged", "changes"),
    [
        ((16, 16), 2, {}),
        ((), 0, {}),
        ((5,), 2, {"entropy_coeff": 0.1}),
        ((16, 7, 32), 0, {"grad_clip": 0.01}),
        ((16, 16), 2, {"vf_clip_param": 0.5, "clip_param": 0.05}),
    ],
)
def test_weights_moments_and_figures_are_those_of_torch_in_double_precision(hidden, privileged, changes):
    networks, optimizer, rows, orders = make(hidden, privileged)
    settings = PLAIN._replace(**changes)
    exact, adam = in_torch(networks)
    before = flat(networks)
    places = [value.data_ptr() for one in networks for value in one.parameters()]
    for part in orders[:1], orders[1:]:  # the second goes on with Adam's state
        found = update_dense(networks, optimizer, rows, part, settings)
        expected = by_tensors(exact, adam, rows, part, settings)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    moved = (flat(exact) - before).abs().max()
    assert (flat(networks) - flat(exact)).abs().max() < 2e-3 * moved
    assert [value.data_ptr() for one in networks for value in one.parameters()] == places
    for value, other in zip(optimizer.param_groups[0]["params"], adam.param_groups[0]["params"], strict=True):
        one, two = optimizer.state[value], adam.state[other]
        assert float(one["step"]) == float(two["step"]) == 6.0
        for name in ("exp_avg", "exp_avg_sq"):
            scale = float(two[name].abs().max())
            torch.testing.assert_close(one[name].double(), two[name], rtol=0.0, atol=1e-4 * scale)


def test_one_gradient_is_exact_to_rounding():
    networks, optimizer, rows, orders = make()
    exact, adam = in_torch(networks)
    settings = PLAIN._replace(minibatch_size=COUNT)
    update_dense(networks, optimizer, rows, orders[:1], settings)
    by_tensors(exact, adam, rows, orders[:1], settings)
    found, expected = (
        torch.cat([state["exp_avg"].flatten().double() for state in one.state.values()])
        for one in (optimizer, adam)
    )
    assert (found - expected).norm() < 1e-6 * expected.norm()


@pytest.mark.parametrize(
    ("name", "value"), [("stacks", math.inf), ("privileged", math.nan), ("logps", math.nan)]
)
def test_a_number_that_is_not_finite_stops_before_the_step_that_meets_it(name, value):
    networks, optimizer, rows, orders = make()
    getattr(rows, name)[orders[0][20]] = value  # in the second minibatch
    exact, adam = in_torch(networks)
    by_tensors(exact, adam, rows, orders[:1, :16], PLAIN)
    with pytest.raises(RuntimeError, match="non-finite norm after 1 steps"):
        update_dense(networks, optimizer, rows, orders, PLAIN)
    torch.testing.assert_close(flat(networks), flat(exact), rtol=1e-4, atol=1e-6)
