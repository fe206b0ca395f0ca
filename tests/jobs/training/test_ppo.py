import functools
import math

import numpy as np
import pytest
import torch
from ray.rllib.algorithms.ppo import PPO
from ray.rllib.core.rl_module.rl_module import RLModule

from envs.events import unpack_window
from jobs.config.config import ConfigError
from jobs.training.algorithms import build_algorithm
from jobs.training.policy import policy_about, policy_spec
from jobs.training.sampling.corridors import TrainingCorridors, corridor_settings
from jobs.training.sampling.env_runner import PlainEnvRunner
from models.encoder.table import EncoderTable
from models.encoder.weights import EncoderFileError, load_encoder
from models.kinds import KINDS
from models.policy import load_policy, save_policy
from models.policy.features import feature_of
from tests.support.configs import SHORT, make_config
from tests.support.episodes import infos_of
from tests.support.policies import kinds

TRAINED = ("bytestream", "event_columns", "event_set", "event_image", "rgb", "finetuned")
CNN_WEIGHTS = 32 * (3 * 64 + 1) + 64 * (32 * 16 + 1) + 64 * (64 * 9 + 1) + 512 * (1024 + 1)
HEADS = 2 * (96 * 64 + 64 + 64 * 64 + 64) + 64 * 4 + 4
CONTEXT_WEIGHTS = 3 * 64 + 64 * 128 + 128 * 256 + 2 * (64 + 128 + 256)
WEIGHTS = {
    "bytestream": HEADS,
    "finetuned": HEADS + CONTEXT_WEIGHTS + 256 * (256 + 1) + 64 * (256 + 1),
    "event_columns": 2 * (384 * 64 + 64 + 64 * 64 + 64) + 64 * 4 + 4,
    "event_set": 64 * (23 + 1 + 64 + 1 + 2) + 128 * (3 * 129 + 1) + 128 * 4 + 4,
    "event_image": CNN_WEIGHTS + 512 * 4 + 4,
    "rgb": CNN_WEIGHTS + 512 * 4 + 4,
}


def make_own(name, *overrides):
    """The configuration of a kind of policy, or of "finetuned": bytestream with an encoder that learns on."""
    words = ("model.encoder=finetuned",) if name == "finetuned" else (f"model={name}",)
    return make_config(*overrides, *words)


def make_ppo(name, encoder, *overrides):
    config = make_own(name, *overrides)
    return build_algorithm(config, encoder if KINDS[config.model.name].encoder else None)


def is_frozen(name):
    return name == "bytestream"


@pytest.fixture(scope="module", params=kinds(TRAINED))
def name(request):
    return request.param


@pytest.fixture(scope="module")
def ppo(name, encoder):
    return make_ppo(name, encoder, *SHORT)


@pytest.fixture
def runner(ppo):
    runner = PlainEnvRunner(config=ppo, worker_index=0)
    yield runner
    runner.stop()


@functools.lru_cache
def encoder_table(encoder):
    return EncoderTable.from_evae(load_encoder(encoder)[0])


def plain_feature(name, observation, encoder):
    """A feature of one observation, written down a second time."""
    if name == "bytestream":
        return encoder_table(encoder).encode_windows(observation[None])[0]
    if name == "event_columns":
        events, _ = unpack_window(observation)
        counts = np.zeros((2, 64))
        np.add.at(counts, ((events["p"] < 0).astype(int), events["x"]), 1)
        return np.log(1 + counts).ravel()
    if name in ("event_set", "finetuned"):
        most = 256 if name == "event_set" else 1024
        events, window_us = unpack_window(observation)
        kept = min(len(events), most)
        events = events[[int((k + 0.5) * len(events) / kept) for k in range(kept)]]
        rows = np.zeros((most, 4), np.int16)
        times = np.minimum(events["t"] * 1024 // window_us, 1023)
        rows[:kept] = np.stack([np.where(events["p"] > 0, 1, 2), times, events["x"], events["y"]], axis=1)
        return rows
    if name == "rgb":
        grey = observation[..., 0].astype(float)
        return np.floor(255 * np.minimum(grey, 1) ** (1 / 2.2) + 0.5)
    return observation[..., 0] if name == "event_image" else observation


class Recorder:
    """Stands between an env runner and its environments; remembers what they showed."""

    def __init__(self, runner):
        self.env, self.flights = runner.env.unwrapped, {}
        self.reset, self.step = self.env.reset, self.env.step
        self.env.reset = lambda **kwargs: self.keep(self.reset(**kwargs))
        self.env.step = lambda actions: self.keep(self.step(actions))

    def keep(self, results):
        observations, infos = results[0], results[-1]
        for row, observation in enumerate(observations):
            flight = infos["episode_seed"][row], infos["episode_number"][row]
            self.flights.setdefault(flight, []).append(observation.copy())
        return results

    def stacks(self, name, encoder):
        """(seed, episode, step) -> the last three features, by a plain loop."""
        found = {}
        for flight, observations in self.flights.items():
            features = [plain_feature(name, observation, encoder) for observation in observations]
            for step in range(len(features)):
                found[(*flight, step)] = np.stack([features[max(0, step - back)] for back in (2, 1, 0)])
        return found


def keys(chunk, control_hz=200.0):
    """(seed, episode, step) of a chunk's observations."""
    infos = infos_of(chunk)
    return [
        (info["episode_seed"], info["episode_number"], round(info["t_us"] * control_hz / 1e6))
        for info in infos
    ]


def learner_batch(learner, samples, monkeypatch, **updates):
    """What the value network is asked about the whole batch, before the first epoch."""
    module, batches = learner.module["default_policy"], []
    compute = module.compute_values
    watch = lambda batch, **kwargs: batches.append(batch) or compute(batch, **kwargs)  # noqa: E731
    monkeypatch.setattr(module, "compute_values", watch)
    learner.update(episodes=samples, **{"num_epochs": 1, "minibatch_size": 32, **updates})
    return batches[0]


def test_the_settings_are_those_of_the_appendix(name, encoder):
    built = make_ppo(name, encoder, "budget=paper")
    built.validate()
    stated = {
        "lr": 3e-4,
        "gamma": 0.99,
        "lambda_": 0.95,
        "clip_param": 0.2,
        "num_epochs": 10,
        "minibatch_size": 32,
        "train_batch_size_per_learner": 2048,
        "vf_loss_coeff": 0.5,
        "grad_clip": 0.5,
        "entropy_coeff": 0.0,
        "vf_clip_param": math.inf,
        "use_kl_loss": False,
        "kl_coeff": 0.0,
        "grad_clip_by": "global_norm",
    }
    spec = built.rl_module_spec
    learner = built.build_learner(spaces={"default_policy": (spec.observation_space, spec.action_space)})
    assert {key: getattr(learner.config, key) for key in stated} == stated
    space = learner.module["default_policy"].observation_space
    spaces = {
        "bytestream": ((3, 32), "f4"),
        "event_columns": ((3, 128), "f4"),
        "event_set": ((3, 256, 4), "i2"),
    }
    spaces["finetuned"] = (3, 1024, 4), "i2"
    spaces |= dict.fromkeys(("event_image", "rgb"), ((3, 64, 64), "u1"))
    assert (space.shape, space.dtype) == spaces[name]


@pytest.mark.parametrize(("runners", "cpus"), [(0, 1), (1, 1), (2, 2)])
def test_a_training_asks_for_a_core_per_process_that_flies_or_one_in_all(encoder, runners, cpus):
    ppo = make_ppo("bytestream", encoder, f"algo.num_env_runners={runners}")
    assert PPO.default_resource_request(ppo).required_resources["CPU"] == pytest.approx(cpus)


def test_the_networks_are_built_from_what_the_configuration_says():
    sizes = {"width": 64, "height": 64, "stack": 3, "num_actions": 3}
    bytestream, image = (
        policy_spec(make_config(f"model={name}")).manifest() for name in ("bytestream_xy", "event_image")
    )
    evae = {"context": 256, "latent": 32, "norm": "batch", "target": "occupancy", "time_bins": 1024}
    evae |= {"coding": "none", "pool_rank": 1, "octaves": 0, "own_actions": False, "own_velocity": False}
    evae |= {"encoder": "frozen"}
    assert bytestream == {"name": "bytestream_xy", "hidden": [64, 64], "memory_ms": [], **evae, **sizes}
    assert image == {"name": "event_image", **sizes}


def test_each_episode_of_a_training_draws_one_of_its_conditions():
    conditions = "train.conditions=[{},{faults.sparsity: 0.5, env.control_hz: 100}]"
    settings = corridor_settings(make_config("model=event_columns", conditions))
    env = TrainingCorridors({**settings, "num_envs": 4})
    seen = set()
    for seed in range(4):
        env.reset(seed=seed)
        seen |= {(one.config.faults.sparsity, one.config.control_hz) for one in env.envs}
    assert seen == {(0.0, 200.0), (0.5, 100.0)}
    assert {one.config.split for one in env.envs} == {"train"}


def test_a_training_without_conditions_has_the_keys_of_those_begun_before_there_were_any():
    assert corridor_settings(make_config("model=event_columns")).keys() == {"config"}


def test_the_feature_of_each_observation_is_made_exactly_once(runner):
    recorder, rows = Recorder(runner), []
    make = runner.module.features
    runner.module.features = lambda observations: rows.append(len(observations)) or make(observations)
    samples = [chunk for _ in range(2) for chunk in runner.sample(num_timesteps=30)]
    steps = sum(len(chunk) for chunk in samples)
    shown = sum(len(observations) for observations in recorder.flights.values())
    assert steps >= 60
    assert sum(rows) == shown == steps + len(recorder.flights)
    assert max(rows) == 2


def test_the_learner_sees_the_features_of_what_was_shown(name, runner, ppo, encoder, monkeypatch):
    recorder = Recorder(runner)
    learner = ppo.build_learner(env=runner.env)
    truncated = cut = 0
    for _ in range(3):
        samples = runner.sample(num_timesteps=31)
        shown = [key for chunk in samples for key in keys(chunk)]
        truncated += sum(chunk.is_truncated for chunk in samples)
        cut += sum(not chunk.is_done for chunk in samples)
        batch = learner_batch(learner, samples, monkeypatch)
        stacks = recorder.stacks(name, encoder)
        assert batch["obs"].numpy().dtype == feature_of(policy_spec(make_own(name))).dtype
        np.testing.assert_allclose(batch["obs"].numpy(), [stacks[key] for key in shown], rtol=1e-6)
    assert truncated >= 6
    assert cut >= 3
    assert len({stack.tobytes() for stack in stacks.values()}) > 30


def test_training_moves_the_networks_and_never_a_frozen_encoder(name, runner, ppo, encoder):
    learner = ppo.build_learner(env=runner.env)
    module = learner.module["default_policy"]
    before = {name: value.clone() for name, value in module.state_dict().items()}
    learner.update(episodes=runner.sample(num_timesteps=64), num_epochs=2, minibatch_size=32)
    runner.set_state({"rl_module": learner.get_state(components="rl_module")["rl_module"]})
    after, flying = module.state_dict(), runner.module.state_dict()
    whole = load_encoder(encoder)[0].state_dict()
    assert any(key.startswith("encoder.") for key in before) is is_frozen(name)
    for key, value in before.items():
        frozen = key.startswith("encoder.")
        statistic = "running_" in key or "num_batches" in key
        assert torch.equal(after[key], value) is (frozen or statistic), key
        if frozen or (name == "finetuned" and key.startswith("trunk.")):
            assert torch.equal(value, whole[key.partition(".")[2]]), key
        if key in flying:
            assert torch.equal(flying[key], after[key]), key
    assert {key for key in before if key not in flying} == {key for key in before if key.startswith("vf.")}
    assert sum(value.numel() for value in module.parameters()) == WEIGHTS[name]
    encoder_parts = (module.encoder if is_frozen(name) else module.trunk).modules()
    assert name not in ("bytestream", "finetuned") or not any(part.training for part in encoder_parts)


def test_the_values_of_a_batch_are_those_of_the_loss(runner, ppo):
    learner = ppo.build_learner(env=runner.env)
    module, samples = learner.module["default_policy"], runner.sample(num_timesteps=300)
    stacks = np.concatenate([chunk.get_observations() for chunk in samples])[:300]
    batch = {"obs": torch.from_numpy(stacks)}
    targets = module.compute_values(batch)
    outputs = module.forward_train(batch)
    values = module.compute_values(batch, embeddings=outputs["embeddings"])
    torch.testing.assert_close(targets, values, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(outputs["action_dist_inputs"], module._forward(batch)["action_dist_inputs"])
    assert (targets.requires_grad, values.requires_grad) == (False, True)
    assert targets.shape == (300,)


def test_a_module_checkpoint_alone_restores_encoder_and_networks(runner, ppo, tmp_path, monkeypatch):
    module = ppo.build_learner(env=runner.env).module["default_policy"]
    module.save_to_path(tmp_path / "module")

    def gone(path):
        raise EncoderFileError("gone")

    monkeypatch.setattr("models.encoder.frozen.load_encoder", gone)
    restored = RLModule.from_checkpoint(tmp_path / "module")
    for name, value in module.state_dict().items():
        assert torch.equal(restored.state_dict()[name], value), name
    observations, _ = runner.env.unwrapped.reset(seed=0)
    np.testing.assert_array_equal(restored.features(observations), runner.module.features(observations))


def test_the_exported_policy_gives_the_logits_of_the_path_through_rllib(name, runner, ppo, encoder, tmp_path):
    module = ppo.build_learner(env=runner.env).module["default_policy"]
    runner.module.pi.load_state_dict(module.pi.state_dict())
    for part in (module.pi, runner.module.pi):
        for value in part.parameters():
            value.data.mul_(20.0)  # so that logits differ
    evae = load_encoder(encoder)[0] if is_frozen(name) else None
    config = make_own(name, *SHORT)
    folder = save_policy(tmp_path, module.networks(), policy_spec(config), policy_about(config), evae)
    policy = load_policy(folder)
    assert policy.observation == runner.env.unwrapped.envs[0].config.observation
    recorder = Recorder(runner)
    samples = [chunk for _ in range(2) for chunk in runner.sample(num_timesteps=40)]
    compared = []
    for chunk in samples:
        for (seed, episode, step), logits in zip(
            keys(chunk), chunk.get_extra_model_outputs("action_dist_inputs"), strict=False
        ):
            policy.reset(1)
            for observation in recorder.flights[seed, episode][: step + 1]:
                own = policy.logits(observation[None])[0]
            np.testing.assert_allclose(own, logits, rtol=1e-5, atol=1e-5)
            compared.append(own)
    assert len(compared) >= 80
    assert np.ptp(compared, axis=0).max() > 1e-3


def test_an_encoder_of_another_sensor_is_refused_with_both_values(encoder):
    with pytest.raises(ConfigError, match=r"another sensor.*contrast_threshold: 0\.2 there, 0\.3 here"):
        build_algorithm(make_config("camera.contrast_threshold=0.3"), encoder)


def test_an_encoder_of_another_model_is_not_fine_tuned(encoder):
    with pytest.raises(ConfigError, match=r"encoder: must be one of .*'eventnet'.* to be fine-tuned, got"):
        build_algorithm(make_own("finetuned", "model.coding=eventnet"), encoder)


def test_a_policy_gets_an_encoder_if_and_only_if_it_has_one(encoder):
    for name, path, rule in (("bytestream", None, "a file"), ("event_image", encoder, "None")):
        with pytest.raises(ValueError, match=f"encoder_path must be {rule} for {name}"):
            build_algorithm(make_config(f"model={name}"), path)
