import math
import pickle
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from ray.rllib.callbacks.callbacks import RLlibCallback
from ray.rllib.connectors.connector_v2 import ConnectorV2
from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner

from jobs.rollout.diagnostics import DRIFT_METRICS, drift_metrics
from jobs.training.algorithms import build_algorithm
from jobs.training.sampling.env_runner import PlainEnvRunner, RolloutError
from jobs.training.sampling.window_sample import WindowSample
from models.encoder.weights import load_encoder
from models.policy.features import push_features
from tests.support.configs import SHORT, make_config
from tests.support.episodes import infos_of
from tests.support.learners import encoder_of
from tests.support.policies import kinds

COLUMNS = (*SHORT, "model=event_columns", "algo.train_batch_size_per_learner=32")


class StackFeatures(ConnectorV2):
    """RLlib's own way: a connector that replaces each newest observation by a stack of features."""

    def __init__(self, space):
        self.space = space
        super().__init__()

    def recompute_output_observation_space(self, input_observation_space, input_action_space):
        return self.space

    def __call__(self, *, rl_module, batch, episodes, **kwargs):
        features = rl_module.features(np.stack([episode.get_observations(-1) for episode in episodes]))
        first = np.array([episode.t == 0 for episode in episodes])
        stacks = np.zeros((len(episodes), *self.space.shape), self.space.dtype)
        for row, episode in enumerate(episodes):
            if not first[row]:
                stacks[row] = episode.get_observations(-2)
        for episode, stacked in zip(episodes, push_features(stacks, features, first), strict=True):
            episode.observation_space = self.space
            episode.set_observations(at_indices=-1, new_data=stacked)
        return batch


def make_runners(name, folder, *overrides):
    """Ours, and RLlib's with the connector; both with larger logits, so that actions differ."""
    equal = "env.window_capacity=512"  # RLlib's own takes no observations of different length
    config = make_config(*SHORT, f"model={name}", "algo.num_envs_per_env_runner=3", equal, *overrides)
    ppo = build_algorithm(config, encoder_of(config, folder))
    space = ppo.rl_module_spec.observation_space
    theirs = ppo.copy(copy_frozen=False).env_runners(
        env_runner_cls=SingleAgentEnvRunner,
        env_to_module_connector=lambda env, spaces, device: StackFeatures(space),
    )
    theirs.callbacks(RLlibCallback)  # ours read infos as arrays
    runners = PlainEnvRunner(config=ppo, worker_index=0), SingleAgentEnvRunner(config=theirs, worker_index=0)
    for runner in runners:
        for value in runner.module.pi.parameters():
            value.data.mul_(20.0)
    return runners


@pytest.fixture
def ours(make_runner):
    """A runner of policies that see columns of events."""
    return make_runner(build_algorithm(make_config(*COLUMNS, "algo.num_envs_per_env_runner=3")))


def samples_of(runner, sizes):
    torch.manual_seed(0)
    return [runner.sample(num_timesteps=size) for size in sizes]


@pytest.mark.parametrize("name", kinds(["bytestream", "event_set", "rgb"]))
def test_flights_are_rllibs_own_to_the_byte(name, tmp_path):
    ours, theirs = make_runners(name, tmp_path)
    names, made, features = {}, [], ours.module.features
    ours.module.features = lambda observations: made.append(len(observations)) or features(observations)
    for mine, other in zip(*(samples_of(runner, (40, 1, 17, 64)) for runner in (ours, theirs)), strict=True):
        assert [len(chunk) for chunk in mine] == [len(chunk) for chunk in other]
        for one, two in zip(mine, other, strict=True):
            for get in ("get_observations", "get_actions", "get_rewards"):
                found, expected = np.asarray(getattr(one, get)()), np.asarray(getattr(two, get)())
                np.testing.assert_array_equal(found, expected, err_msg=get)
            for key in ("action_logp", "action_dist_inputs"):
                found, expected = (chunk.get_extra_model_outputs(key) for chunk in (one, two))
                # Ours are computed without torch; sums in another order differ by the processor's registers.
                np.testing.assert_allclose(found, expected, rtol=1e-5, atol=4e-6)
            assert infos_of(one) == infos_of(two)
            assert (one.is_terminated, one.is_truncated) == (two.is_terminated, two.is_truncated)
            assert (one.t_started, one.t) == (two.t_started, two.t)
            assert names.setdefault(one.id_, two.id_) == two.id_  # the pieces of a flight share a name
            one.validate()
    assert len(set(names.values())) == len(names)
    actions = np.concatenate([chunk.get_actions() for chunk in mine])
    assert len(set(actions)) == 3
    counted = [runner.get_metrics()["num_env_steps_sampled"].peek() for runner in (ours, theirs)]
    assert counted[0] == counted[1] == sum(made) - len(names)  # each feature is made once
    for runner in (ours, theirs):
        runner.stop()


def test_a_runner_keeps_the_actions_that_were_taken(make_runner):
    runner = make_runner(build_algorithm(make_config(*COLUMNS, "model.own_actions=true")))
    taken, begins = set(), 0
    for episode in [*runner.sample(num_timesteps=100), *runner.sample(num_timesteps=60)]:
        observations, actions = np.asarray(episode.get_observations()), episode.get_actions()
        shown = observations[:, -1, -3:]
        np.testing.assert_array_equal(shown[1:], np.eye(3)[actions])
        if not episode.t_started:
            begins += 1
            assert not shown[0].any()
        taken |= set(actions.tolist())
    assert taken == {0, 1, 2}
    assert begins > 0


def test_a_reset_forgets_the_flights_in_the_air(ours):
    (first,) = samples_of(ours, (10,))
    again = ours.sample(num_timesteps=10, force_reset=True)
    assert {chunk.id_ for chunk in first}.isdisjoint(chunk.id_ for chunk in again)
    assert all(chunk.t_started == 0 for chunk in again)


def test_what_it_cannot_fly_is_refused(ours):
    few = {"num_timesteps": 4}
    for asked in ({"num_episodes": 1}, {**few, "random_actions": True}, {**few, "explore": False}):
        with pytest.raises(RolloutError, match=r"ValueError: .*drawn actions and nothing else"):
            ours.sample(**asked)


class Broken(PlainEnvRunner):
    """One whose flights raise; made without a process of its own."""

    def __init__(self):
        self.error = ValueError("episode 3, step 7, seed 0: the reward must be finite; got nan")

    def sample(self, **asked):
        raise RolloutError(f"ValueError: {self.error}")


def test_what_a_flight_raises_is_raised_again_where_its_sample_is_used():
    sent = Broken().apply(lambda runner: (runner.sample(), runner.get_metrics()))
    received = pickle.loads(pickle.dumps(sent))
    with pytest.raises(RolloutError, match="step 7, seed 0: the reward must be finite; got nan"):
        received[0]


def test_any_other_error_ends_the_process_as_rllib_has_it():
    runner = Broken()
    runner.config = SimpleNamespace(restart_failed_env_runners=False)
    with pytest.raises(SystemExit):
        runner.apply(lambda runner: runner.no_such_method())


@pytest.fixture
def encoded_runner(encoder, make_runner):
    return make_runner(build_algorithm(make_config(*SHORT), encoder))


def test_a_weight_sync_keeps_the_table_and_another_encoder_replaces_it(encoded_runner):
    module, windows = encoded_runner.module, np.zeros((1, 4097, 4), np.int32)
    windows[0, :2] = [1, 0, 5000, 0], [4000, 20, 30, 1]
    latent = module.features(windows)
    table, state = module._table, module.get_state()
    module.set_state(state)
    assert module._table is table
    state["encoder.encoder.2.bias"] = state["encoder.encoder.2.bias"] + 1
    module.set_state(state)
    np.testing.assert_allclose(module.features(windows), latent + 1, atol=1e-5)


def read(runner):
    """The numbers among the metrics of a runner."""
    return {name: getattr(value, "peek", lambda: math.nan)() for name, value in runner.get_metrics().items()}


def test_returns_are_reported_unscaled(encoded_runner):
    first, second = (encoded_runner.sample(num_timesteps=16) for _ in range(2))
    begun = {chunk.id_ for chunk in first}  # which all end in the second round
    done = [chunk for chunk in (*first, *second) if chunk.is_done and chunk.id_ in begun]
    returns = [chunk.get_return() for chunk in (*first, *second) if chunk.id_ in begun]
    assert len(done) == len(begun)
    metrics = read(encoded_runner)
    assert metrics["episode_return"] == pytest.approx(np.sum(returns) / len(begun))
    distances = [chunk.get_infos(-1)["distance_m"] for chunk in done]
    assert metrics["distance_m"] == pytest.approx(np.mean(distances))
    assert metrics["episode_return"] == pytest.approx(metrics["distance_m"])  # no bonus: truncated
    assert metrics["events_per_step"] > 0.0


def test_the_sample_of_windows_holds_the_newest_of_all_episodes_in_turn():
    shown, windows = WindowSample(), np.zeros((2, 5, 4), np.int32)
    for step in range(300):
        windows[:, 0] = [[2, 0, 5000, step], [4, 0, 5000, 1000 + step]]
        windows[:, 1:, 3] = 1
        shown.add(windows)
    expected = [step + 1000 * (step % 2) for step in range(172, 300)]
    assert [int(window[0, 3]) for window in shown.windows] == expected
    assert {len(window) for window in shown.windows} == {3, 5}
    windows[:] = 0
    assert shown.windows[-1][0, 0] == 4  # a copy
    again = WindowSample()
    again.load(shown.arrays(), shown.steps)
    again.add(windows)
    shown.add(windows)
    assert again.steps == shown.steps
    assert all(map(np.array_equal, again.windows, shown.windows))


def drift_of(runner, rounds=1):
    """What a runner tells of its encoder in the last of some rounds; the samples of all."""
    samples, told = [], {}
    for _ in range(rounds):
        samples += runner.sample(num_timesteps=30)
        metrics = read(runner)
        told = {name: metrics[name] for name in DRIFT_METRICS if not math.isnan(metrics.get(name, math.nan))}
    return told, samples


def test_drift_is_measured_every_tenth_round_on_what_the_policy_met(encoded_runner, encoder):
    first, _ = drift_of(encoded_runner)
    evae, about = load_encoder(encoder)
    expected = drift_metrics(evae, encoded_runner.shown.windows, {"reconstruction_step": 0.5})
    assert first == pytest.approx(expected | {"drift": expected["policy_reconstruction"] / 0.5})
    assert about["figures"] == {"reconstruction_step": 0.5}
    assert drift_of(encoded_runner)[0] == drift_of(encoded_runner, 8)[0] == {}
    assert set(drift_of(encoded_runner)[0]) == set(DRIFT_METRICS)


def test_without_its_file_an_encoder_is_flown_but_not_measured_and_nothing_else_changes(
    encoder, tmp_path, make_runner
):
    flights = []
    for there in (True, False):
        path = shutil.copytree(encoder.parent, tmp_path / str(there)) / encoder.name
        runner = make_runner(build_algorithm(make_config(*SHORT), path))
        if not there:
            path.unlink()
        told, _ = drift_of(runner)
        _, samples = drift_of(runner)  # what follows a measurement
        assert bool(told) is there
        flights.append(np.concatenate([chunk.get_actions() for chunk in samples]))
    np.testing.assert_array_equal(*flights)
