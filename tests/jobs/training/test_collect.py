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
from jobs.training.collect import EventBlock, check_policy, record
from jobs.training.real_recordings import GAP_US
from tests.support.configs import compose, small_config
from tests.support.policies import kinds, save_untrained
from tests.support.stores import place_store

STEPS = 450


def flights(steps=STEPS, **fields):
    return [(EnvConfig(observation="events", **fields), steps)]


@pytest.fixture(scope="module")
def recording():
    return record(flights(), 0, lambda count: None)[0]


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(recording):
    assert record(flights(), 0, lambda count: None)[0].events.tobytes() == recording.events.tobytes()
    assert record(flights(), 1, lambda count: None)[0].events.tobytes() != recording.events.tobytes()


def test_a_block_of_events_grows_to_all_that_was_added():
    rng, block, expected, clock_us = np.random.default_rng(0), EventBlock(), [np.empty(0, EVENT)], 0
    for size in (0, 3, 70_000, 1, 40_000, 90_000):
        parts = [np.zeros(size, EVENT), np.zeros(0, EVENT), np.zeros(2, EVENT)]
        for part in parts:
            part["t"], part["x"] = np.arange(len(part)), rng.integers(64, size=len(part))
        block.add(parts, clock_us)
        expected.append(np.concatenate(parts))
        expected[-1]["t"] += clock_us
        clock_us += 100_000
    assert block.events.tobytes() == np.concatenate(expected).tobytes()
    block.add([], 0)
    assert len(block.events) == sum(map(len, expected))


def test_what_is_recorded_before_the_faults_is_what_a_sensor_without_any_sees(recording):
    faults = FaultsConfig(sparsity=0.4, background_activity=0.2, hot_pixel_share=0.01, hot_pixel_hz=200.0)
    seen, true = record(flights(faults=faults, filter_support=1), 0, lambda count: None, keep_true=True)
    assert true.events.tobytes() == recording.events.tobytes()
    assert seen.events.tobytes() != true.events.tobytes()
    for name, places in recording.index.items():
        assert np.array_equal(seen.index[name], places)


def test_each_episode_draws_its_condition():
    conditions = [{"env.control_hz": 100.0}, {"env.control_hz": 400.0}]
    (made,) = record(flights(), 0, lambda count: None, conditions=conditions)
    lasting = made.index["step_end_us"] - made.index["step_t_us"]
    assert set(lasting) == {10_000, 2_500}
    episode = made.index["step_flight"]
    assert all(len(set(lasting[episode == number])) == 1 for number in set(episode))


def test_another_seed_flies_other_corridors(monkeypatch):
    seen = []

    def look(env, *more):
        seen.append(env.scene.obstacles.tobytes())
        return [env.events], [env.events], [5000], []

    monkeypatch.setattr(collect, "run_episode", look)
    for seed in (0, 1):
        record([(EnvConfig(observation="events"), 3)], seed, lambda count: None)
    assert len(set(seen)) == len(seen) == 6


def test_every_event_lies_in_a_step_and_no_step_spans_two_flights(recording):
    start, end, flight = (recording.index[name] for name in ("step_t_us", "step_end_us", "step_flight"))
    assert len(start) == STEPS
    assert np.all(end > start)
    same = flight[1:] == flight[:-1]
    assert np.all(start[1:][same] == end[:-1][same])
    assert np.all(start[1:][~same] == end[:-1][~same] + GAP_US)
    step = np.searchsorted(start, recording.events["t"], side="left") - 1
    assert np.all(recording.events["t"] <= end[step])


def test_events_are_in_time_order_and_on_the_sensor(recording):
    assert np.all(np.diff(recording.events["t"]) >= 0)
    assert recording.events["x"].max() < 64
    assert len(recording.events) > STEPS * 50


def test_splits_share_no_flight(recording):
    (other,) = record(flights(split="validation"), 0, lambda count: None)
    assert other.events.tobytes() != recording.events.tobytes()


def test_the_proximity_at_the_end_of_each_step_is_kept_if_asked(recording, monkeypatch):
    seen = []

    def look(scene, pose, fov_deg, sectors):
        seen.append(sector_proximity(scene, pose, fov_deg, sectors))
        return seen[-1]

    monkeypatch.setattr(collect, "sector_proximity", look)
    made = record(flights(), 0, lambda count: None, sectors=5)[0]
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
        ("trade_encoder", ["model.target=proximity"], "model.target: must be a picture"),
        ("codings", ["model.target=proximity"], "model.target: must be a picture"),
        ("probe", ["probe.targets=[proximity]"], "probe.targets: must not hold proximity"),
    ],
)
def test_studies_refuse_what_they_cannot_decode_before_anything_is_made(tmp_path, exp, words, key):
    config = parse(compose(f"+exp={exp}", *words, f"runs_dir={tmp_path}"))
    with pytest.raises(ConfigError, match=key):
        importlib.import_module(JOBS[config.job].module).run(config)
    assert not list(tmp_path.iterdir())


def test_recordings_of_real_cameras_cannot_be_decoded_into_what_only_a_simulator_knows(tmp_path):
    words = "+exp=pretrain", "model.target=proximity", "collect.recordings=[ride.npz]"
    with pytest.raises(ConfigError, match="target=occupancy"):
        collect.check_collect(locate_run(parse(compose(*words, f"runs_dir={tmp_path}"))))


def test_the_facts_name_sensor_scenes_and_faults():
    about = record(flights(faults=FaultsConfig(sparsity=0.5)), 4, lambda count: None)[0].about
    assert about["sensor"]["contrast_threshold"] == 0.2
    assert about["scenes"] == ["poles"]
    assert about["faults"][0]["sparsity"] == 0.5
    assert about["seed"] == 4


def test_a_resumed_job_works_with_the_stored_settings(tmp_path):
    config = collecting(tmp_path, None)
    stored = open_run(config)
    collect.run(dataclasses.replace(config, seed=99, resume=str(stored.path)))
    assert read_recording(stored.data / "train.h5").about["seed"] == stored.config.seed


@pytest.fixture(scope="module", params=kinds(["bytestream", "event_image", "rgb"]))
def policy(request, tmp_path_factory):
    return save_untrained(tmp_path_factory.mktemp("flown") / "policy", name=request.param)


def test_a_policy_flies_its_share_of_the_steps_in_corridors_of_its_own(policy, monkeypatch):
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
    mixed = record(flights(), 0, lambda count: None, policy, 1 / 3)[0]
    assert flown == {True: STEPS // 3, False: 2 * STEPS // 3}
    assert not corridors[True] & corridors[False]
    assert mixed.about["policy"] == str(policy)
    assert mixed.about["policy_share"] == 1 / 3
    assert len(mixed.index["step_t_us"]) == STEPS
    assert np.all(np.diff(mixed.events["t"]) >= 0)


def test_the_random_flights_are_those_of_a_recording_without_a_policy(recording, policy):
    mixed = record(flights(), 0, lambda count: None, policy, 0.5)[0]
    first = record(flights(STEPS // 2), 0, lambda count: None)[0].events
    np.testing.assert_array_equal(mixed.events[: len(first)], first)
    assert (recording.about["policy"], recording.about["policy_share"]) == (None, 0.0)


def test_a_policy_draws_its_actions_and_the_same_seed_gives_the_same_bytes(policy):
    one, again, other = (record(flights(120), seed, lambda count: None, policy, 1.0)[0] for seed in (0, 0, 1))
    assert one.events.tobytes() == again.events.tobytes() != other.events.tobytes()


def collecting(tmp_path, policy):
    place_store(tmp_path / "mlflow.db")
    config = small_config(tmp_path)
    settings = {"policy": policy and str(policy), "num_steps": 60, "num_validation_steps": 30}
    return dataclasses.replace(config, collect=dataclasses.replace(config.collect, **settings))


def test_a_path_without_a_policy_or_one_of_another_sensor_is_refused_before_anything_is_made(tmp_path):
    other = save_untrained(tmp_path / "other", EnvConfig(control_hz=100.0))
    for path, words in ((tmp_path, "a run folder or a policy folder"), (other, "control_hz = 200.0 instead")):
        with pytest.raises(ConfigError, match=f"collect.policy: .*{words}"):
            collect.run(collecting(tmp_path, path))
    assert not (tmp_path / "runs").exists()


def test_both_recordings_of_a_run_hold_flights_of_the_policy_and_it_is_not_asked_for_again(tmp_path):
    policy = save_untrained(tmp_path / "trained" / "policy")
    config = collecting(tmp_path, policy.parent)  # by its run folder
    collect.run(config)
    folder = open_run(config)
    for split in ("train", "validation"):
        about = read_recording(folder.data / f"{split}.h5").about
        assert (about["policy"], about["policy_share"]) == (str(policy), 0.5)
    (policy / "policy.json").unlink()
    assert check_policy(locate_run(config)) is None
    assert finish(folder, "collect", {}) == collect.run(config)
