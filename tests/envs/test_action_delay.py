import dataclasses

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from envs.config import CameraConfig, EnvConfig
from envs.corridor import CorridorEnv
from envs.events import unpack_window

SMALL = CameraConfig(width=16, height=16)
LATE = EnvConfig(camera=SMALL, action_delay_ms=15.0)  # three steps at 200 Hz


def results(env, actions):
    return [env.step(int(action)) for action in actions]


def test_a_delayed_action_is_what_was_decided_so_many_steps_before_in_this_episode():
    late, prompt = CorridorEnv(LATE), CorridorEnv(camera=SMALL)
    for seed in (2, 3):
        late.reset(seed=seed)
        prompt.reset(seed=seed)
        decided = np.random.default_rng(seed).integers(0, 3, 12)
        taken = np.concatenate([np.zeros(3, int), decided[:-3]])
        for mine, other in zip(results(late, decided), results(prompt, taken), strict=True):
            np.testing.assert_equal(mine, other)


def direction(window):
    """Of a policy whose choice depends on all of a window; straight ahead if it is empty."""
    events, *_ = unpack_window(window)
    return int(events["x"].astype(int).sum() + events.size) % 3 if events.size else 0


def test_acting_late_leads_to_where_seeing_late_leads():
    acts_late = CorridorEnv(camera=SMALL, action_delay_ms=20.0)
    sees_late = CorridorEnv(camera=dataclasses.replace(SMALL, latency_us=20_000))
    places = []
    for env in (acts_late, sees_late):
        window, _ = env.reset(seed=5)
        way = []
        for _ in range(40):
            window, _, _, _, info = env.step(direction(window))
            way.append((info["x_m"], info["y_m"]))
        places.append(way)
    assert places[0] == places[1]
    assert len({x for x, _ in places[0]}) > 5


@pytest.mark.parametrize("delay_ms", [0.0, 15.0])
@pytest.mark.parametrize("vehicle", [{}, {"vehicle": "point_mass", "body": {"primitives": 3}}])
def test_the_place_of_an_action_is_where_the_vehicle_is_when_it_is_taken(vehicle, delay_ms):
    env = CorridorEnv(dataclasses.replace(LATE, action_delay_ms=delay_ms, **vehicle))
    env.reset(seed=2)
    results(env, [1, 2, 1, 1, 0])
    place = env.place_of_action()
    results(env, [2, 2, 0][: env.config.delay_steps])
    assert env.camera_pose()[:2] == pytest.approx(place, abs=1e-12)


@given(st.integers(1, 400), st.floats(0.1, 1e6), st.floats(0.0, 0.99))
def test_an_action_is_taken_in_the_first_step_that_begins_after_its_delay(steps, control_hz, early):
    assume(steps <= control_hz)
    delay_ms = 1e3 * (steps - early) / control_hz
    assert EnvConfig(control_hz=control_hz, action_delay_ms=delay_ms).delay_steps == steps
