import copy

import numpy as np
import pytest
import torch
from ray.rllib.algorithms.ppo.torch.ppo_torch_learner import PPOTorchLearner
from ray.rllib.core.columns import Columns
from ray.rllib.env.utils.infinite_lookback_buffer import InfiniteLookbackBuffer

from jobs.training.algorithms import build_algorithm
from jobs.training.imitation.learner import sequence_steps
from jobs.training.ppo.learner import REWARD_SCALE, PlainPPOLearner, _minibatch
from jobs.training.ppo.losses import FIRST_ROW, STARTS, TAKEN, sequences, windows
from jobs.training.sampling.env_runner import STATES, PlainEnvRunner
from models.policy.rllib_module import SEQUENCE, STATE
from tests.support.configs import SHORT, make_config
from tests.support.learners import learn, module_of, moved, weights

OWN = "model.own_actions=true", "model.own_velocity=true"
GRU = *SHORT, "model=event_columns_gru", "model.units=8", *OWN


@pytest.fixture(scope="module")
def sampled():
    ppo = build_algorithm(make_config(*GRU, "algo.entropy_coeff=0.03"))
    runner = PlainEnvRunner(config=ppo, worker_index=0)
    episodes = [runner.sample(num_timesteps=90) for _ in range(2)]
    learner = ppo.build_learner(env=runner.env)
    module_of(learner).load_state_dict(runner.module.state_dict(), strict=False)
    yield runner, learner, episodes
    runner.stop()


def test_rows_are_cut_into_sequences_that_end_with_their_piece_and_hold_each_row_once():
    steps = torch.tensor([0, 1, 2, 3, 4, 0, 1, 0])  # of pieces of 5, 2 and 1 steps
    rows = {STARTS: steps, "number": torch.arange(8), STATES: torch.arange(16.0).reshape(8, 2)}
    parts = sequences(rows, 2)
    assert parts[FIRST_ROW].tolist() == [0, 2, 4, 5, 7]
    assert parts["number"][parts[TAKEN]].tolist() == list(range(8))
    assert parts[TAKEN].tolist() == [[True, True], [True, True], [True, False], [True, True], [True, False]]
    assert parts[STATES].tolist() == rows[STATES][[0, 2, 4, 5, 7]].tolist()


def test_the_states_of_an_episode_begin_at_zero_and_the_learner_repeats_the_decisions(sampled):
    _, learner, (first, _) = sampled
    module = module_of(learner)
    for episode in first:
        states = episode.get_extra_model_outputs(STATES)
        if episode.t_started == 0:
            assert not states[0].any()
            assert states[1:].any()
        shown = torch.from_numpy(np.asarray(episode.get_observations())[:-1])[None]
        with torch.no_grad():
            out = module._forward_train(
                {Columns.OBS: shown, Columns.STATE_IN: {STATE: torch.from_numpy(states[:1])}}
            )
        logits = episode.get_extra_model_outputs(Columns.ACTION_DIST_INPUTS)
        np.testing.assert_allclose(out[Columns.ACTION_DIST_INPUTS][0].numpy(), logits, rtol=1e-4, atol=1e-5)


def test_the_gradient_of_a_minibatch_is_that_of_its_sequences_one_by_one(sampled):
    """And steps that only fill a sequence have no part in it."""
    _, learner, (first, _) = sampled
    module = module_of(learner)
    parts = sequences(learner._rows(first), 16)
    counts = parts[TAKEN].sum(1).tolist()
    assert min(counts) < 16

    def gradient(picked, length=None):
        rows = _minibatch(parts, torch.tensor(picked))
        if length is not None:
            rows = {
                name: value if name in (Columns.STATE_IN, FIRST_ROW) else value[:, :length]
                for name, value in rows.items()
            }
        module.zero_grad()
        learner._loss(module, rows)[0].backward()
        return torch.cat([value.grad.flatten() for value in module.parameters()])

    whole = gradient(list(range(len(counts))))
    single = sum(count * gradient([k], count) for k, count in enumerate(counts)) / sum(counts)
    torch.testing.assert_close(whole, single, rtol=1e-3, atol=1e-6)


def test_an_update_moves_every_weight(sampled):
    _, learner, (_, second) = sampled
    before = weights(learner)
    learn(learner, second, num_epochs=2, minibatch_size=64)
    assert isinstance(learner, PlainPPOLearner)
    assert moved(before, learner) == before.keys()


def for_rllib(episode, module, reward_scale):
    """The episode with the states that RLlib's env runner would have recorded, and with scaled rewards."""
    states = torch.from_numpy(episode.get_extra_model_outputs(STATES)[:1])
    shown = torch.from_numpy(np.asarray(episode.get_observations())[:-1])[None]
    with torch.no_grad():
        after = module.trunk(shown, states)[0][0].numpy()
    episode = copy.deepcopy(episode)
    episode.set_rewards(new_data=reward_scale * episode.get_rewards())
    del episode.extra_model_outputs[STATES]
    episode.extra_model_outputs[Columns.STATE_OUT] = InfiniteLookbackBuffer({STATE: after})
    return episode


@pytest.mark.system
def test_rllibs_learner_sees_the_same_sequences(sampled):
    runner, learner, (first, _) = sampled
    own = learner.config.copy(copy_frozen=False)
    theirs = own.training(learner_class=PPOTorchLearner).build_learner(env=runner.env)
    ours = own.training(learner_class=PlainPPOLearner).build_learner(env=runner.env)
    for one in (theirs, ours):
        module_of(one).load_state_dict(runner.module.state_dict(), strict=False)
    ours.set_state(theirs.get_state())
    begun = [episode for episode in first if episode.t_started == 0]
    scale = learner.config.learner_config_dict[REWARD_SCALE]
    expected = learn(theirs, [for_rllib(episode, module_of(theirs), scale) for episode in begun])
    found = learn(ours, begun)
    for name in ("entropy", "vf_loss"):
        assert found[name] == pytest.approx(expected[name], rel=1e-3), name


def test_windows_hold_each_step_once_behind_what_leads_to_its_state():
    """Of pieces of 5 steps at the start of an episode, of 7 within one, and of 2 at the start."""
    steps = torch.tensor([*range(5), *range(7), *range(2)])
    states = torch.ones(14, 3)
    states[[0, 12]] = 0.0
    rows = {STARTS: steps, "number": torch.arange(14), STATES: states}
    cut = windows(rows, before=2, most=2)
    assert cut["number"].shape == cut[TAKEN].shape == (7, 4)
    numbers = [number[taken].tolist() for number, taken in zip(cut["number"], cut[TAKEN], strict=True)]
    assert numbers == [[0, 1], [2, 3], [4], [7, 8], [9, 10], [11], [12, 13]]  # 5 and 6 have too little before
    assert cut["number"][:, 0].tolist() == [0, 0, 2, 5, 7, 9, 12]


@pytest.fixture
def taught(make_runner):
    """A function that makes an env runner with a teacher, and the learner of its algorithm."""

    def make(*words):
        built = build_algorithm(make_config(*GRU, "algo=imitation", "algo.num_env_runners=0", *words))
        runner = make_runner(built)
        return runner, built.build_learner(env=runner.env)

    return make


def test_a_window_at_the_start_of_an_episode_repeats_the_decisions_of_the_env_runner(taught):
    runner, learner = taught()
    rows = learner._rows(runner.sample(num_timesteps=150))
    module = module_of(learner)
    module.load_state_dict(runner.module.state_dict(), strict=False)
    cut = windows(rows, SEQUENCE, SEQUENCE)
    state = torch.zeros(len(cut[TAKEN]), module.state_size)
    batch = {Columns.OBS: cut[Columns.OBS], Columns.STATE_IN: {STATE: state}}
    with torch.no_grad():
        logits = module._forward_train(batch)[Columns.ACTION_DIST_INPUTS]
    expected = cut[Columns.ACTION_DIST_INPUTS]
    assert cut[TAKEN].sum() > 100
    torch.testing.assert_close(logits[cut[TAKEN]], expected[cut[TAKEN]], rtol=1e-4, atol=1e-5)


def test_a_recurrent_policy_learns_what_a_teacher_says(taught):
    runner, learner = taught("algo.imitation.fit_steps=80", "algo.lr=1e-2", "algo.mirrored=true")
    episodes = runner.sample(num_timesteps=300)
    rows = windows(learner._rows(episodes), SEQUENCE, SEQUENCE)
    before = float(learner._loss(module_of(learner), rows)[0].detach())
    learn(learner, episodes, 1, minibatch_size=256)
    assert float(learner._loss(module_of(learner), rows)[0].detach()) < 0.8 * before
    assert learner._steps.seen == 2 * len(rows[TAKEN])


def test_half_of_a_short_piece_leads_to_the_state_of_the_other_half(taught):
    small = "algo.train_batch_size_per_learner=64", "algo.minibatch_size=16"  # of two environments
    runner, learner = taught(*small, "env.time_limit_s=1.0", "algo.imitation.fit_steps=2")
    assert sequence_steps(learner.config) == 16
    for _ in range(2):  # the second time no piece begins an episode, but where one has ended
        episodes = runner.sample(num_timesteps=64)
        cut = windows(learner._rows(episodes), 16, 16)
    assert cut[TAKEN].shape[1] == 32
    assert cut[TAKEN].sum() >= 0.4 * sum(map(len, episodes))
    learn(learner, episodes, 1, minibatch_size=16)
    assert len(learner._steps) == len(cut[TAKEN])
