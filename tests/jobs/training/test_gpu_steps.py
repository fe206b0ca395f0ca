"""Steps on a device are those on the processor; on a GPU, where one is there, replays of a recorded one."""

import copy
import math

import pytest
import torch

from jobs.config.config import ConfigError
from jobs.run.device import LEARNER_DEVICE
from jobs.training import ppo_learner, train
from jobs.training.env_runner import PlainEnvRunner
from jobs.training.gpu_steps import GpuSteps
from jobs.training.ppo import build_ppo
from jobs.training.ppo_learner import PlainPPOLearner
from tests.support.configs import SHORT, make_config

MODULE = "default_policy"
CUDA = pytest.param(
    "cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no GPU here")
)


@pytest.fixture(scope="module")
def ppo():
    return build_ppo(make_config(*SHORT, "model=event_image", "algo.entropy_coeff=0.03"))


@pytest.fixture(scope="module")
def flights(ppo):
    runner = PlainEnvRunner(config=ppo, worker_index=0)
    samples = [runner.sample(num_timesteps=64) for _ in range(3)]
    yield runner.env, samples
    runner.stop()


def make_learner(ppo, env, monkeypatch, device, **training):
    monkeypatch.setattr(ppo_learner, "learner_device", lambda: device)
    made = ppo.copy(copy_frozen=False).training(learner_class=PlainPPOLearner, **training)
    return made.build_learner(env=env)


def on_the_way(learner, device):
    """What takes its steps on a device, also on the processor, which a learner does without."""
    optimizer = learner.get_optimizer(MODULE)
    return GpuSteps(learner.module[MODULE].unwrapped(), optimizer.param_groups[0], learner._loss, device)


def weights(learner):
    return {name: value.clone() for name, value in learner.module[MODULE].state_dict().items()}


def reduced(result):
    return {
        name: float(value.peek() if hasattr(value, "peek") else value)
        for name, value in result[MODULE].items()
        if name in ppo_learner.FIGURES or name == "vf_explained_var"
    }


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_steps_on_a_device_are_those_of_the_processor(ppo, flights, monkeypatch, device):
    """Minibatches of which the last is not whole, rows that grow in number, and a restored optimiser."""
    env, samples = flights
    plain = make_learner(ppo, env, monkeypatch, "cpu")
    other = make_learner(ppo, env, monkeypatch, "cpu")
    other.set_state(plain.get_state())
    other._gpu = on_the_way(other, device)
    assert plain._gpu is None
    first = weights(plain)
    for k, episodes in enumerate(samples):
        told = []
        for learner in (plain, other):
            torch.manual_seed(k)
            flown = copy.deepcopy(episodes if k else episodes[:1])
            told.append(reduced(learner.update(episodes=flown, num_epochs=2, minibatch_size=12)))
        assert told[1] == pytest.approx(told[0], rel=1e-3, abs=1e-5)
        again = make_learner(ppo, env, monkeypatch, "cpu")
        again.set_state(other.get_state())
        again._gpu = on_the_way(again, device)
        other = again
    found, expected = weights(other), weights(plain)
    for name, value in expected.items():
        moved, apart = (float((value - one[name]).norm()) for one in (first, found))
        assert moved > 1e-4, name
        assert apart < 0.02 * moved, name
    steps = [
        {float(state["step"]) for state in learner.get_optimizer(MODULE).state_dict()["state"].values()}
        for learner in (plain, other)
    ]
    assert steps[0] == steps[1]
    assert len(steps[0]) == 1


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_another_step_size_and_another_entropy_are_taken_from_then_on(ppo, flights, monkeypatch, device):
    env, (episodes, *_) = flights
    still = make_learner(ppo, env, monkeypatch, "cpu", lr=0.0)
    still._gpu = on_the_way(still, device)
    first = weights(still)
    still.update(episodes=copy.deepcopy(episodes), num_epochs=1, minibatch_size=16)
    assert all(torch.equal(first[name], value) for name, value in weights(still).items())
    still.get_optimizer(MODULE).param_groups[0]["lr"] = 1e-3
    still.update(episodes=copy.deepcopy(episodes), num_epochs=1, minibatch_size=16)
    moved = weights(still)
    assert any(not torch.equal(first[name], value) for name, value in moved.items())
    found = []
    for coefficient in (0.0, 3.0):
        learner = make_learner(ppo, env, monkeypatch, "cpu", entropy_coeff=coefficient)
        learner._gpu = on_the_way(learner, device)
        told = reduced(learner.update(episodes=copy.deepcopy(episodes), num_epochs=1, minibatch_size=16))
        found.append(
            told["total_loss"] - told["policy_loss"] - 0.5 * told["vf_loss"] + coefficient * told["entropy"]
        )
    assert found == pytest.approx([0.0, 0.0], abs=1e-3)


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_a_gradient_that_is_not_finite_leaves_everything_as_it_was(ppo, flights, monkeypatch, device):
    env, (episodes, *_) = flights
    learner = make_learner(ppo, env, monkeypatch, "cpu")
    learner._gpu = on_the_way(learner, device)
    learner.update(episodes=copy.deepcopy(episodes), num_epochs=1, minibatch_size=16)
    first, state = weights(learner), copy.deepcopy(learner.get_optimizer(MODULE).state_dict())
    broken = copy.deepcopy(episodes)
    for episode in broken:
        episode.set_rewards(new_data=math.inf * abs(episode.get_rewards()))
    with pytest.raises(RuntimeError, match="gradients must be finite"):
        learner.update(episodes=broken, num_epochs=1, minibatch_size=16)
    assert all(torch.equal(first[name], value) for name, value in weights(learner).items())
    for name, one in learner.get_optimizer(MODULE).state_dict()["state"].items():
        assert all(torch.equal(value, state["state"][name][key]) for key, value in one.items())


@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no GPU here")
def test_a_gpu_gives_the_same_digits_again(ppo, flights, monkeypatch):
    env, samples = flights
    found = []
    for _ in range(2):
        learner = make_learner(ppo, env, monkeypatch, "cuda")
        assert learner._gpu is not None
        for k, episodes in enumerate(samples):
            torch.manual_seed(k)
            learner.update(episodes=copy.deepcopy(episodes), num_epochs=2, minibatch_size=12)
        found.append(weights(learner))
    assert all(torch.equal(value, found[1][name]) for name, value in found[0].items())


def test_dense_networks_stay_with_the_processor(flights, monkeypatch):
    env, _ = flights
    dense = build_ppo(make_config(*SHORT, "model=event_columns"))
    assert make_learner(dense, env, monkeypatch, "cuda")._gpu is None


def test_a_gpu_that_is_not_there_is_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match=r"cluster\.device"):
        train.check_device(make_config("cluster.device=cuda"))
    train.check_device(make_config())
    with pytest.raises(ConfigError, match="device"):
        make_config("cluster=ray", "cluster.device=cuda")


def test_a_process_computes_where_its_job_says(monkeypatch):
    from jobs.run.device import device_variables, learner_device

    monkeypatch.delenv(LEARNER_DEVICE, raising=False)
    assert learner_device() == "cpu"
    for name, value in device_variables("cuda").items():
        monkeypatch.setenv(name, value)
    assert learner_device() == "cuda"
