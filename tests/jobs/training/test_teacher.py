import math

import numpy as np
import pytest
import torch

from envs.corridor import CorridorEnv
from jobs.training.algorithms import build_algorithm
from jobs.training.policy import policy_about, policy_spec
from jobs.training.ppo.learner import advantages, shaping
from jobs.training.sampling.corridors import corridor_settings
from jobs.training.sampling.teacher import COST_TO_GO, PricedEnvRunner
from models.policy import load_policy, save_policy
from models.policy.rllib_module import PRIVILEGED
from tests.support.configs import SHORT, make_config
from tests.support.episodes import infos_of
from tests.support.learners import learn, module_of, moved, plan_again, weights
from tests.support.runs import write_networks

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


TWICE = {"num_epochs": 2, "minibatch_size": 16}


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


def test_each_place_of_an_episode_has_its_cost_and_all_else_is_as_without_a_teacher(rolled_out, make_runner):
    config = make_config(*COLUMNS)
    plain, env = make_runner(build_algorithm(config)), CorridorEnv(corridor_settings(config)["config"])
    for episodes in rolled_out[1]:
        for episode, other in zip(episodes, plain.sample(num_timesteps=64), strict=True):
            infos = infos_of(episode)
            plan = plan_again(env, infos)
            costs = [plan.of_actions(info["x_m"], info["y_m"]).min() for info in infos]
            np.testing.assert_array_equal([info[COST_TO_GO] for info in infos], costs)
            np.testing.assert_array_equal(episode.get_observations(), other.get_observations())
            np.testing.assert_array_equal(episode.get_actions(), other.get_actions())
            np.testing.assert_array_equal(episode.get_rewards(), other.get_rewards())


def test_with_a_delay_a_cost_is_that_of_the_place_where_the_next_action_is_taken(make_runner):
    config = make_config(*COLUMNS, "env.action_delay_ms=20")
    assert policy_about(config)["world"]["action_delay_ms"] == 20.0
    runner, env = make_runner(build_algorithm(config), PricedEnvRunner), CorridorEnv()
    compared = 0
    for episode in runner.sample(num_timesteps=28):
        infos = infos_of(episode)
        plan = plan_again(env, infos)
        for info, later in zip(infos[:-5], infos[4:-1], strict=True):  # four steps of 5 ms
            assert info[COST_TO_GO] == plan.of_actions(later["x_m"], later["y_m"]).min()
            assert later["y_m"] > info["y_m"] + 0.25
            compared += 1
    assert compared > 5


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
    # The last place of each piece has no step.
    inner = np.concatenate([np.arange(len(one) + 1) < len(one) for one in episodes])
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
        save_policy(tmp_path / str(number), each.networks(), policy_spec(config), policy_about(config))
        for number, each in enumerate((one, other))
    ]
    kept = [[path.read_bytes() for path in sorted(folder.iterdir())] for folder in folders]
    assert kept[0] == kept[1]
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
    learn(learner, episodes, **TWICE)
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


def test_in_the_warm_up_only_the_value_network_learns_and_ppo_then_begins_anew(rolled_out, trained):
    env, rounds = rolled_out
    words = "train.init=X", "train.value_warmup=200"
    learner, fresh = (make_learner(env, *words, init=trained) for _ in range(2))
    before, taken = weights(learner), sum(map(len, rounds[0]))
    learn(learner, rounds[0], taken, **TWICE)
    learn(learner, rounds[1], 199 + taken, **TWICE)  # began before 200
    assert moved(before, learner) == {name for name in before if name.startswith("vf.")}
    module_of(fresh).load_state_dict(module_of(learner).state_dict())
    for one in (learner, fresh):
        torch.manual_seed(0)
        learn(one, rounds[0], 200 + taken, **TWICE)
    assert moved(before, learner) == before.keys()
    assert moved(weights(learner), fresh) == set()
