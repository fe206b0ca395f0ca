import dataclasses

import numpy as np
import pytest

from envs.config import EnvConfig
from envs.corridor import CorridorEnv
from envs.event_error import converged
from jobs.config.conditions import env_with
from jobs.measure import replays
from jobs.measure.replays import latent_error, latents_of, measure_settings, replay, steps, take_turns
from jobs.rollout.agents import make_agent
from models.encoder.weights import load_encoder
from models.policy.policy import ENCODER
from tests.support.policies import save_untrained

SHORT = EnvConfig(scene="poles_eval", split="eval", time_limit_s=0.1)


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    path = tmp_path_factory.mktemp("policy")
    save_untrained(path, SHORT, "bytestream")
    return path


def agent_of(policy, **table):
    return make_agent(str(policy), "stochastic", table)


def test_given_actions_are_flown_whatever_the_agent_would_do(policy):
    turns, agent = np.array([1, 2] * 10), agent_of(policy)
    found = replay(SHORT, agent, 0, turns)
    np.testing.assert_array_equal(agent.policy.taken, turns[-1:])  # what it remembers of its own actions
    env = CorridorEnv(SHORT)
    env.reset(seed=0)
    for action in turns:
        env.step(int(action))
    assert not np.array_equal(found.actions, turns)
    np.testing.assert_array_equal(found.events["t"][-5:], env.events["t"][-5:])


def test_flights_that_take_turns_are_flown_as_each_alone(policy, monkeypatch):
    monkeypatch.setattr(replays, "TURN", 7)
    turns = np.array([1, 2] * 10)
    told = []
    found = take_turns([steps(SHORT, agent_of(policy), seed, turns) for seed in (0, 1)], told.append)
    assert told == [1, 1]
    for seed, own in enumerate(found):
        alone = replay(SHORT, agent_of(policy), seed, turns)
        np.testing.assert_array_equal(own.actions, alone.actions)
        np.testing.assert_array_equal(own.events, alone.events)


def test_latents_are_those_of_the_table_that_flies(policy):
    agent = agent_of(policy, precision="int8")
    windows = replay(SHORT, agent, 0).windows
    table = agent.policy.encoder
    assert table.features.dtype == np.int8
    np.testing.assert_array_equal(latents_of(agent, windows)[5], table.encode_windows(windows[5][None])[0])


def test_a_policy_without_a_table_has_no_latents(policy, tmp_path):
    save_untrained(tmp_path, SHORT, "event_columns")
    with pytest.raises(TypeError, match="must be an EncoderTable, got NoneType"):
        latents_of(make_agent(str(tmp_path)), [np.zeros((1, 4), np.int32)])


def test_a_latent_error_is_zero_for_the_exact_one_for_the_mean_and_of_no_unit():
    rng = np.random.default_rng(0)
    exact = rng.normal(size=(50, 4)) * [1.0, 2.0, 0.1, 0.0]
    assert latent_error(exact, exact) == 0.0
    assert latent_error(np.broadcast_to(exact.mean(axis=0), exact.shape), exact) == pytest.approx(1.0)
    off = exact + rng.normal(size=exact.shape)
    assert latent_error(off, exact) == pytest.approx(latent_error(1000 * off, 1000 * exact))
    assert np.isnan(latent_error(exact, np.zeros((50, 4))))


def test_the_reference_has_no_error_and_what_changes_less_has_less(policy):
    evae, _ = load_encoder(policy / ENCODER)
    env = CorridorEnv(SHORT)
    env.reset(seed=0)
    exact = dataclasses.replace(converged(SHORT, env.scene), observation="window")
    legacy = env_with(SHORT, {"camera.memory": "legacy"})
    settings = [
        (SHORT, agent_of(policy)),
        (SHORT, agent_of(policy, time_bins=16)),
        (legacy, agent_of(policy)),
        (exact, agent_of(policy, time_bins=65536)),
    ]
    told = []
    usual, binned, forgetful, reference = measure_settings(settings, evae, range(2), told.append)
    assert sum(told) == 8
    assert reference.event_error == reference.other_action == 0.0
    assert reference.latent_error < 1e-3
    assert 0.0 < usual.event_error == binned.event_error < 0.2 < forgetful.event_error
    assert usual.latent_error < binned.latent_error
    assert usual.latent_error < forgetful.latent_error
    assert reference.step_us > usual.step_us
    assert 0.0 <= usual.other_action <= forgetful.other_action <= 1.0
