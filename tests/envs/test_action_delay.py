import dataclasses

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from envs.config import CameraConfig, EnvConfig
from envs.corridor import CorridorEnv, CorridorVectorEnv
from envs.events import unpack_window

SMALL = CameraConfig(width=16, height=16)
LATE = EnvConfig(camera=SMALL, action_delay_ms=15.0)  # three steps at 200 Hz


def results(env, actions):
    return [env.step(int(action)) for action in actions]


def test_a_delayed_action_is_what_was_decided_so_many_steps_before():
    late, prompt = CorridorEnv(LATE), CorridorEnv(camera=SMALL)
    late.reset(seed=2)
    prompt.reset(seed=2)
    decided = np.random.default_rng(0).integers(0, 3, 20)
    taken = np.concatenate([np.zeros(3, int), decided[:-3]])
    for mine, other in zip(results(late, decided), results(prompt, taken), strict=True):
        np.testing.assert_equal(mine, other)


def direction(window):
    """Of a policy whose choice depends on all of a window; straight ahead if it is empty."""
    events, *_ = unpack_window(window)
    return int(events["x"].astype(int).sum() + events.size) % 3 if events.size else 0


@pytest.mark.parametrize("steps", [1, 4])
def test_acting_late_leads_to_where_seeing_late_leads(steps):
    acts_late = CorridorEnv(camera=SMALL, action_delay_ms=5.0 * steps)
    camera = dataclasses.replace(SMALL, latency_us=5000 * steps)
    sees_late = CorridorEnv(camera=camera)
    places = []
    for env in (acts_late, sees_late):
        window, _ = env.reset(seed=5)
        way = []
        for _ in range(40):
            window, _, terminated, truncated, info = env.step(direction(window))
            way.append((info["x_m"], info["y_m"]))
            if terminated or truncated:
                break
        places.append(way)
    assert places[0] == places[1]
    assert len({x for x, _ in places[0]}) > 5


def test_delays_differ_side_by_side_and_end_with_their_episode():
    short = dataclasses.replace(LATE, action_delay_ms=40.0, time_limit_s=0.05)
    configs = [LATE, EnvConfig(camera=SMALL), short]
    many, alone = CorridorVectorEnv(3, configs), [CorridorEnv(config) for config in configs]
    many.reset(seed=[1, 2, 3])
    for env, seed in zip(alone, (1, 2, 3), strict=True):
        env.reset(seed=seed)
    over, ended = np.zeros(3, bool), 0
    for actions in np.random.default_rng(1).integers(1, 3, (45, 3)):
        _, _, terminated, truncated, infos = many.step(actions)
        for row, env in enumerate(alone):
            info = env.reset()[1] if over[row] else env.step(int(actions[row]))[4]
            assert (infos["x_m"][row], infos["y_m"][row]) == (info["x_m"], info["y_m"])
        over = terminated | truncated
        ended += over.sum()
    assert ended >= 4


def test_a_replay_of_decisions_goes_on_with_the_same_bytes():
    first, second = (CorridorVectorEnv(1, LATE) for _ in range(2))
    first.reset(seed=4)
    decided = np.random.default_rng(3).integers(0, 3, (12, 1))
    for actions in decided[:7]:
        first.step(actions)
    second.replay([(4, 0, decided[:7, 0])])
    for actions in decided[7:]:
        for mine, other in zip(first.step(actions), second.step(actions), strict=True):
            np.testing.assert_equal(mine, other)


@pytest.mark.parametrize("delay_ms", [0.0, 15.0])
def test_the_place_of_an_action_is_where_the_vehicle_is_when_it_is_taken(delay_ms):
    env = CorridorEnv(dataclasses.replace(LATE, action_delay_ms=delay_ms))
    env.reset(seed=2)
    results(env, [1, 2, 1, 1, 0])
    place = env.place_of_action()
    results(env, [2, 2, 0][: env.config.delay_steps])
    assert env.camera_pose()[:2] == place


@pytest.mark.parametrize("delay_ms", [-5.0, 1000.1, float("nan"), float("inf")])
def test_a_delay_out_of_range_is_refused(delay_ms):
    with pytest.raises(ValueError, match=r"action_delay_ms\n"):
        EnvConfig(action_delay_ms=delay_ms)


@pytest.mark.parametrize(
    ("control_hz", "delay_ms", "steps"),
    [(200, 0, 0), (200, 5, 1), (200, 5.1, 2), (45, 1, 1), (45, 1e3 / 45, 1), (1e6, 1e3, 10**6), (1000, 3, 3)],
)
def test_an_action_is_taken_in_the_first_step_that_begins_after_its_delay(control_hz, delay_ms, steps):
    assert EnvConfig(control_hz=float(control_hz), action_delay_ms=float(delay_ms)).delay_steps == steps


@given(st.integers(1, 400), st.floats(0.1, 1e6))
def test_a_delay_of_whole_steps_is_those_steps(steps, control_hz):
    assume(steps / control_hz <= 1)
    assert EnvConfig(control_hz=control_hz, action_delay_ms=1e3 * steps / control_hz).delay_steps == steps
