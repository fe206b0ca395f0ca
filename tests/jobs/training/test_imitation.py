import copy
import dataclasses
import math

import numpy as np
import pytest
import torch

from envs.corridor import CorridorEnv
from envs.kinematics import MIRRORED_ACTIONS
from jobs.config.config import ConfigError
from jobs.training.algorithms import build_algorithm
from jobs.training.imitation.env_runner import TaughtEnvRunner
from jobs.training.imitation.labelled_steps import COSTS, MIRRORED, LabelledSteps
from jobs.training.sampling.corridors import corridor_settings
from tests.support.configs import SHORT, make_config
from tests.support.episodes import infos_of
from tests.support.learners import (
    MODULE,
    encoder_of,
    learn,
    module_of,
    moved,
    plan_again,
    plan_of,
    weights,
    words_of,
)
from tests.support.policies import kinds

TAUGHT = *SHORT, "algo=imitation", "algo.num_env_runners=0"
WORDS = *TAUGHT, "model=event_columns", "train.env_steps=1000"
SETTINGS = ("algo.imitation.fit_steps=7", "algo.imitation.final_steps=20", "algo.minibatch_size=16")


@pytest.fixture(scope="module")
def config():
    return make_config(*WORDS, *SETTINGS, "algo.imitation.guided_batches=2")


@pytest.fixture(scope="module")
def rolled_out(config):
    """An env runner, and its rounds: of the teacher alone, half and half, and of the student alone."""
    runner = TaughtEnvRunner(config=build_algorithm(config), worker_index=0)
    rounds = [(runner.teacher_share, runner.sample(num_timesteps=140)) for _ in range(3)]
    yield runner, rounds
    runner.stop()


@pytest.fixture
def learner(config, rolled_out):
    return build_algorithm(config).build_learner(env=rolled_out[0].env)


def optimiser(learner):
    return learner.get_optimizer(MODULE).param_groups[0]


def test_a_step_carries_what_each_action_costs_where_it_began(config, rolled_out):
    env = CorridorEnv(corridor_settings(config)["config"])
    for _, episodes in rolled_out[1]:
        for episode in episodes[:2]:
            infos = infos_of(episode)
            plan = plan_again(env, infos)
            costs = np.stack([plan.of_actions(info["x_m"], info["y_m"]) for info in infos[:-1]])
            expected = (costs - costs.min(axis=1, keepdims=True)).astype(np.float32)
            np.testing.assert_array_equal(episode.get_extra_model_outputs(COSTS), expected)


def test_the_teacher_acts_in_half_as_many_steps_of_each_batch_and_then_in_none(rolled_out):
    shares = [share for share, _ in rolled_out[1]]
    assert shares == [1.0, 0.5, 0.0]
    found = []
    for _, episodes in rolled_out[1]:
        costs = np.concatenate([episode.get_extra_model_outputs(COSTS) for episode in episodes])
        actions = np.concatenate([episode.get_actions() for episode in episodes])
        found.append(np.mean(actions == costs.argmin(axis=1)))
    assert found[0] == 1.0
    assert found[1] == pytest.approx(0.5 + 0.5 * found[2], abs=0.2)


def test_the_loss_is_the_cross_entropy_of_the_labels(learner, rolled_out):
    rows = learner._rows(rolled_out[1][2][1])
    module = module_of(learner)
    loss, figures = learner._loss(module, rows)
    logits = module._forward(rows)["action_dist_inputs"].double()
    weights = torch.exp(-rows[COSTS].double() / 0.003)
    labels = weights / weights.sum(1, keepdim=True)
    expected = -(labels * (logits - logits.exp().sum(1, keepdim=True).log())).sum(1).mean()
    assert float(loss.detach()) == pytest.approx(float(expected), rel=1e-5)
    assert 0.0 < float(figures["entropy"]) < math.log(3) + 1e-6
    loss.backward()
    gradients = {name: value.grad for name, value in module.named_parameters()}
    assert {name for name, value in gradients.items() if value is None} == {
        n for n in gradients if n.startswith("vf.")
    }


def test_steps_of_all_batches_are_learnt_from_and_none_is_kept_after_the_last(
    learner, rolled_out, monkeypatch
):
    drawn = []
    step = learner._step

    def watched(rows):
        drawn.append((len(rows[COSTS]), float(optimiser(learner)["lr"])))
        return step(rows)

    monkeypatch.setattr(learner, "_step", watched)
    steps = [sum(map(len, batch)) for _, batch in rolled_out[1]]
    for k, (_, batch) in enumerate(rolled_out[1]):
        told = learn(learner, batch, 999 if k < 2 else 1000, minibatch_size=16)
        assert len(learner._steps) == (sum(steps[: k + 1]) if k < 2 else 0)
    assert len(drawn) == 2 * 7 + 20
    assert {size for size, _ in drawn} == {16}
    rates = [rate for _, rate in drawn]
    assert set(rates[:14]) == {1e-3}
    np.testing.assert_allclose(rates[14:], 1e-3 * (1.0 - np.arange(20) / 20))
    assert 0.0 <= told["agreement"] <= 1.0


def test_after_the_last_batch_the_networks_begin_anew(config, rolled_out):
    """What was learnt from the batches before leaves no trace but their steps."""
    (_, first), (_, last), *_ = rolled_out[1]
    before, after = [], []
    for rate in (1e-3, 1e-5):
        learner = build_algorithm(config).build_learner(env=rolled_out[0].env)
        optimiser(learner)["lr"] = rate
        for seed, episodes, sampled, found in ((1, first, 1, before), (2, last, 1000, after)):
            torch.manual_seed(seed)
            learn(learner, episodes, sampled, minibatch_size=16)
            found.append(weights(learner))
    assert any(not torch.equal(value, before[1][name]) for name, value in before[0].items())
    for name, value in after[0].items():
        torch.testing.assert_close(value, after[1][name], rtol=0, atol=0)


@pytest.mark.parametrize("name", kinds(["bytestream", "event_set", "rgb", "own"], quick=("own",)))
def test_mirrored_steps_are_what_the_policy_would_keep_of_mirrored_observations(name, tmp_path, make_runner):
    """And nothing else is rolled out than without them; RLlib's own pieces are cut alike."""
    own = "model=event_columns", "model.own_actions=true", "model.own_velocity=true"
    told = {}
    for mirrored in (False, True):
        config = make_config(
            *TAUGHT, *(own if name == "own" else words_of(name)), f"algo.mirrored={mirrored}"
        )
        encoder = encoder_of(config, tmp_path)
        runner, shown = make_runner(build_algorithm(config, encoder)), []

        def watched(observations, first, taken, runner=runner, shown=shown, remember=runner._remember):
            own = [np.array(MIRRORED_ACTIONS)[taken]]
            own += [] if name != "own" else [runner.velocities_mps() * [-1.0, 1.0]]
            shown.append((copy.deepcopy(observations), first.copy(), *own))
            remember(observations, first, taken)

        runner._remember = watched
        torch.manual_seed(1)
        told[mirrored] = runner.sample(num_timesteps=60)
    for one, other in zip(*told.values(), strict=True):
        np.testing.assert_array_equal(one.get_observations(), other.get_observations())
        np.testing.assert_array_equal(one.get_actions(), other.get_actions())
        assert MIRRORED not in one.extra_model_outputs
    seen = np.concatenate([episode.get_observations()[:-1] for episode in told[True]])
    kept, met = np.zeros((len(shown[0][1]), *seen.shape[1:]), seen.dtype), len(runner.shown.windows)
    expected = []
    for observations, first, *own in shown:
        kept = runner.module.remember(kept, observations, first, *own, mirrored=True)
        expected.append(kept)
    assert len(runner.shown.windows) == met
    expected = {row.tobytes() for step in expected for row in step}
    found = np.concatenate([episode.get_extra_model_outputs(MIRRORED) for episode in told[True]])
    assert {row.tobytes() for row in found} <= expected
    assert not np.array_equal(found, seen)


def test_a_mirrored_step_is_learnt_with_the_costs_of_the_mirrored_actions(make_runner):
    built = build_algorithm(make_config(*WORDS, *SETTINGS, "algo.mirrored=true"))
    runner = make_runner(built)
    learner, episodes = built.build_learner(env=runner.env), runner.sample(num_timesteps=140)
    rows = learner._rows(episodes)
    learn(learner, episodes, minibatch_size=16)
    lessons, count = learner._steps.arrays(), len(rows[COSTS])
    assert lessons["seen"] == 2 * count
    np.testing.assert_array_equal(lessons["stacks"][:count], rows["obs"])
    np.testing.assert_array_equal(lessons["stacks"][count:], rows[MIRRORED])
    np.testing.assert_array_equal(lessons["costs"][:count, [0, 2, 1]], lessons["costs"][count:])


def test_the_teacher_of_the_mirrored_scene_teaches_the_mirrored_actions(config):
    env = CorridorEnv(corridor_settings(config)["config"])
    env.reset(seed=3)
    turned = env.scene.obstacles.copy()
    turned["x"] *= -1.0
    plan = plan_of(env)
    mirrored = plan_of(env, dataclasses.replace(env.scene, obstacles=turned))
    rng = np.random.default_rng(0)
    for x_m, y_m in zip(rng.uniform(-12.0, 12.0, 200), rng.uniform(0.0, 95.0, 200), strict=True):
        costs, turned_costs = plan.of_actions(x_m, y_m), mirrored.of_actions(-x_m, y_m)
        np.testing.assert_allclose(costs[MIRRORED_ACTIONS], turned_costs, rtol=1e-9)


@pytest.mark.parametrize("word", ["algo.mirrored=true", "algo.teacher_sight_m=20"])
def test_without_a_teacher_nothing_can_be_asked_of_it(word):
    with pytest.raises(ConfigError, match=f"{word[5:10]}.*algo[.=]imitation"):
        make_config("algo=ppo", word)


def test_a_teacher_of_limited_sight_says_what_a_way_so_far_costs(make_runner):
    runner = make_runner(build_algorithm(make_config(*WORDS, "algo.teacher_sight_m=5")))
    runner.sample(num_timesteps=64)
    for env, costs in zip(runner.env.unwrapped.envs, runner.costs(), strict=True):
        plan = plan_of(env)
        expected = plan.of_actions(*env.place_of_action(), 5.0)
        np.testing.assert_array_equal(costs, expected)
        assert (expected < plan.of_actions(*env.place_of_action())).all()


def rows_of(first, count):
    numbers = np.arange(first, first + count)
    stacks, costs = (np.stack([numbers] * 3, 1).astype(dtype) for dtype in (np.int16, np.float32))
    return {"stacks": stacks, "costs": costs}


def test_lessons_are_all_kept_up_to_a_bound_and_beyond_it_a_fair_sample():
    lessons = LabelledSteps(100 * (3 * 2 + 3 * 4))
    torch.manual_seed(0)
    for first in range(0, 80, 16):
        lessons.add(**rows_of(first, 16))
    np.testing.assert_array_equal(lessons.arrays()["costs"][:, 0], np.arange(80))
    counts = np.zeros(400)
    for _ in range(50):
        lessons = LabelledSteps(100 * (3 * 2 + 3 * 4))
        for first in range(0, 400, 50):
            lessons.add(**rows_of(first, 50))
        kept = lessons.arrays()["costs"][:, 0].astype(int)
        assert len(lessons) == len(set(kept)) == 100
        counts[kept] += 1
    assert abs(counts[:200].mean() / 12.5 - 1) < 0.05
    assert counts.min() > 0
    assert counts.max() < 30
    again = LabelledSteps(lessons.most_bytes)
    again.load(lessons.arrays())
    for one in (lessons, again):
        torch.manual_seed(5)
        one.add(**rows_of(400, 70))
    assert lessons.seen == again.seen == 470
    np.testing.assert_array_equal(lessons.arrays()["costs"], again.arrays()["costs"])
    drawn = again.draw(5)
    assert all(torch.equal(drawn["obs"][:, k].float(), drawn[COSTS][:, k]) for k in range(3))


@pytest.mark.parametrize(
    "name", kinds(["bytestream", "event_set", "rgb", "finetuned"], quick=("bytestream",))
)
def test_a_policy_learns_what_the_teacher_says(name, tmp_path, make_runner):
    config = make_config(*TAUGHT, *words_of(name), "algo.imitation.fit_steps=20", "algo.lr=3e-3")
    built = build_algorithm(config, encoder_of(config, tmp_path))
    runner = make_runner(built)
    learner, episodes = built.build_learner(env=runner.env), runner.sample(num_timesteps=64)
    before = weights(learner)
    losses = [learn(learner, episodes, minibatch_size=64)["policy_loss"] for _ in range(5)]
    assert losses[-1] < 0.95 * losses[0]
    assert moved(before, learner) >= {name for name in before if name.startswith("pi.")}
