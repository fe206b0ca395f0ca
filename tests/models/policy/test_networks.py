import dataclasses
import math

import gymnasium
import numpy as np
import pytest
import torch
from torch import nn

from models.kinds import MIN_IMAGE, EncoderModel, FixedModel, PolicySpec
from models.policy.networks import PARTS, Network, assemble, build_networks, is_mlp, mlp, network_of

ENCODER = EncoderModel("bytestream", 64, 8, "batch", "signed", 32, "additive", "frozen", 3, [64, 64])
MLP = PolicySpec(ENCODER, 64, 64, 3)
CNN = PolicySpec(FixedModel("event_image", 3), 64, 64, 3)


def layers(network):
    return [part for part in network.modules() if isinstance(part, nn.Linear | nn.Conv2d)]


@pytest.mark.parametrize("spec", [MLP, CNN], ids=["mlp", "cnn"])
def test_layers_are_orthogonal_with_the_gain_of_their_place(spec):
    networks = build_networks(spec, seed=7)
    for name, last_gain in (("trunk", math.sqrt(2.0)), ("pi", 0.01), ("vf", 1.0)):
        for layer in layers(networks[name]):
            weight = layer.weight.detach().double().flatten(1)
            gram = weight @ weight.T if weight.shape[0] <= weight.shape[1] else weight.T @ weight
            gain = last_gain if layer is layers(networks[name])[-1] else math.sqrt(2.0)
            torch.testing.assert_close(gram, gain**2 * torch.eye(len(gram)).double(), atol=1e-4, rtol=0)
            assert not layer.bias.any()


def test_the_weights_follow_from_the_seed_and_two_mlps_share_nothing():
    first, again, other = (build_networks(MLP, seed).state_dict() for seed in (7, 7, 8))
    assert {name.split(".")[0] for name in first} == {"pi", "vf"}
    for name, value in first.items():
        assert torch.equal(value, again[name])
        assert torch.equal(value, other[name]) is name.endswith("bias")
    assert not torch.equal(first["pi.0.weight"], first["vf.0.weight"])


@pytest.mark.parametrize("hidden", [[], [7, 5, 3]])
def test_logits_without_torch_are_those_of_the_networks_in_any_batch(hidden):
    spec = dataclasses.replace(MLP, model=dataclasses.replace(ENCODER, hidden=hidden))
    networks = build_networks(spec, seed=7)
    networks["pi"][-1].weight.data.mul_(100.0)  # so that logits differ
    trunk, pi = networks["trunk"], networks["pi"]
    stacks = (3.0 * np.random.default_rng(0).normal(size=(9, 3, 8))).astype(np.float32)
    run = network_of(spec).run(trunk, pi)

    def read(stacks):
        return run(stacks, np.zeros((len(stacks), 0)))[0]

    logits = read(stacks)
    with torch.no_grad():
        expected = pi(trunk(torch.from_numpy(stacks))).numpy()
    np.testing.assert_allclose(logits, expected, rtol=1e-5, atol=1e-5)
    assert (logits.dtype, logits.shape) == (np.float32, (9, 3))
    for first, last in ((0, 1), (2, 5), (8, 9)):
        assert np.array_equal(read(stacks[first:last]), logits[first:last])
    assert read(stacks[:0]).shape == (0, 3)
    assert np.isnan(read(np.full_like(stacks, np.nan))).all()


def test_the_cnn_is_that_of_stable_baselines():
    from stable_baselines3.common.policies import ActorCriticCnnPolicy

    spaces = gymnasium.spaces.Box(0, 255, (3, 64, 64), np.uint8), gymnasium.spaces.Discrete(3)
    torch.manual_seed(0)
    theirs = ActorCriticCnnPolicy(*spaces, lambda progress: 3e-4)
    theirs.action_net.weight.data.mul_(100.0)  # so that logits differ
    ours = assemble(CNN)
    copied = zip(
        (layer for name in PARTS for layer in layers(ours[name])),
        (*layers(theirs.features_extractor), theirs.action_net, theirs.value_net),
        strict=True,
    )
    for layer, source in copied:
        layer.load_state_dict(source.state_dict())
    pictures = torch.randint(0, 256, (5, 3, 64, 64), dtype=torch.uint8)
    with torch.no_grad():
        embeddings = ours["trunk"](pictures)
        expected = theirs.get_distribution(pictures).distribution.logits
        logits = torch.log_softmax(ours["pi"](embeddings), dim=1)
        torch.testing.assert_close(logits, expected, atol=1e-6, rtol=1e-5)
        torch.testing.assert_close(
            ours["vf"](embeddings), theirs.predict_values(pictures), atol=1e-6, rtol=1e-5
        )


def test_the_smallest_picture_is_the_smallest():
    smallest = dataclasses.replace(CNN, width=MIN_IMAGE, height=MIN_IMAGE)
    pictures = torch.zeros(1, 3, MIN_IMAGE, MIN_IMAGE, dtype=torch.uint8)
    assert build_networks(smallest)["trunk"](pictures).shape == (1, 512)
    with pytest.raises(RuntimeError):
        assemble(smallest)["trunk"](pictures[..., 1:])


OTHERS = {
    "another function": lambda: nn.Sequential(nn.Linear(6, 5), nn.ReLU(), nn.Linear(5, 3)),
    "no bias": lambda: nn.Sequential(nn.Linear(6, 3, bias=False)),
    "a function at the end": lambda: nn.Sequential(nn.Linear(6, 3), nn.Tanh()),
    "no sequence": lambda: nn.Linear(6, 3),
    "two layers with nothing between": lambda: nn.Sequential(nn.Linear(6, 5), nn.Linear(5, 3)),
}


@pytest.mark.parametrize("what", OTHERS)
def test_only_what_mlp_builds_may_be_compiled_and_all_else_is_run_by_torch(what, monkeypatch):
    torch.manual_seed(0)
    network, stacks = OTHERS[what](), np.random.default_rng(0).normal(size=(4, 2, 3)).astype(np.float32)
    assert [is_mlp(one) for one in (network, mlp(6, (), 3), mlp(6, (4, 4), 3))] == [False, True, True]
    row = Network(lambda shape, spec: (nn.Flatten(), network, mlp(6, (), 1)))
    with torch.no_grad():
        expected = network(torch.from_numpy(stacks).flatten(1)).numpy()
    logits, _ = row.run(nn.Flatten(), network)(stacks, np.zeros((4, 0)))
    assert np.array_equal(logits, expected)
    monkeypatch.setattr("models.policy.networks.resolve", lambda name: row._replace(gradients="compiled"))
    with pytest.raises(ValueError, match="have compiled gradients"):
        assemble(MLP)
