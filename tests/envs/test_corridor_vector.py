import dataclasses

import numpy as np
import pytest

from core.neighbour_filter import filter_neighbours, quiet_sensor
from envs.config import CameraConfig, EnvConfig, FaultsConfig
from envs.corridor import CorridorEnv, CorridorVectorEnv
from envs.events import EVENT

SMALL = CameraConfig(width=16, height=16)
EMPTY = {"layout": {"num_obstacles": 0}, "camera": SMALL}
FAULTY = FaultsConfig(sparsity=0.3, background_activity=0.2, background_activity_hz=50.0)


def test_the_vector_form_gives_the_bytes_of_single_environments():
    config = EnvConfig(camera=SMALL, faults=FAULTY, time_limit_s=0.1)
    many, singles = CorridorVectorEnv(3, config), [CorridorEnv(config) for _ in range(3)]
    seeds = [5, 9, 5]
    observations, infos = many.reset(seed=seeds)
    expected = [env.reset(seed=seed) for env, seed in zip(singles, seeds, strict=True)]
    over = [False] * 3
    for actions in np.random.default_rng(0).integers(0, 3, (50, 3)):
        previous, copy = observations, observations.copy()
        observations, rewards, terminated, truncated, infos = many.step(actions)
        assert np.array_equal(previous, copy), "what was handed out is never written again"
        for i, env in enumerate(singles):
            result = (*env.reset(), 0.0, False, False) if over[i] else env.step(actions[i])
            observation, info = result[0], result[1 if over[i] else 4]
            ends = (0.0, False, False) if over[i] else result[1:4]
            assert observations[i].tobytes() == observation.tobytes()
            assert (rewards[i], terminated[i], truncated[i]) == ends
            assert {key: infos[key][i] for key in info} == info
            over[i] = ends[1] or ends[2]
    assert infos["episode_number"].tolist() == [2, 2, 2]
    assert len(expected) == 3


def test_one_seed_for_all_gives_each_environment_corridors_of_its_own():
    runners = [CorridorVectorEnv(2, camera=SMALL) for _ in range(2)]
    poles = set()
    for seed, runner in enumerate(runners):
        runner.reset(seed=seed)
        poles |= {env.scene.obstacles.tobytes() for env in runner.envs}
    assert len(poles) == 4


@pytest.mark.parametrize("count", [1, 3])
def test_the_vector_form_refuses_the_wrong_number_of_actions_and_seeds(count):
    many = CorridorVectorEnv(2, camera=SMALL)
    with pytest.raises(ValueError, match="seed"):
        many.reset(seed=[0] * count)
    many.reset(seed=0)
    with pytest.raises(ValueError, match="actions"):
        many.step(np.zeros(count, int))
    with pytest.raises(ValueError, match="num_envs"):
        CorridorVectorEnv(0)


def test_the_vector_form_serves_event_sequences_of_different_lengths():
    many = CorridorVectorEnv(2, camera=SMALL, observation="events")
    many.reset(seed=0)
    observations = many.step(np.array([0, 1]))[0]
    for env, rows in zip(many.envs, observations, strict=True):
        assert rows.dtype == np.int64
        assert np.array_equal(rows[:, 0], env.events["t"])
        assert rows.shape == (len(env.events), len(EVENT))


def test_no_environment_of_a_vector_flies_what_another_flies_later():
    several = CorridorVectorEnv(4, camera=SMALL)
    several.reset(seed=3)
    alone = CorridorEnv(camera=SMALL)
    later = set()
    alone.reset(seed=3)
    for _ in range(6):
        later.add(alone.scene.obstacles.tobytes())
        alone.reset()
    assert several.envs[0].scene.obstacles.tobytes() in later
    assert not any(env.scene.obstacles.tobytes() in later for env in several.envs[1:])


def test_several_configs_are_flown_in_turn():
    configs = [
        EnvConfig(camera=SMALL),
        EnvConfig(camera=SMALL, faults=FAULTY, scene="cones", control_hz=100.0),
    ]
    many, seeds = CorridorVectorEnv(3, configs), [4, 5, 6]
    observations = many.reset(seed=seeds)[0], many.step(np.array([0, 1, 2]))[0]
    for i, config in enumerate([configs[0], configs[1], configs[0]]):
        alone = CorridorEnv(config)
        assert observations[0][i].tobytes() == alone.reset(seed=seeds[i])[0].tobytes()
        assert observations[1][i].tobytes() == alone.step(i)[0].tobytes()


def test_configs_that_show_different_things_are_refused():
    with pytest.raises(ValueError, match="one observation space"):
        CorridorVectorEnv(2, [EnvConfig(window_capacity=8), EnvConfig(window_capacity=9)])


@pytest.mark.parametrize("memory", ["reference", "frame"])
def test_a_replay_leads_to_where_the_actions_led_and_goes_on_with_the_same_bytes(memory):
    config = EnvConfig(
        camera=CameraConfig(width=16, height=16, memory=memory), faults=FAULTY, time_limit_s=0.1
    )
    first, second = (CorridorVectorEnv(3, [config, EnvConfig(camera=SMALL)]) for _ in range(2))
    first.reset(seed=4)
    actions = np.random.default_rng(0).integers(0, 3, (60, 3))
    taken, over = [[], [], []], np.zeros(3, bool)
    for row in actions[:20]:  # some are over now, and one has just been reset
        for k in range(3):
            taken[k] = [] if over[k] else [*taken[k], row[k]]
        observations, _, terminated, truncated, infos = first.step(row)
        over = terminated | truncated
    series = infos["episode_seed"].tolist(), infos["episode_number"].tolist()
    told = second.replay(list(zip(*series, taken, strict=True)))
    assert told[0].tobytes() == observations.tobytes()
    np.testing.assert_array_equal(told[1], over)
    assert over.tolist() == [True, False, True]
    np.testing.assert_equal(told[2], infos)
    for row in actions[20:]:
        for mine, other in zip(first.step(row), second.step(row), strict=True):
            np.testing.assert_equal(mine, other)


def test_actions_that_outlast_their_episode_are_refused():
    env = CorridorVectorEnv(1, camera=SMALL, time_limit_s=0.02)
    with pytest.raises(ValueError, match="environment 0, seed 3, episode 1 ended at step 4"):
        env.replay([(3, 1, [0] * 5)])


def test_windows_without_a_capacity_hold_every_event():
    camera = CameraConfig(contrast_threshold=0.05)
    short, whole = (CorridorVectorEnv(2, camera=camera, window_capacity=most) for most in (8, None))
    for env in (short, whole):
        env.reset(seed=3)
    for _ in range(3):
        (cut, *_, infos), (windows, *_, others) = (env.step(np.array([0, 1])) for env in (short, whole))
        for row, window in enumerate(windows):
            assert len(window) - 1 == window[0, 0] == others["num_events"][row] > 8
            assert window[-8:].tobytes() == cut[row][1:].tobytes()
        assert others["dropped_events"].tolist() == [0, 0]
        np.testing.assert_array_equal(infos["dropped_events"], infos["num_events"] - 8)


def test_what_is_not_active_stays_where_it_is():
    some, alone = CorridorVectorEnv(2, camera=SMALL), CorridorEnv(camera=SMALL)
    some.reset(seed=[1, 2])
    before = some.envs[0].info()
    alone.reset(seed=2)
    for _ in range(3):
        windows, rewards, _, _, infos = some.step_some(np.array([2]), np.array([1]))
        window, reward, _, _, info = alone.step(2)
        assert windows[0].tobytes() == window.tobytes()
        assert (rewards[0], infos["x_m"][0]) == (reward, info["x_m"])
        assert some.envs[0].info() == before
        assert not some.envs[0].events.size
    with pytest.raises(ValueError, match="actions must number 2; got 1"):
        some.step_some(np.array([0]), np.array([0, 1]))


def test_what_is_observed_is_what_the_neighbour_filter_leaves():
    config = EnvConfig(camera=SMALL, faults=FAULTY, filter_support=2, filter_tau_us=4000)
    many, one = CorridorVectorEnv(2, config), CorridorEnv(config)
    observations = many.reset(seed=[3, 4])[0]
    one.reset(seed=3)
    last_us, lost = quiet_sensor(16, 16), 0
    for _ in range(20):
        observations, alone = many.step(np.zeros(2, int))[0], one.step(0)[0]
        kept = filter_neighbours(one.events, last_us, 2, 4000)
        assert np.array_equal(one.seen_events, kept)
        assert observations[0].tobytes() == alone.tobytes()
        assert alone[0, 0] == kept.size
        lost += one.events.size - kept.size
    assert lost > 0


def test_each_episode_has_the_settings_that_are_drawn_for_it_alone_or_side_by_side():
    def draw(config, rng):
        return dataclasses.replace(config, control_hz=float(rng.choice([50.0, 100.0, 400.0])))

    config = EnvConfig(camera=SMALL, time_limit_s=0.05)
    many, one = CorridorVectorEnv(2, config, draw=draw), CorridorEnv(config, draw=draw)
    many.reset(seed=[7, 8])
    one.reset(seed=7)
    met, over = set(), False
    for _ in range(120):
        assert many.envs[0].config == one.config
        met.add(one.config.control_hz)
        observations = many.step(np.zeros(2, int))[0]
        if over:
            observation, over = one.reset()[0], False
        else:
            observation, _, terminated, truncated, _ = one.step(0)
            over = terminated or truncated
        assert observations[0].tobytes() == observation.tobytes()
    assert met == {50.0, 100.0, 400.0}
