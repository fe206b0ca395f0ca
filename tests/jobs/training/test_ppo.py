import math

import numpy as np
import pytest
import torch
from ray.rllib.algorithms.ppo import PPO
from ray.rllib.core.rl_module.rl_module import RLModule

from envs.corridor import CorridorEnv
from jobs.config.config import ConfigError
from jobs.training.algorithms import build_algorithm
from jobs.training.policy import policy_about, policy_spec
from jobs.training.sampling.corridors import TrainingCorridors, corridor_settings
from models.encoder.weights import EncoderFileError, load_encoder
from models.kinds import KINDS
from models.policy import load_policy, save_policy
from tests.support.configs import SHORT, make_config
from tests.support.episodes import infos_of
from tests.support.learners import learn, module_of, start_of, weights, words_of
from tests.support.policies import kinds


@pytest.fixture(scope="module", params=kinds(["bytestream", "event_set", "rgb", "finetuned"]))
def name(request):
    return request.param


@pytest.fixture(scope="module")
def config(name):
    return make_config(*SHORT, *words_of(name))


@pytest.fixture(scope="module")
def ppo(config, encoder):
    return build_algorithm(config, encoder if KINDS[config.model.name].encoder else None)


@pytest.fixture
def runner(ppo, make_runner):
    return make_runner(ppo)


@pytest.fixture
def learner(ppo, runner):
    return ppo.build_learner(env=runner.env)


def test_the_settings_are_those_of_the_appendix():
    built = build_algorithm(make_config("model=event_columns", "budget=paper"))
    built.validate()
    returns = {"gamma": 0.99, "lambda_": 0.95}
    loss = {"clip_param": 0.2, "vf_loss_coeff": 0.5, "vf_clip_param": math.inf, "entropy_coeff": 0.0}
    nothing = {"use_kl_loss": False, "kl_coeff": 0.0}
    batches = {"num_epochs": 10, "minibatch_size": 32, "train_batch_size_per_learner": 2048}
    steps = {"lr": 3e-4, "grad_clip": 0.5, "grad_clip_by": "global_norm"}
    stated = returns | loss | nothing | batches | steps
    assert {key: getattr(built, key) for key in stated} == stated


@pytest.mark.parametrize(("runners", "cpus"), [(0, 1), (1, 1), (2, 2)])
def test_a_training_asks_for_a_core_per_process_that_flies_or_one_in_all(encoder, runners, cpus):
    ppo = build_algorithm(make_config(f"algo.num_env_runners={runners}"), encoder)
    assert PPO.default_resource_request(ppo).required_resources["CPU"] == pytest.approx(cpus)


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
    # Without conditions a training has the keys of those begun before there were any.
    assert corridor_settings(make_config("model=event_columns")).keys() == {"config"}


def test_training_moves_the_networks_and_never_a_frozen_encoder(name, runner, learner, encoder):
    module, before = module_of(learner), weights(learner)
    learn(learner, runner.sample(num_timesteps=64), num_epochs=2, minibatch_size=32)
    runner.set_state({"rl_module": learner.get_state(components="rl_module")["rl_module"]})
    after, flying = module.state_dict(), runner.module.state_dict()
    whole = load_encoder(encoder)[0].state_dict()
    assert any(key.startswith("encoder.") for key in before) is (name == "bytestream")
    for key, value in before.items():
        frozen = key.startswith("encoder.")
        statistic = "running_" in key or "num_batches" in key
        assert torch.equal(after[key], value) is (frozen or statistic), key
        if frozen or (name == "finetuned" and key.startswith("trunk.")):
            assert torch.equal(value, whole[key.partition(".")[2]]), key
        if key in flying:
            assert torch.equal(flying[key], after[key]), key
    assert {key for key in before if key not in flying} == {key for key in before if key.startswith("vf.")}
    encoder_parts = (module.encoder if (name == "bytestream") else module.trunk).modules()
    assert name not in ("bytestream", "finetuned") or not any(part.training for part in encoder_parts)


def test_the_values_of_a_batch_are_those_of_the_loss(runner, learner):
    module, samples = module_of(learner), runner.sample(num_timesteps=300)
    stacks = np.concatenate([chunk.get_observations() for chunk in samples])[:300]
    batch = {"obs": torch.from_numpy(stacks)}
    targets = module.compute_values(batch)
    outputs = module.forward_train(batch)
    values = module.compute_values(batch, embeddings=outputs["embeddings"])
    torch.testing.assert_close(targets, values, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(outputs["action_dist_inputs"], module._forward(batch)["action_dist_inputs"])
    assert (targets.requires_grad, values.requires_grad) == (False, True)
    assert targets.shape == (300,)


def test_a_module_checkpoint_alone_restores_encoder_and_networks(runner, learner, tmp_path, monkeypatch):
    module = module_of(learner)
    module.save_to_path(tmp_path / "module")

    def gone(path):
        raise EncoderFileError("gone")

    monkeypatch.setattr("models.encoder.frozen.load_encoder", gone)
    restored = RLModule.from_checkpoint(tmp_path / "module")
    for name, value in module.state_dict().items():
        assert torch.equal(restored.state_dict()[name], value), name
    observations, _ = runner.env.unwrapped.reset(seed=0)
    np.testing.assert_array_equal(restored.features(observations), runner.module.features(observations))


def test_the_exported_policy_gives_the_logits_of_the_path_through_rllib(
    name, config, runner, learner, encoder, tmp_path
):
    module = module_of(learner)
    runner.module.pi.load_state_dict(module.pi.state_dict())
    for part in (module.pi, runner.module.pi):
        for value in part.parameters():
            value.data.mul_(20.0)  # so that logits differ
    evae = load_encoder(encoder)[0] if (name == "bytestream") else None
    folder = save_policy(tmp_path, module.networks(), policy_spec(config), policy_about(config), evae)
    policy = load_policy(folder)
    assert policy.observation == runner.env.unwrapped.envs[0].config.observation
    env, compared = CorridorEnv(corridor_settings(config)["config"]), []
    for chunk in runner.sample(num_timesteps=40):
        if chunk.t_started == 0:
            shown, _ = env.reset(**start_of(infos_of(chunk)))
            policy.reset(1)
            for action, logits in zip(
                chunk.get_actions(), chunk.get_extra_model_outputs("action_dist_inputs"), strict=True
            ):
                compared.append(policy.logits(shown[None])[0])
                np.testing.assert_allclose(compared[-1], logits, rtol=1e-5, atol=1e-5)
                shown, *_ = env.step(action)
    assert len(compared) >= 40
    assert np.ptp(compared, axis=0).max() > 1e-3


@pytest.mark.parametrize(
    ("words", "with_encoder", "error", "message"),
    [
        (["camera.contrast_threshold=0.3"], True, ConfigError, r"another sensor.*: 0\.2 there, 0\.3 here"),
        (
            ["model.encoder=finetuned", "model.coding=eventnet"],
            True,
            ConfigError,
            "encoder: must be one of .*'eventnet'.* to be fine-tuned, got",
        ),
        ([], False, ValueError, "encoder_path must be a file for bytestream"),
        (["model=event_image"], True, ValueError, "encoder_path must be None for event_image"),
    ],
)
def test_an_encoder_that_does_not_fit_is_refused(encoder, words, with_encoder, error, message):
    with pytest.raises(error, match=message):
        build_algorithm(make_config(*words), encoder if with_encoder else None)
