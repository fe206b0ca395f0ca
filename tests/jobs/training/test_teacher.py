import copy
import math

import numpy as np
import pytest
import torch

from envs.corridor import CorridorEnv
from envs.scene.planning import cost_to_go
from jobs.training.algorithms import build_algorithm
from jobs.training.policy import policy_about, policy_spec
from jobs.training.ppo.learner import advantages, shaping
from jobs.training.sampling.corridors import corridor_settings
from jobs.training.sampling.env_runner import PlainEnvRunner
from jobs.training.sampling.teacher import COST_TO_GO, PricedEnvRunner
from models.policy import load_policy, save_policy
from models.policy.rllib_module import PRIVILEGED
from tests.support.configs import SHORT, make_config
from tests.support.episodes import infos_of
from tests.support.runs import write_networks

SAMPLED = "num_env_steps_sampled_lifetime"
COLUMNS = (*SHORT, "model=event_columns", "algo.num_env_runners=0", "algo.lr_schedule=constant")
WEIGHT = 12.0


@pytest.fixture(scope="module")
def rolled_out():
    """The environments of an env runner with a teacher, and two rounds of it."""
    runner = PricedEnvRunner(config=build_algorithm(make_config(*COLUMNS)), worker_index=0)
    rounds = [runner.sample(num_timesteps=64) for _ in range(2)]
    yield runner.env, rounds
    runner.stop()


def make_learner(env, *words, **built):
    return build_algorithm(make_config(*COLUMNS, *words), **built).build_learner(env=env)


def module_of(learner):
    return learner.module["default_policy"].unwrapped()


def learn(learner, episodes, sampled=10**6):
    learner.update(episodes=copy.deepcopy(episodes), timesteps={SAMPLED: sampled}, num_epochs=2,
                   minibatch_size=16)  # fmt: skip


def weights(learner):
    return {name: value.clone() for name, value in module_of(learner).state_dict().items()}


def moved(before, learner):
    return {name for name, value in weights(learner).items() if not torch.equal(value, before[name])}


@pytest.mark.parametrize("terminated", [True, False])
def test_shaped_returns_differ_from_the_true_ones_by_the_potentials_at_both_ends(terminated):
    rng = np.random.default_rng(0)
    rewards, potentials, gamma = rng.normal(size=30), rng.normal(size=31), 0.97
    nothing, more = np.zeros(31), shaping(potentials, terminated, gamma)
    true, shaped = (advantages(nothing, r, True, gamma, 1.0) for r in (rewards, rewards + more))
    left = gamma ** (30.0 - np.arange(30)) * potentials[30] * (not terminated)
    np.testing.assert_allclose(shaped - true, left - potentials[:30], atol=1e-12)


@pytest.mark.parametrize("terminated", [True, False])
@pytest.mark.parametrize("lambda_", [0.0, 0.9, 1.0])
def test_advantages_of_shaped_rewards_are_the_true_ones_for_values_below_by_the_potential(
    terminated, lambda_
):
    rng = np.random.default_rng(1)
    values, potentials, rewards = rng.normal(size=31), rng.normal(size=31), rng.normal(size=30)
    more = shaping(potentials, terminated, 0.97)
    shaped = advantages(values - potentials, rewards + more, terminated, 0.97, lambda_)
    np.testing.assert_allclose(shaped, advantages(values, rewards, terminated, 0.97, lambda_), atol=1e-12)


def best_values(rewards, chances, gamma):
    """Optimal action values (S, A) of rewards (S, A, S) and chances (S, A, S); the last state is the end."""
    found = np.zeros(chances.shape[:2])
    for _ in range(2000):
        ahead = found.max(axis=1) * (np.arange(len(found)) < len(found) - 1)
        found = (chances * (rewards + gamma * ahead)).sum(axis=2)
    return found


def test_the_best_actions_stay_the_best():
    rng = np.random.default_rng(2)
    states, gamma = 6, 0.9
    chances = rng.dirichlet(np.full(states, 0.5), (states, 3))
    rewards, potentials = rng.normal(size=(states, 3, states)), 10.0 * rng.normal(size=states)
    more = np.array(
        [
            [shaping(potentials[[s, after]], after == states - 1, gamma)[0] for after in range(states)]
            for s in range(states)
        ]
    )
    true = best_values(rewards, chances, gamma)[:-1]
    shaped = best_values(rewards + more[:, None], chances, gamma)[:-1]
    np.testing.assert_allclose(shaped, true - potentials[:-1, None], atol=1e-9)
    np.testing.assert_array_equal(shaped.argmax(1), true.argmax(1))


def test_each_place_of_an_episode_has_its_cost_and_all_else_is_as_without_a_teacher(rolled_out):
    config = make_config(*COLUMNS)
    plain, env = (
        PlainEnvRunner(config=build_algorithm(config), worker_index=0),
        CorridorEnv(corridor_settings(config)["config"]),
    )
    for episodes in rolled_out[1]:
        for episode, other in zip(episodes, plain.sample(num_timesteps=64), strict=True):
            infos = infos_of(episode)
            series = {"episode_number": int(infos[0]["episode_number"])}
            env.reset(seed=int(infos[0]["episode_seed"]), options=series)
            plan = cost_to_go(env.scene, env.config.vehicle_radius_m, env.config.camera_height_m)
            costs = [plan.of_actions(info["x_m"], info["y_m"]).min() for info in infos]
            np.testing.assert_array_equal([info[COST_TO_GO] for info in infos], costs)
            np.testing.assert_array_equal(episode.get_observations(), other.get_observations())
            np.testing.assert_array_equal(episode.get_actions(), other.get_actions())
            np.testing.assert_array_equal(episode.get_rewards(), other.get_rewards())
    plain.stop()


def test_with_a_delay_a_cost_is_that_of_the_place_where_the_next_action_is_taken():
    config = make_config(*COLUMNS, "env.action_delay_ms=20")
    assert policy_about(config)["world"]["action_delay_ms"] == 20.0
    assert "action_delay_ms" not in policy_about(make_config(*COLUMNS))["world"]
    runner, env = PricedEnvRunner(config=build_algorithm(config), worker_index=0), CorridorEnv()
    compared = 0
    for episode in runner.sample(num_timesteps=64):
        infos = infos_of(episode)
        series = {"episode_number": int(infos[0]["episode_number"])}
        env.reset(seed=int(infos[0]["episode_seed"]), options=series)
        plan = cost_to_go(env.scene, env.config.vehicle_radius_m, env.config.camera_height_m)
        for info, later in zip(infos[:-5], infos[4:-1], strict=True):  # four steps of 5 ms
            assert info[COST_TO_GO] == plan.of_actions(later["x_m"], later["y_m"]).min()
            assert later["y_m"] > info["y_m"] + 0.25
            compared += 1
    assert compared > 20
    runner.stop()


def test_shaping_lowers_what_values_are_taught_by_the_potential_and_leaves_returns(rolled_out, monkeypatch):
    env, (episodes, _) = rolled_out
    costs = np.concatenate([[info[COST_TO_GO] for info in infos_of(one)] for one in episodes])
    potentials = -0.5 * WEIGHT * np.log1p(costs).astype("f4")  # rewards are halved (SHORT)
    returns = [episode.get_return() for episode in episodes]
    rows = []
    for learner, known in (
        (make_learner(env), 0.0 * potentials),
        (make_learner(env, f"algo.shaping={WEIGHT}"), potentials),
    ):
        monkeypatch.setattr(module_of(learner), "compute_values", lambda _, v=known: torch.from_numpy(-v))
        rows.append(learner._rows(episodes))
    torch.testing.assert_close(rows[0]["advantages"], rows[1]["advantages"], atol=1e-4, rtol=0)
    inner = np.concatenate(
        [np.arange(len(one) + 1) < len(one) for one in episodes]
    )  # the last place of each piece has no step
    difference = (rows[0]["value_targets"] - rows[1]["value_targets"]).numpy()
    np.testing.assert_allclose(difference, potentials[inner], atol=1e-4)
    assert [episode.get_return() for episode in episodes] == returns
    assert potentials.std() > 0.1


def test_what_is_privileged_changes_values_alone(rolled_out, tmp_path):
    env, (episodes, _) = rolled_out
    config = make_config(*COLUMNS)
    plain, told = make_learner(env), make_learner(env, "algo.critic=teacher")
    rows = told._rows(episodes)
    one, other = module_of(plain), module_of(told)
    # Nothing is learnt of it yet; one input more may add the others in another order.
    torch.testing.assert_close(one.compute_values(rows), other.compute_values(rows), rtol=1e-4, atol=1e-5)
    with torch.no_grad():
        other.vf[0].weight[:, -1] = 1.0
    assert not torch.isclose(one.compute_values(rows), other.compute_values(rows)).any()
    changed = {**rows, PRIVILEGED: rows[PRIVILEGED] + 1.0}
    assert not torch.isclose(other.compute_values(changed), other.compute_values(rows)).any()
    for batch in (rows, changed):
        logits = other._forward(batch)["action_dist_inputs"]
        assert torch.equal(logits, one._forward(rows)["action_dist_inputs"])
    folders = [
        save_policy(tmp_path / name, module.networks(), policy_spec(config), policy_about(config))
        for name, module in (("one", one), ("other", other))
    ]
    assert [path.read_bytes() for path in folders[0].iterdir()] == [
        path.read_bytes() for path in folders[1].iterdir()
    ]
    assert load_policy(folders[1]).stack_shape == rows["obs"].shape[1:]


@pytest.mark.parametrize("compiled", [True, False])
def test_a_critic_learns_from_what_it_is_told(rolled_out, compiled, monkeypatch):
    env, (episodes, _) = rolled_out
    learner = make_learner(env, "algo.critic=teacher")
    if not compiled:
        monkeypatch.setattr(type(learner), "_compiled", False)
    rows = learner._rows(episodes)
    expected = np.concatenate(
        [np.log1p([info[COST_TO_GO] for info in infos_of(one)[:-1]]) for one in episodes]
    )
    np.testing.assert_array_equal(rows[PRIVILEGED][:, 0], expected.astype("f4"))
    learn(learner, episodes)
    assert float(weights(learner)["vf.0.weight"][:, -1].abs().min()) > 0.0


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A file of networks to begin from."""
    return write_networks(tmp_path_factory.mktemp("policy"), make_config(*COLUMNS))


def test_a_training_begins_with_the_networks_that_it_is_given(rolled_out, trained):
    words, expected = ("train.init=X", "algo.critic=teacher"), load_policy(trained.parent).networks
    learner = make_learner(rolled_out[0], *words, init=trained)
    found = module_of(learner).networks().state_dict()
    assert found.keys() == expected.state_dict().keys()
    assert all(torch.equal(value, found[name]) for name, value in expected.state_dict().items())
    lost = make_learner(rolled_out[0], *words, init=trained.parent / "lost")
    assert all(math.isnan(value.sum()) for value in module_of(lost).parameters())


@pytest.mark.parametrize("kind", ["event_columns", "event_set"])
def test_in_the_warm_up_only_the_value_network_learns_and_ppo_then_begins_anew(rolled_out, trained, kind):
    """Of dense networks, and of those behind a trunk that policy and value share."""
    words = f"model={kind}", "train.init=X", "train.value_warmup=200"
    env, rounds, init = rolled_out[0], rolled_out[1], trained
    if kind != "event_columns":
        runner = PlainEnvRunner(
            config=build_algorithm(make_config(*COLUMNS, f"model={kind}")), worker_index=0
        )
        env, rounds, init = runner.env, [runner.sample(num_timesteps=64) for _ in range(2)], None
        runner.stop()
    learner, fresh = (make_learner(env, *words, init=init) for _ in range(2))
    before, taken = weights(learner), sum(map(len, rounds[0]))
    learn(learner, rounds[0], taken)
    assert moved(before, learner) == {name for name in before if name.startswith("vf.")}
    learn(learner, rounds[1], 199 + taken)  # began before 200
    assert moved(before, learner) == {name for name in before if name.startswith("vf.")}
    module_of(fresh).load_state_dict(module_of(learner).state_dict())
    for one in (learner, fresh):
        torch.manual_seed(0)
        learn(one, rounds[0], 200 + taken)
    assert moved(before, learner) == before.keys()
    assert moved(weights(learner), fresh) == set()
