import copy
import dataclasses
import math

import numpy as np
import pytest
import torch

from envs.corridor import CorridorEnv
from envs.kinematics import MIRRORED_ACTIONS
from envs.scene.planning import cost_to_go
from jobs.config.config import ConfigError
from jobs.training.algorithms import build_algorithm
from jobs.training.imitation.env_runner import TaughtEnvRunner
from jobs.training.imitation.labelled_steps import COSTS, MIRRORED, LabelledSteps
from jobs.training.sampling.corridors import corridor_settings
from models.kinds import KINDS
from tests.support.configs import SHORT, make_config
from tests.support.episodes import infos_of
from tests.support.policies import TRAINED, kinds
from tests.support.runs import write_encoder

WORDS = (*SHORT, "algo=imitation", "model=event_columns", "algo.num_env_runners=0", "train.env_steps=1000")
SETTINGS = ("algo.imitation.fit_steps=7", "algo.imitation.final_steps=20", "algo.minibatch_size=16")
SAMPLED = "num_env_steps_sampled_lifetime"


@pytest.fixture(scope="module")
def config():
    return make_config(*WORDS, *SETTINGS, "algo.imitation.guided_batches=2")


@pytest.fixture(scope="module")
def rolled_out(config):
    """An env runner, and its rounds: of the teacher alone, half and half, and of the student alone."""
    runner = TaughtEnvRunner(config=build_algorithm(config), worker_index=0)
    rounds = [(runner.teacher_share, runner.sample(num_timesteps=140)) for _ in range(4)]
    yield runner, rounds
    runner.stop()


@pytest.fixture
def learner(config, rolled_out):
    return build_algorithm(config).build_learner(env=rolled_out[0].env)


def optimiser(learner):
    return learner.get_optimizer("default_policy").param_groups[0]


def test_a_step_carries_what_each_action_costs_where_it_began(config, rolled_out):
    env = CorridorEnv(corridor_settings(config)["config"])
    for _, episodes in rolled_out[1]:
        for episode in episodes[:6]:
            infos = infos_of(episode)
            env.reset(
                seed=int(infos[0]["episode_seed"]),
                options={"episode_number": int(infos[0]["episode_number"])},
            )
            plan = cost_to_go(env.scene, env.config.vehicle_radius_m, env.config.camera_height_m)
            costs = np.stack([plan.of_actions(info["x_m"], info["y_m"]) for info in infos[:-1]])
            expected = (costs - costs.min(axis=1, keepdims=True)).astype(np.float32)
            np.testing.assert_array_equal(episode.get_extra_model_outputs(COSTS), expected)


def test_the_teacher_acts_in_half_as_many_steps_of_each_batch_and_then_in_none(rolled_out):
    shares = [share for share, _ in rolled_out[1]]
    assert shares == [1.0, 0.5, 0.0, 0.0]
    found = []
    for _, episodes in rolled_out[1]:
        costs = np.concatenate([episode.get_extra_model_outputs(COSTS) for episode in episodes])
        actions = np.concatenate([episode.get_actions() for episode in episodes])
        found.append(np.mean(actions == costs.argmin(axis=1)))
    assert found[0] == 1.0
    assert found[1] == pytest.approx(0.5 + 0.5 * found[2], abs=0.2)


def test_the_loss_is_the_cross_entropy_of_the_labels(learner, rolled_out):
    rows = learner._rows(rolled_out[1][2][1])
    module = learner.module["default_policy"].unwrapped()
    loss, figures = learner._loss(module, rows)
    logits = module._forward(rows)["action_dist_inputs"].double()
    weights = torch.exp(-rows[COSTS].double() / 0.003)
    labels = weights / weights.sum(1, keepdim=True)
    expected = -(labels * (logits - logits.exp().sum(1, keepdim=True).log())).sum(1).mean()
    assert float(loss.detach()) == pytest.approx(float(expected), rel=1e-5)
    assert 0.0 < float(figures["entropy"]) < math.log(3) + 1e-6
    loss.backward()
    gradients = {name: value.grad for name, value in learner.module["default_policy"].named_parameters()}
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
    episodes = [copy.deepcopy(episodes) for _, episodes in rolled_out[1]]
    steps = [sum(map(len, batch)) for batch in episodes]
    for k, batch in enumerate(episodes):
        told = learner.update(episodes=batch, timesteps={SAMPLED: 999 if k < 3 else 1000}, minibatch_size=16)
        assert len(learner._steps) == (sum(steps[: k + 1]) if k < 3 else 0)
    assert len(drawn) == 3 * 7 + 20
    assert {size for size, _ in drawn} == {16}
    rates = [rate for _, rate in drawn]
    assert set(rates[:21]) == {1e-3}
    np.testing.assert_allclose(rates[21:], 1e-3 * (1.0 - np.arange(20) / 20))
    assert 0.0 <= float(told["default_policy"]["agreement"].peek()) <= 1.0


def test_after_the_last_batch_the_networks_begin_anew(config, rolled_out):
    """What was learnt from the batches before leaves no trace but their steps."""
    episodes = [copy.deepcopy(episodes) for _, episodes in rolled_out[1][:2]]
    weights, rates = [], (1e-3, 1e-5)
    for rate in rates:
        learner = build_algorithm(config).build_learner(env=rolled_out[0].env)
        first = copy.deepcopy(learner.module["default_policy"].state_dict())
        optimiser(learner)["lr"] = rate
        torch.manual_seed(1)
        learner.update(episodes=copy.deepcopy(episodes[0]), timesteps={SAMPLED: 1}, minibatch_size=16)
        before = copy.deepcopy(learner.module["default_policy"].state_dict())
        assert any(not torch.equal(first[name], value) for name, value in before.items())
        torch.manual_seed(2)
        learner.update(episodes=copy.deepcopy(episodes[1]), timesteps={SAMPLED: 1000}, minibatch_size=16)
        weights.append((before, learner.module["default_policy"].state_dict()))
    assert any(not torch.equal(weights[0][0][name], weights[1][0][name]) for name in first)
    for name, value in weights[0][1].items():
        torch.testing.assert_close(value, weights[1][1][name], rtol=0, atol=0)


def test_labels_are_learnt(learner, rolled_out):
    _, episodes = rolled_out[1][0]
    losses = []
    for _ in range(30):
        told = learner.update(episodes=copy.deepcopy(episodes), timesteps={SAMPLED: 1}, minibatch_size=64)
        losses.append(float(told["default_policy"]["policy_loss"].peek()))
    assert losses[-1] < 0.8 * losses[0]


@pytest.mark.parametrize("name", kinds([*TRAINED, "own"], quick=("own",)))
def test_mirrored_steps_are_what_the_policy_would_keep_of_mirrored_observations(name, tmp_path, monkeypatch):
    """And nothing else is rolled out than without them; RLlib's own pieces are cut alike."""
    own = {
        "finetuned": ("model.encoder=finetuned",),
        "own": ("model=event_columns", "model.own_actions=true", "model.own_velocity=true"),
    }.get(name, (f"model={name}",))
    told = {}
    for mirrored in (False, True):
        config = make_config(
            *SHORT, "algo=imitation", "algo.num_env_runners=0", *own, f"algo.mirrored={mirrored}"
        )
        encoder = write_encoder(tmp_path, config) if KINDS[config.model.name].encoder else None
        runner = TaughtEnvRunner(config=build_algorithm(config, encoder), worker_index=0)
        shown = []
        remember = type(runner)._remember

        def watched(self, observations, first, taken, shown=shown, remember=remember):
            own = [np.array(MIRRORED_ACTIONS)[taken]]
            own += [] if name != "own" else [self.velocities_mps() * [-1.0, 1.0]]
            shown.append((copy.deepcopy(observations), first.copy(), *own))
            remember(self, observations, first, taken)

        monkeypatch.setattr(runner, "_remember", watched.__get__(runner))
        torch.manual_seed(1)
        told[mirrored] = runner.sample(num_timesteps=100)
        runner.stop()
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


def test_a_mirrored_step_is_learnt_with_the_costs_of_the_mirrored_actions(rolled_out):
    config = make_config(*WORDS, *SETTINGS, "algo.mirrored=true")
    runner = TaughtEnvRunner(config=build_algorithm(config), worker_index=0)
    learner = build_algorithm(config).build_learner(env=runner.env)
    episodes = runner.sample(num_timesteps=140)
    runner.stop()
    rows = learner._rows(episodes)
    learner.update(episodes=episodes, timesteps={SAMPLED: 1}, minibatch_size=16)
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
    mirrored = dataclasses.replace(env.scene, obstacles=turned)
    plans = [
        cost_to_go(one, env.config.vehicle_radius_m, env.config.camera_height_m)
        for one in (env.scene, mirrored)
    ]
    rng = np.random.default_rng(0)
    for x_m, y_m in zip(rng.uniform(-12.0, 12.0, 200), rng.uniform(0.0, 95.0, 200), strict=True):
        costs, turned_costs = plans[0].of_actions(x_m, y_m), plans[1].of_actions(-x_m, y_m)
        np.testing.assert_allclose(costs[MIRRORED_ACTIONS], turned_costs, rtol=1e-9)


@pytest.mark.parametrize("word", ["algo.mirrored=true", "algo.teacher_sight_m=20"])
def test_without_a_teacher_nothing_can_be_asked_of_it(word):
    with pytest.raises(ConfigError, match=f"{word[5:10]}.*algo[.=]imitation"):
        make_config("algo=ppo", word)


def test_a_teacher_of_limited_sight_says_what_a_way_so_far_costs():
    config = make_config(*WORDS, *SETTINGS, "algo.teacher_sight_m=5")
    runner = TaughtEnvRunner(config=build_algorithm(config), worker_index=0)
    runner.sample(num_timesteps=64)
    for row, costs in enumerate(runner.costs()):
        env = runner.env.unwrapped.envs[row]
        plan = cost_to_go(env.scene, env.config.vehicle_radius_m, env.config.camera_height_m)
        expected = plan.of_actions(*env.place_of_action(), 5.0)
        np.testing.assert_array_equal(costs, expected)
        assert (expected < plan.of_actions(*env.place_of_action())).all()
    runner.stop()


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
    for _ in range(100):
        lessons = LabelledSteps(100 * (3 * 2 + 3 * 4))
        for first in range(0, 400, 50):
            lessons.add(**rows_of(first, 50))
        kept = lessons.arrays()["costs"][:, 0].astype(int)
        assert len(lessons) == len(set(kept)) == 100
        counts[kept] += 1
    assert abs(counts[:200].mean() / 25 - 1) < 0.05
    assert counts.min() > 5
    assert counts.max() < 50
    drawn = lessons.draw(5)
    assert all(torch.equal(drawn["obs"][:, k].float(), drawn[COSTS][:, k]) for k in range(3))


@pytest.mark.parametrize("seen", [0, 60, 150])
def test_lessons_go_on_from_their_arrays(seen):
    lessons, again = LabelledSteps(100 * (3 * 2 + 3 * 4)), LabelledSteps(100 * (3 * 2 + 3 * 4))
    if seen:
        lessons.add(**rows_of(0, seen))
    again.load(lessons.arrays())
    for one in (lessons, again):
        torch.manual_seed(5)
        one.add(**rows_of(seen, 70))
    assert lessons.seen == again.seen == seen + 70
    for name, value in lessons.arrays().items():
        np.testing.assert_array_equal(value, again.arrays()[name])


@pytest.mark.parametrize("name", kinds(TRAINED, quick=("bytestream",)))
def test_every_kind_of_policy_can_be_taught(name, tmp_path):
    own = "model.encoder=finetuned" if name == "finetuned" else f"model={name}"
    few = "algo.imitation.fit_steps=2", "algo.minibatch_size=8"
    config = make_config(*SHORT, "algo=imitation", "algo.num_env_runners=0", own, *few)
    ppo = build_algorithm(
        config, write_encoder(tmp_path, config) if KINDS[config.model.name].encoder else None
    )
    runner = TaughtEnvRunner(config=ppo, worker_index=0)
    learner = ppo.build_learner(env=runner.env)
    before = [value.clone() for value in learner.module["default_policy"].pi.parameters()]
    learner.update(episodes=runner.sample(num_timesteps=16), timesteps={SAMPLED: 16}, minibatch_size=8)
    after = list(learner.module["default_policy"].pi.parameters())
    assert all(not torch.equal(one, other) for one, other in zip(before, after, strict=True))
    runner.stop()
