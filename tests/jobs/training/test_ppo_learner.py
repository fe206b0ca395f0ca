import copy
import math

import numpy as np
import pytest
import torch
from ray.rllib.algorithms.ppo.torch.ppo_torch_learner import PPOTorchLearner
from ray.rllib.utils.postprocessing.value_predictions import compute_value_targets

from jobs.training.algorithms import build_algorithm
from jobs.training.ppo import learner as ppo_learner
from jobs.training.ppo.learner import PlainPPOLearner
from jobs.training.ppo.losses import advantages
from jobs.training.sampling.env_runner import PlainEnvRunner
from tests.support.configs import SHORT, make_config
from tests.support.learners import MODULE, learn, module_of, moved, weights

FIGURES = ("policy_loss", "vf_loss", "entropy", "total_loss", "vf_explained_var")
NORM = "gradients_default_optimizer_global_norm"


@pytest.fixture(scope="module")
def ppo(encoder):
    return build_algorithm(make_config(*SHORT, "algo.entropy_coeff=0.03"), encoder)


@pytest.fixture(scope="module")
def flights(ppo):
    """Three iterations of flights, cut and truncated here and there."""
    runner = PlainEnvRunner(config=ppo, worker_index=0)
    samples = [runner.sample(num_timesteps=64) for _ in range(3)]
    yield runner.env, samples
    runner.stop()


def make_learner(ppo, env, learner_class=PlainPPOLearner, **training):
    made = ppo.copy(copy_frozen=False).training(learner_class=learner_class, **training)
    return made.build_learner(env=env)


def scaled(episodes, factor):
    """RLlib's learner knows no scale: the same flights with other rewards."""
    episodes = copy.deepcopy(episodes)
    for episode in episodes:
        episode.set_rewards(new_data=factor * episode.get_rewards())
    return episodes


def tensor_by_tensor(monkeypatch):
    """Let the learner update dense networks as all others."""
    monkeypatch.setattr(PlainPPOLearner, "_compiled", False)


@pytest.mark.system
@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("training", [{}, {"grad_clip": 1e-3, "clip_param": 0.01, "vf_clip_param": 0.5}])
def test_an_update_is_rllibs_own(ppo, flights, training, compiled, monkeypatch):
    env, samples = flights
    if not compiled:
        tensor_by_tensor(monkeypatch)
    rllibs, make_rows = {}, PlainPPOLearner._rows
    theirs, ours = (make_learner(ppo, env, kind, **training) for kind in (PPOTorchLearner, PlainPPOLearner))
    ours.set_state(theirs.get_state())
    first = weights(theirs)
    make_batch = theirs._make_batch_if_necessary

    def keep_batch(training_data):
        batch = make_batch(training_data=training_data)
        rllibs.update(batch.policy_batches["default_policy"])
        return batch

    def with_rllibs_advantages(learner, episodes):
        """Ours are standardised without the rows that RLlib appends and masks: all else is alike."""
        rows, flown = make_rows(learner, episodes), rllibs["loss_mask"]
        for key in ("obs", "actions", "action_logp", "value_targets"):
            torch.testing.assert_close(rows[key], rllibs[key][flown], rtol=1e-5, atol=1e-5)
        own, theirs = rows["advantages"], rllibs["advantages"][flown]
        assert np.corrcoef(own, theirs)[0, 1] > 1 - 1e-6
        assert float(own.mean()) == pytest.approx(0.0, abs=1e-6)
        assert float(own.std(correction=0)) == pytest.approx(1.0, abs=1e-5)
        return {**rows, "advantages": theirs}

    monkeypatch.setattr(theirs, "_make_batch_if_necessary", keep_batch)
    monkeypatch.setattr(PlainPPOLearner, "_rows", with_rllibs_advantages)
    for episodes in samples:
        expected = learn(theirs, scaled(episodes, 0.5))
        found = learn(ours, episodes)
        for name in (NORM, *FIGURES[:4]):
            assert found[name] == pytest.approx(expected[name], rel=1e-4, abs=1e-6), name
    expected, found = weights(theirs), weights(ours)
    far = max(float((expected[name] - first[name]).abs().max()) for name in first)
    apart = max(float((expected[name] - found[name]).abs().max()) for name in first)
    assert apart < 1e-3 * far
    assert far > 1e-5


@pytest.mark.parametrize("terminated", [True, False])
def test_advantages_are_those_of_a_plain_loop_and_of_rllib(terminated):
    rng = np.random.default_rng(0)
    values, rewards = rng.normal(size=41).astype("f4"), rng.normal(size=40)
    found = advantages(values, rewards, terminated, 0.97, 0.9)
    last = values[40] * (not terminated)
    errors = rewards + 0.97 * np.append(values[1:40], last) - values[:40]
    plain = [sum((0.97 * 0.9) ** k * error for k, error in enumerate(errors[t:])) for t in range(40)]
    np.testing.assert_allclose(found, plain, rtol=1e-6, atol=1e-6)
    ends = np.zeros(41)
    ends[39] = 1.0
    flags = (ends, 0 * ends) if terminated else (0 * ends, ends)
    targets = compute_value_targets(values, np.append(rewards, 0.0), *flags, gamma=0.97, lambda_=0.9)
    np.testing.assert_allclose(found + values[:40], targets[:40], rtol=1e-5, atol=1e-5)


def test_every_step_is_seen_once_an_epoch_in_another_order(ppo, flights, monkeypatch):
    env, samples = flights
    tensor_by_tensor(monkeypatch)
    learner = make_learner(ppo, env)
    seen = []
    loss = learner._loss

    def seeing_loss(module, rows):
        seen.append(rows["action_logp"].clone())
        return loss(module, rows)

    monkeypatch.setattr(learner, "_loss", seeing_loss)
    learn(learner, samples[0], num_epochs=3, minibatch_size=10)
    assert [len(part) for part in seen] == [10, 10, 10, 10, 10, 10, 4] * 3
    epochs = [torch.cat(seen[7 * k : 7 * k + 7]) for k in range(3)]
    assert all(torch.equal(epoch.sort().values, epochs[0].sort().values) for epoch in epochs)
    assert not torch.equal(epochs[0], epochs[1])


def test_explained_variance_is_one_for_values_on_target(ppo, flights, monkeypatch):
    env, samples = flights
    learner = make_learner(ppo, env)
    found = []
    explain = learner._explained_variance
    monkeypatch.setattr(learner, "_explained_variance", lambda rows: found.append(rows) or explain(rows))
    learn(learner, samples[0])
    rows = found[0]
    values = module_of(learner).compute_values(rows).detach()
    assert explain({**rows, "value_targets": values}) == 1.0
    assert explain({**rows, "value_targets": values.flip(0)}) < 0.9
    assert explain({**rows, "value_targets": torch.linspace(-1e-3, 1e-3, len(values))}) == -1.0


def test_the_learning_rate_follows_its_schedule(ppo, flights):
    env, samples = flights
    learner = make_learner(ppo, env, lr=[[0, 1e-3], [1000, 0.0]])
    for steps, expected in ((250, 7.5e-4), (1000, 0.0)):
        learn(learner, samples[0], steps)
        assert float(learner.get_optimizer(MODULE).param_groups[0]["lr"]) == pytest.approx(expected)
    before = weights(learner)
    learn(learner, samples[0], 1000)
    assert not moved(before, learner)


def test_a_gradient_that_is_not_finite_stops_before_the_weights_move(ppo, flights, monkeypatch):
    env, samples = flights
    learner = make_learner(ppo, env)
    before, loss = weights(learner), learner._loss
    with monkeypatch.context() as broken:
        tensor_by_tensor(broken)
        broken.setattr(learner, "_loss", lambda *asked: (loss(*asked)[0] * math.nan, {}))
        with pytest.raises(RuntimeError, match="non-finite"):
            learn(learner, samples[0], minibatch_size=32)
    with monkeypatch.context() as broken:
        broken.setattr(ppo_learner, "advantages", lambda values, rewards, *rest: np.nan * rewards)
        with pytest.raises(RuntimeError, match="non-finite"):
            learn(learner, samples[0], minibatch_size=32)
    assert not moved(before, learner)
    assert np.isfinite(learn(learner, samples[1])["total_loss"])
