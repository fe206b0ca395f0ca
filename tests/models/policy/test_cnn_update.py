import copy
import math

import numpy as np
import pytest
import torch
from torch import nn

from models.kinds import FixedModel, PolicySpec
from models.policy.cnn_update import update_cnn
from models.policy.dense_update import Rows, Settings
from models.policy.networks import build_networks
from tests.support.ppo_steps import by_tensors, flat

PLAIN = Settings(
    minibatch_size=24,
    clip_param=0.2,
    vf_loss_coeff=0.5,
    vf_clip_param=math.inf,
    entropy_coeff=0.0,
    grad_clip=math.inf,
    lr=1e-4,
    beta1=0.9,
    beta2=0.999,
    eps=1e-8,
)
COUNT = 40


def make(stack=2, width=36, height=36):
    """The networks, Adam, rows whose ratios lie within and beyond the clip, and the orders of two epochs."""
    rng = np.random.default_rng(0)
    networks = [*build_networks(PolicySpec(FixedModel("rgb", stack=stack), width, height)).values()]
    optimizer = torch.optim.Adam(nn.ModuleList(networks).parameters(), fused=True)
    stacks = rng.integers(0, 256, (COUNT, stack, height, width)).astype(np.uint8)
    logps, advantages, targets = (rng.normal(size=COUNT).astype("f4") for _ in range(3))
    rows = Rows(
        stacks,
        np.zeros((COUNT, 0), np.float32),
        rng.integers(0, 3, COUNT),
        0.3 * logps - 1.1,
        advantages,
        3.0 * targets,
    )
    return networks, optimizer, rows, np.stack([rng.permutation(COUNT) for _ in range(2)])


def doubled(networks):
    """The same networks and an Adam in double precision."""
    exact = [copy.deepcopy(one).double() for one in networks]
    exact[0] = exact[0][1:]  # bytes are scaled by `scaled`
    return exact, torch.optim.Adam([value for one in exact for value in one.parameters()])


def step_exactly(networks, optimizer, rows, orders, settings):
    """`update_cnn` by torch in double precision."""
    scaled = rows._replace(stacks=rows.stacks / 255.0)
    trunk, pi, vf = networks
    apart = [lambda stacks: pi(trunk(stacks)), lambda stacks: vf(trunk(stacks))]
    return by_tensors(apart, optimizer, scaled, orders, settings)


@pytest.mark.parametrize(
    ("sizes", "changes"),
    [
        ((3, 64, 64), {}),
        ((2, 36, 36), {"entropy_coeff": 0.1, "minibatch_size": 40}),
        ((1, 61, 47), {"grad_clip": 0.01}),  # tiles reach beyond the edges, and pixels are left over
        ((1, 36, 52), {"vf_clip_param": 0.5, "clip_param": 0.05, "minibatch_size": 13}),
    ],
)
def test_weights_moments_and_figures_are_those_of_torch_in_double_precision(sizes, changes):
    networks, optimizer, rows, orders = make(*sizes)
    settings, (exact, adam), before = PLAIN._replace(**changes), doubled(networks), flat(networks)
    for part in orders[:1], orders[1:]:  # the second goes on with Adam's state
        found = update_cnn(networks, optimizer, rows, part, settings, threads=2)
        expected = step_exactly(exact, adam, rows, part, settings)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    assert (flat(networks) - flat(exact)).norm() < 1e-3 * (flat(exact) - before).norm()
    for value, other in zip(optimizer.param_groups[0]["params"], adam.param_groups[0]["params"], strict=True):
        one, two = optimizer.state[value], adam.state[other]
        assert float(one["step"]) == float(two["step"])
        for name in ("exp_avg", "exp_avg_sq"):
            scale = float(two[name].abs().max())
            torch.testing.assert_close(one[name].double(), two[name], rtol=0.0, atol=1e-3 * scale)


def test_one_gradient_is_exact_to_rounding():
    networks, optimizer, rows, orders = make(3, 64, 64)
    exact, adam = doubled(networks)
    settings = PLAIN._replace(minibatch_size=COUNT)
    update_cnn(networks, optimizer, rows, orders[:1], settings)
    step_exactly(exact, adam, rows, orders[:1], settings)
    pairs = zip(optimizer.param_groups[0]["params"], adam.param_groups[0]["params"], strict=True)
    for value, other in pairs:
        one, two = optimizer.state[value]["exp_avg"].double(), adam.state[other]["exp_avg"]
        assert (one - two).norm() < 2e-6 * two.norm()


@pytest.mark.parametrize("size", [1, 7, 40])
def test_any_number_of_threads_gives_the_same_bytes(size):
    results = []
    for threads in (1, 2, 3):
        networks, optimizer, rows, orders = make()
        settings = PLAIN._replace(minibatch_size=size)
        figures = update_cnn(networks, optimizer, rows, orders[:1], settings, threads)
        results.append((flat(networks).numpy().tobytes(), figures.tobytes()))
    assert results[0] == results[1] == results[2]


def test_tensors_stay_in_place_and_steps_of_no_size_change_nothing():
    networks, optimizer, rows, orders = make()
    places = [value.data_ptr() for one in networks for value in one.parameters()]
    before = flat(networks)
    update_cnn(networks, optimizer, rows, orders[:1], PLAIN._replace(lr=0.0))
    assert torch.equal(flat(networks), before)
    assert [value.data_ptr() for one in networks for value in one.parameters()] == places


@pytest.mark.parametrize("name", ["logps", "advantages", "targets", "weights"])
def test_a_number_that_is_not_finite_stops_before_the_step_that_meets_it(name):
    networks, optimizer, rows, orders = make()
    if name == "weights":
        networks[0][1].weight.data[3, 0, 2, 5] = math.nan
        steps, before = 0, flat(networks)
    else:
        getattr(rows, name)[orders[0][30]] = math.nan  # in the second minibatch
        steps, (exact, adam) = 1, doubled(networks)
        step_exactly(exact, adam, rows, orders[:1, :24], PLAIN)
        before = flat(exact)
    with pytest.raises(RuntimeError, match=f"non-finite norm after {steps} steps"):
        update_cnn(networks, optimizer, rows, orders, PLAIN)
    torch.testing.assert_close(flat(networks), before, rtol=1e-4, atol=1e-5, equal_nan=True)
