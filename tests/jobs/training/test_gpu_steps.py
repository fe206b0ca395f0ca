"""Steps on a device are those on the processor; on a GPU, where one is there, replays of a recorded one."""

import copy
import math

import pytest
import ray
import torch

from jobs.config.config import ConfigError
from jobs.run import ray_cluster
from jobs.run.device import LEARNER_DEVICE, learner_device
from jobs.training.algorithms import build_algorithm
from jobs.training.inputs import check_inputs
from jobs.training.ppo import gpu_steps
from jobs.training.ppo import learner as ppo_learner
from jobs.training.ppo.gpu_steps import GpuSteps
from jobs.training.ppo.learner import VALUE_WARMUP, PlainPPOLearner
from jobs.training.sampling.env_runner import PlainEnvRunner
from models.policy.event_set import EventSet
from tests.support.configs import SHORT, make_config
from tests.support.learners import MODULE, learn, moved, weights

pytestmark = pytest.mark.system  # they build RLlib's algorithm many times

ON_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no GPU here")
on_devices = pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=ON_GPU)])


@pytest.fixture(scope="module", params=["event_image", "event_set"])
def ppo(request):
    return build_algorithm(make_config(*SHORT, f"model={request.param}", "algo.entropy_coeff=0.03"))


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


def steps_on(learner, device):
    """What takes the steps of a learner on a device; on the processor, too, where a learner has none."""
    module = learner.module[MODULE].unwrapped()
    return GpuSteps(module, learner.get_optimizer(MODULE), learner._loss, device)


def pair(ppo, env, monkeypatch, device, **training):
    """Two learners with the same weights; the second takes its steps on a device."""
    plain, other = (make_learner(ppo, env, monkeypatch, "cpu", **training) for _ in range(2))
    other.set_state(plain.get_state())
    other._gpu = steps_on(other, device)
    assert plain._gpu is None
    return plain, other


@on_devices
def test_steps_on_a_device_are_those_of_the_processor(ppo, flights, monkeypatch, device):
    """Rows that grow, and shrink below a minibatch; a minibatch that is not whole; a restored optimiser."""
    env, samples = flights
    monkeypatch.setattr(gpu_steps, "ROOM", 8)
    plain, other = pair(ppo, env, monkeypatch, device)
    first = weights(plain)
    taken = samples[0], samples[1] + samples[2], samples[2][:1], samples[1]
    assert len({sum(map(len, episodes)) for episodes in taken}) > 2
    for k, episodes in enumerate(taken):
        told = []
        for learner in (plain, other):
            torch.manual_seed(k)
            figures = learn(learner, episodes, num_epochs=2, minibatch_size=12)
            told.append([figures[name] for name in (*ppo_learner.FIGURES, "vf_explained_var")])
        assert told[1] == pytest.approx(told[0], rel=1e-3, abs=1e-5)
        if k == 2:
            other.set_state(copy.deepcopy(plain.get_state()))
    assert_moved_alike(first, weights(plain), weights(other))
    steps = [
        {float(state["step"]) for state in learner.get_optimizer(MODULE).state_dict()["state"].values()}
        for learner in (plain, other)
    ]
    assert steps[0] == steps[1]
    assert len(steps[0]) == 1


def assert_moved_alike(first, expected, found):
    """Single weights may differ: Adam moves one by a whole step whose gradient is all but zero."""
    for name, value in expected.items():
        far, apart = (float((value - one[name]).norm()) for one in (first, found))
        assert far > 1e-4, name
        assert apart < 0.02 * far, name


@on_devices
def test_a_value_network_that_learns_alone_at_first_is_followed_by_the_policy(
    ppo, flights, monkeypatch, device
):
    env, (episodes, *_) = flights
    settings = {**ppo.learner_config_dict, VALUE_WARMUP: 100}
    plain, other = pair(ppo, env, monkeypatch, device, learner_config_dict=settings)
    for sampled in (64, 200):
        first = weights(plain)
        for learner in (plain, other):
            torch.manual_seed(sampled)
            learn(learner, episodes, sampled, num_epochs=2, minibatch_size=16)
        learning = {name for name in first if sampled == 200 or name.startswith("vf.")}
        assert moved(first, other) == learning
        apart = [float((value - weights(other)[name]).abs().max()) for name, value in weights(plain).items()]
        assert max(apart) < 1e-3


@on_devices
def test_another_step_size_and_another_entropy_are_taken_from_then_on(ppo, flights, monkeypatch, device):
    env, (episodes, *_) = flights
    learner = make_learner(ppo, env, monkeypatch, "cpu", lr=0.0)
    learner._gpu = steps_on(learner, device)
    first = weights(learner)
    learn(learner, episodes, minibatch_size=16)
    assert not moved(first, learner)
    learner.get_optimizer(MODULE).param_groups[0]["lr"] = 1e-3
    learn(learner, episodes, minibatch_size=16)
    assert moved(first, learner)
    for coefficient in (0.0, 3.0):
        monkeypatch.setattr(PlainPPOLearner, "_entropy_coeff", coefficient)
        told = learn(learner, episodes, minibatch_size=16)
        parts = told["policy_loss"] + 0.5 * told["vf_loss"] - coefficient * told["entropy"]
        assert told["total_loss"] == pytest.approx(parts, abs=1e-3)


@on_devices
def test_a_gradient_that_is_not_finite_leaves_everything_as_it_was(ppo, flights, monkeypatch, device):
    env, (episodes, *_) = flights
    learner = make_learner(ppo, env, monkeypatch, "cpu")
    learner._gpu = steps_on(learner, device)
    learn(learner, episodes, minibatch_size=16)
    first, state = weights(learner), copy.deepcopy(learner.get_optimizer(MODULE).state_dict())
    broken = copy.deepcopy(episodes)
    for episode in broken:
        episode.set_rewards(new_data=math.inf * abs(episode.get_rewards()))
    with pytest.raises(RuntimeError, match="gradients must be finite"):
        learn(learner, broken, minibatch_size=16)
    assert not moved(first, learner)
    for name, one in learner.get_optimizer(MODULE).state_dict()["state"].items():
        assert all(torch.equal(value, state["state"][name][key]) for key, value in one.items())


@ON_GPU
def test_a_gpu_gives_the_same_digits_again(ppo, flights, monkeypatch):
    env, samples = flights
    learners = [make_learner(ppo, env, monkeypatch, "cuda") for _ in range(2)]
    for learner in learners:
        assert learner._gpu is not None
        for k, episodes in enumerate(samples):
            torch.manual_seed(k)
            learn(learner, episodes, num_epochs=2, minibatch_size=12)
    assert not moved(weights(learners[0]), learners[1])


def test_networks_over_pictures_and_sets_go_to_the_device_and_dense_ones_stay(ppo, flights, monkeypatch):
    monkeypatch.setattr(ppo_learner, "GpuSteps", lambda *told: told)
    assert make_learner(ppo, flights[0], monkeypatch, "cuda")._gpu[-1] == "cuda"
    dense = build_algorithm(make_config(*SHORT, "model=event_columns"))
    assert make_learner(dense, flights[0], monkeypatch, "cuda")._gpu is None


def test_what_a_gpu_computes_of_sets_makes_no_tensor_of_numbers(monkeypatch):
    """It would be copied from the processor, which cannot be recorded."""

    def refuse(*_, **__):
        raise AssertionError("a tensor of Python numbers")

    net, rows = EventSet(2, (16, 16)), torch.zeros((1, 2, 256, 4), dtype=torch.int16)
    for place, name in ((torch, "tensor"), (torch, "as_tensor"), (torch.Tensor, "new_tensor")):
        monkeypatch.setattr(place, name, refuse)
    net.plain(rows).sum().backward()


def test_a_gpu_that_is_not_there_is_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match=r"cluster\.device"):
        check_inputs(make_config("cluster.device=cuda"))
    with pytest.raises(ConfigError, match="device"):
        make_config("cluster=ray", "cluster.device=cuda")


def test_a_process_computes_where_its_job_says(tmp_path, monkeypatch):
    monkeypatch.delenv(LEARNER_DEVICE, raising=False)
    assert learner_device() == "cpu"
    asked = {}
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setattr(ray_cluster, "compile_kernels", lambda: None)
    monkeypatch.setattr(ray_cluster, "_start_local", asked.update)
    monkeypatch.setattr(ray_cluster, "ray_folder", lambda: tmp_path)
    ray_cluster.start_ray(make_config("cluster.device=cuda").cluster, tmp_path)
    for name, value in asked["runtime_env"]["env_vars"].items():
        monkeypatch.setenv(name, value)
    assert learner_device() == "cuda"
