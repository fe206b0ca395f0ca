import dataclasses
import importlib

import numpy as np
import pytest

from envs.config import EnvConfig, FaultsConfig
from envs.corridor import CorridorEnv
from envs.events import EVENT
from envs.recordings import read_recording
from envs.scene import ELLIPSOID, OBSTACLE, Scene, at_velocity
from envs.scene.paths import bodies_at
from envs.scene.range_scan import sector_proximity
from jobs.config.config import ConfigError, parse
from jobs.config.registry import JOBS
from jobs.rollout.agents import PolicyAgent
from jobs.run.folder import finish, locate_run, open_run
from jobs.training import collect
from jobs.training.collect import EventBlock, check_collect, record
from jobs.training.real_recordings import GAP_US
from tests.support.configs import compose, small_config
from tests.support.policies import kinds, save_untrained
from tests.support.stores import place_store

STEPS = 450


def recorded(steps=STEPS, seed=0, env=(), **more):
    """What is recorded of some steps of one environment."""
    shares = [(EnvConfig(observation="events", **dict(env)), steps)]
    return record(shares, seed, lambda count: None, **more)


@pytest.fixture(scope="module")
def recording():
    return recorded()[0]


def test_the_same_seed_gives_the_same_bytes(recording):
    assert recorded()[0].events.tobytes() == recording.events.tobytes()


def test_a_block_of_events_grows_to_all_that_was_added():
    rng, block, expected = np.random.default_rng(0), EventBlock(), [np.empty(0, EVENT)]
    for clock_us, size in enumerate((0, 70_000, 1, 90_000)):
        parts = [np.zeros(size, EVENT), np.zeros(0, EVENT), np.zeros(2, EVENT)]
        for part in parts:
            part["t"], part["x"] = np.arange(len(part)), rng.integers(64, size=len(part))
        block.add(parts, 100_000 * clock_us)
        expected.append(np.concatenate(parts))
        expected[-1]["t"] += 100_000 * clock_us
    block.add([], 0)
    assert block.events.tobytes() == np.concatenate(expected).tobytes()


def test_what_is_recorded_before_the_faults_is_what_a_sensor_without_any_sees(recording):
    faults = FaultsConfig(sparsity=0.4, background_activity=0.2, hot_pixel_share=0.01, hot_pixel_hz=200.0)
    seen, true = recorded(env={"faults": faults, "filter_support": 1}, keep_true=True)
    assert true.events.tobytes() == recording.events.tobytes()
    assert seen.events.tobytes() != true.events.tobytes()
    for name, places in recording.index.items():
        assert np.array_equal(seen.index[name], places)
    assert seen.about["faults"][0]["sparsity"] == 0.4


def test_each_episode_draws_its_condition():
    conditions = [{"env.control_hz": 100.0}, {"env.control_hz": 400.0}]
    (made,) = recorded(conditions=conditions)
    lasting = made.index["step_end_us"] - made.index["step_t_us"]
    assert set(lasting) == {10_000, 2_500}
    episode = made.index["step_flight"]
    assert all(len(set(lasting[episode == number])) == 1 for number in set(episode))


def test_no_corridor_is_flown_twice_nor_with_another_seed_nor_in_another_split(monkeypatch):
    seen = []

    def look(env, *more):
        seen.append(env.scene.obstacles.tobytes())
        return [env.events], [env.events], [5000], []

    monkeypatch.setattr(collect, "run_episode", look)
    for seed, split in ((0, "train"), (1, "train"), (0, "validation")):
        recorded(3, seed, {"split": split})
    assert len(set(seen)) == len(seen) == 9


def test_events_are_in_time_order_in_steps_on_the_sensor_and_no_step_spans_two_flights(recording):
    start, end, flight = (recording.index[name] for name in ("step_t_us", "step_end_us", "step_flight"))
    assert len(start) == STEPS
    assert np.all(end > start)
    same = flight[1:] == flight[:-1]
    assert np.all(start[1:][same] == end[:-1][same])
    assert np.all(start[1:][~same] == end[:-1][~same] + GAP_US)
    step = np.searchsorted(start, recording.events["t"], side="left") - 1
    assert step.min() >= 0
    assert np.all(recording.events["t"] <= end[step])
    assert np.all(np.diff(recording.events["t"]) >= 0)
    assert recording.events["x"].max() < 64
    assert len(recording.events) > STEPS * 50


def test_the_proximity_at_the_end_of_each_step_is_kept_if_asked(recording, monkeypatch):
    seen = []

    def look(scene, pose, fov_deg, sectors):
        seen.append(sector_proximity(scene, pose, fov_deg, sectors))
        return seen[-1]

    monkeypatch.setattr(collect, "sector_proximity", look)
    made = recorded(sectors=5)[0]
    kept = made.index["step_proximity"].reshape(STEPS, 5) / collect.PROXIMITY_ONE
    np.testing.assert_allclose(kept, np.stack(seen), atol=1e-5)
    assert kept.max() > 0.5
    assert made.events.tobytes() == recording.events.tobytes()
    assert "step_proximity" not in recording.index


def test_what_moves_is_near_where_it_is_at_the_end_of_a_step():
    ball = np.array([(ELLIPSOID, -40.0, 20.0, 2.0, 1.0, 1.0, 1.0, 0.5)], OBSTACLE)[0]
    scene = Scene("lane", np.zeros(0, OBSTACLE), moving=(at_velocity(ball, (20.0, 0.0, 0.0)),))
    for t_s, sector in ((1.0, 0), (2.0, 1), (3.0, 2)):  # at x = -20, 0 and 20 m, 20 m ahead
        seen = collect.at_rest(scene, bodies_at(scene.moving, t_s))
        near = sector_proximity(seen, (0.0, 0.0, 2.0, 0.0), 100.0, 3)
        assert near.argmax() == sector
        assert near.max() > 0.05
        assert np.count_nonzero(near) == 1
    assert collect.at_rest(scene, np.empty(0, OBSTACLE)) is scene


@pytest.mark.parametrize(
    ("exp", "words", "key"),
    [
        ("trade_encoder", "model.target=proximity", "model.target: must be a picture"),
        ("codings", "model.target=proximity", "model.target: must be a picture"),
        ("probe", "probe.targets=[proximity]", "probe.targets: must not hold proximity"),
        ("pretrain", "model.target=proximity collect.recordings=[ride.npz]", "target=occupancy"),
    ],
)
def test_what_only_a_simulator_knows_is_refused_where_it_is_not_known_before_anything_is_made(
    tmp_path, exp, words, key
):
    config = parse(compose(f"+exp={exp}", *words.split(), f"runs_dir={tmp_path}"))
    with pytest.raises(ConfigError, match=key):
        importlib.import_module(JOBS[config.job].module).run(config)
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module", params=kinds(["bytestream", "rgb"]))
def policy(request, tmp_path_factory):
    return save_untrained(tmp_path_factory.mktemp("flown") / "policy", name=request.param)


def test_a_policy_flies_its_share_in_corridors_of_its_own_and_the_rest_is_as_without(
    recording, policy, monkeypatch
):
    flown, corridors, step = {True: 0, False: 0}, {True: set(), False: set()}, CorridorEnv.step
    of_policy = None

    def fly(env, agent, *more):
        nonlocal of_policy
        of_policy = isinstance(agent, PolicyAgent)
        return run_episode(env, agent, *more)

    def count(env, action):
        flown[of_policy] += 1
        corridors[of_policy].add(env.scene.obstacles.tobytes())
        return step(env, action)

    run_episode = collect.run_episode
    monkeypatch.setattr(collect, "run_episode", fly)
    monkeypatch.setattr(CorridorEnv, "step", count)
    (mixed,) = recorded(policy=policy, policy_share=1 / 3)
    assert flown == {True: STEPS // 3, False: 2 * STEPS // 3}
    assert not corridors[True] & corridors[False]
    assert (mixed.about["policy"], mixed.about["policy_share"]) == (str(policy), 1 / 3)
    assert (recording.about["policy"], recording.about["policy_share"]) == (None, 0.0)
    random = recording.count_until(recording.index["step_end_us"][flown[False] - 1])
    np.testing.assert_array_equal(mixed.events[:random], recording.events[:random])


def test_a_policy_draws_its_actions_and_the_same_seed_gives_the_same_bytes(policy):
    one, again, other = (recorded(60, seed, policy=policy, policy_share=1.0)[0] for seed in (0, 0, 1))
    assert one.events.tobytes() == again.events.tobytes() != other.events.tobytes()


def collecting(tmp_path, policy):
    config = small_config(tmp_path)
    settings = {"policy": policy and str(policy), "num_steps": 60, "num_validation_steps": 30}
    return dataclasses.replace(config, collect=dataclasses.replace(config.collect, **settings))


def test_a_path_without_a_policy_or_one_of_another_sensor_is_refused_before_anything_is_made(tmp_path):
    other = save_untrained(tmp_path / "other", EnvConfig(control_hz=100.0))
    for path, words in ((tmp_path, "a run folder or a policy folder"), (other, "control_hz = 200.0 instead")):
        with pytest.raises(ConfigError, match=f"collect.policy: .*{words}"):
            collect.run(collecting(tmp_path, path))
    assert not (tmp_path / "runs").exists()


def test_a_resumed_run_flies_its_stored_policy_in_both_recordings_and_asks_for_it_only_once(tmp_path):
    policy = save_untrained(tmp_path / "trained" / "policy")
    config = collecting(tmp_path, policy.parent)  # by its run folder
    place_store(tmp_path / "mlflow.db")
    folder = open_run(config)
    collect.run(dataclasses.replace(config, seed=99, resume=str(folder.path)))
    for split in ("train", "validation"):
        about = read_recording(folder.data / f"{split}.h5").about
        assert (about["policy"], about["policy_share"]) == (str(policy), 0.5)
        assert about["seed"] == config.seed  # the stored one
    (policy / "policy.json").unlink()
    assert check_collect(locate_run(config)) == (None, [])
    assert finish(folder, "collect", {}) == collect.run(config)
