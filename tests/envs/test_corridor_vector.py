import dataclasses

import numpy as np
import pytest

from core.neighbour_filter import filter_neighbours, quiet_sensor
from envs.config import CameraConfig, EnvConfig, FaultsConfig
from envs.corridor import CorridorEnv, CorridorVectorEnv
from envs.events import EVENT

SMALL = CameraConfig(width=16, height=16)
FAULTY = FaultsConfig(sparsity=0.3, background_activity=0.2, background_activity_hz=50.0)


def test_the_vector_form_gives_the_bytes_of_single_environments_whose_configs_it_takes_in_turn():
    faulty = EnvConfig(camera=SMALL, faults=FAULTY, time_limit_s=0.1)
    late = EnvConfig(camera=SMALL, scene="cones", control_hz=100.0, action_delay_ms=40.0, time_limit_s=0.1)
    many, singles = CorridorVectorEnv(3, [faulty, late]), [CorridorEnv(one) for one in (faulty, late, faulty)]
    seeds = [5, 9, 5]
    observations, _ = many.reset(seed=seeds)
    for env, seed, observation in zip(singles, seeds, observations, strict=True):
        assert env.reset(seed=seed)[0].tobytes() == observation.tobytes()
    over = [False] * 3
    for actions in np.random.default_rng(0).integers(0, 3, (45, 3)):
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
    assert infos["episode_number"].tolist() == [2, 4, 2]


def test_each_environment_of_each_seed_flies_corridors_of_its_own():
    many, found = CorridorVectorEnv(3, camera=SMALL), set()
    for seed, number in np.ndindex(2, 2):
        many.reset(seed=seed, options={"episode_number": number})
        found |= {env.scene.obstacles.tobytes() for env in many.envs}
    assert len(found) == 12


def test_wrong_numbers_of_things_and_configs_that_do_not_fit_together_are_refused():
    many = CorridorVectorEnv(2, camera=SMALL, time_limit_s=0.02)
    with pytest.raises(ValueError, match="seed must be one number or 2"):
        many.reset(seed=[0] * 3)
    many.reset(seed=0)
    with pytest.raises(ValueError, match="actions must number 2"):
        many.step(np.zeros(3, int))
    with pytest.raises(ValueError, match="actions must number 2; got 1"):
        many.step_some(np.array([0]), np.array([0, 1]))
    with pytest.raises(ValueError, match="environment 0, seed 3, episode 1 ended at step 4"):
        many.replay([(3, 1, [0] * 5), (3, 1, [])])
    with pytest.raises(ValueError, match="num_envs"):
        CorridorVectorEnv(0)
    with pytest.raises(ValueError, match="one observation space"):
        CorridorVectorEnv(2, [EnvConfig(window_capacity=8), EnvConfig(window_capacity=9)])


def test_the_vector_form_serves_event_sequences_of_different_lengths():
    many = CorridorVectorEnv(2, camera=SMALL, observation="events")
    many.reset(seed=0)
    observations = many.step(np.array([0, 1]))[0]
    for env, rows in zip(many.envs, observations, strict=True):
        assert rows.dtype == np.int64
        assert np.array_equal(rows[:, 0], env.events["t"])
        assert rows.shape == (len(env.events), len(EVENT))


def test_a_replay_leads_to_where_the_actions_led_and_goes_on_with_the_same_bytes():
    faulty = EnvConfig(camera=SMALL, faults=FAULTY, time_limit_s=0.1, action_delay_ms=15.0)
    by_frames = EnvConfig(camera=dataclasses.replace(SMALL, memory="frame"))
    first, second = (CorridorVectorEnv(3, [faulty, by_frames]) for _ in range(2))
    first.reset(seed=4)
    actions = np.random.default_rng(0).integers(0, 3, (45, 3))
    taken, over = [[], [], []], np.zeros(3, bool)
    for row in actions[:20]:  # the first and the last are over now
        for k in range(3):
            taken[k] = [] if over[k] else [*taken[k], row[k]]
        observations, _, terminated, truncated, infos = first.step(row)
        over = terminated | truncated
    series = infos["episode_seed"].tolist(), infos["episode_number"].tolist()
    told = second.replay(list(zip(*series, taken, strict=True)))
    assert told[0].tobytes() == observations.tobytes()
    assert over.tolist() == told[1].tolist() == [True, False, True]
    np.testing.assert_equal(told[2], infos)
    for row in actions[20:]:
        for mine, other in zip(first.step(row), second.step(row), strict=True):
            np.testing.assert_equal(mine, other)


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


def test_what_is_observed_is_what_the_neighbour_filter_leaves_and_only_the_capacity_loses_events():
    config = EnvConfig(camera=SMALL, faults=FAULTY, filter_support=2, filter_tau_us=4000, window_capacity=4)
    many, one = CorridorVectorEnv(2, config), CorridorEnv(config)
    many.reset(seed=[3, 4])
    one.reset(seed=3)
    last_us, filtered, lost = quiet_sensor(16, 16), 0, 0
    for _ in range(20):
        observations, *_, infos = many.step(np.zeros(2, int))
        alone, *_, info = one.step(0)
        kept = filter_neighbours(one.events, last_us, 2, 4000)
        assert np.array_equal(one.seen_events, kept)
        assert observations[0].tobytes() == alone.tobytes()
        assert np.array_equal(alone[1 : alone[0, 0] + 1, 1], kept["x"][-4:])
        assert info["dropped_events"] == infos["dropped_events"][0] == max(kept.size - 4, 0)
        filtered, lost = filtered + one.events.size - kept.size, lost + info["dropped_events"]
    assert min(filtered, lost) > 0


def test_each_episode_has_the_settings_that_are_drawn_for_it_alone_or_side_by_side():
    def draw(config, rng):
        body = {"primitives": 3, "wind_x_mps": float(rng.uniform(1.0, 2.0))}
        return dataclasses.replace(config, control_hz=float(rng.choice([50.0, 100.0, 400.0])), body=body)

    config = EnvConfig(camera=SMALL, time_limit_s=0.05, vehicle="point_mass", body={"primitives": 3})
    many, one = CorridorVectorEnv(2, config, draw=draw), CorridorEnv(config, draw=draw)
    many.reset(seed=[7, 8])
    one.reset(seed=7)
    met, over = set(), False
    for _ in range(60):
        assert many.envs[0].config == one.config
        assert one.dynamics.wind[0] == one.config.body["wind_x_mps"]
        met.add(one.config.control_hz)
        observations = many.step(np.zeros(2, int))[0]
        if over:
            observation, over = one.reset()[0], False
        else:
            observation, _, terminated, truncated, _ = one.step(0)
            over = terminated or truncated
        assert observations[0].tobytes() == observation.tobytes()
    assert met == {50.0, 100.0, 400.0}
