"""The seams of vehicle and task: a second user of each, and what is off changes nothing."""

import importlib
import re
from pathlib import Path

import numba
import numpy as np
import pytest
from gymnasium import spaces

from envs.config import TASKS, VEHICLES, EnvConfig
from envs.corridor import CorridorEnv, CorridorVectorEnv
from envs.vehicles.dynamics import Dynamics

EMPTY = {"num_obstacles": 0}


@numba.njit
def displace(state, command, wind, parameters, dt_s):
    """Move as commanded, in metres a second, on the spot: no inertia."""
    state[2:4] = command + wind
    state[:2] += state[2:4] * dt_s


def make_displaced(config: EnvConfig) -> Dynamics:
    """A vehicle whose action is its velocity."""
    top = float(config.body.get("top_speed_mps", 2.0 * config.speed_mps))
    wind = np.array([config.body.get("wind_x_mps", 0.0), 0.0])
    straight = np.array([0.0, config.speed_mps])
    state = np.array([0.0, 0.0, *straight])
    return Dynamics(spaces.Box(-top, top, (2,), np.float64), straight, top, displace, state, wind=wind)


def make_headings(config: EnvConfig) -> Dynamics:
    """The kinematic vehicle through the seam: three velocities."""
    side = config.speed_mps * 0.5**0.5
    commands = np.array([[0.0, config.speed_mps], [-side, side], [side, side]])
    state = np.array([0.0, 0.0, *commands[0]])
    return Dynamics(
        spaces.Discrete(3), np.int64(0), config.speed_mps, displace, state, np.zeros(0), np.zeros(2), commands
    )


@numba.njit
def judge_gently(vehicle):
    """Reward nothing but standing in the middle, and end 20 m ahead."""
    vehicle.reward = -abs(vehicle.x_m)
    vehicle.success = vehicle.y_m >= 20.0
    vehicle.collision = False


@pytest.fixture(autouse=True)
def rows(monkeypatch):
    monkeypatch.setitem(VEHICLES, "displaced", f"{__name__}:make_displaced")
    monkeypatch.setitem(VEHICLES, "headings", f"{__name__}:make_headings")
    monkeypatch.setitem(TASKS, "gentle", f"{__name__}:judge_gently")


def flown(actions, **fields):
    """Events, places and rewards of a flight."""
    env = CorridorEnv(EnvConfig(**fields))
    env.reset(seed=4)
    events, told = [], []
    for action in actions:
        _, reward, terminated, truncated, info = env.step(action)
        events.append(env.events)
        told.append((info["x_m"], info["y_m"], reward, terminated, truncated, info["t_us"]))
        if terminated or truncated:
            break
    return np.concatenate(events), np.array(told, float)


@pytest.mark.parametrize("delay_ms", [0.0, 12.0])
def test_headings_through_the_seam_fly_and_see_as_the_kinematic_vehicle(delay_ms):
    actions = np.random.default_rng(1).integers(0, 3, 40)
    events, told = flown(actions, action_delay_ms=delay_ms)
    others, other = flown(actions, action_delay_ms=delay_ms, vehicle="headings")
    np.testing.assert_allclose(other, told, atol=1e-9)
    assert len(others) == len(events) > 500
    assert (others[["x", "y", "p"]] == events[["x", "y", "p"]]).mean() > 0.99


def test_kinematic_vehicles_and_others_fly_side_by_side_as_each_alone():
    body = {"primitives": 3, "drag_per_s": 0.3}
    configs = [
        EnvConfig(),
        EnvConfig(vehicle="headings"),
        EnvConfig(vehicle="point_mass", action_delay_ms=40.0, body=body),
    ]
    vector, singles = CorridorVectorEnv(3, configs), [CorridorEnv(config) for config in configs]
    vector.reset(seed=[1, 2, 3])
    for seed, env in enumerate(singles, 1):
        env.reset(seed=seed)
    for actions in np.random.default_rng(0).integers(0, 3, (12, 3)):
        vector.step(actions)
        for one, env, action in zip(vector.envs, singles, actions, strict=True):
            env.step(action)
            assert one.camera_pose() == env.camera_pose()
            assert one.events.tobytes() == env.events.tobytes()


def test_a_box_of_commands_is_queued_and_checked():
    env = CorridorEnv(EnvConfig(vehicle="displaced", layout=EMPTY, action_delay_ms=10.0, observation="none"))
    env.reset(seed=0)
    x, y = env.camera_pose()[:2]
    for _ in range(2):  # both fly on straight
        env.step(np.array([20.0, 0.0]))
    assert env.camera_pose()[:2] == pytest.approx((x, y + 0.2))
    assert env.place_of_action() == pytest.approx((x + 0.2, y + 0.2))
    env.step(np.array([0.0, 0.0]))
    assert env.camera_pose()[:2] == pytest.approx((x + 0.1, y + 0.2))
    for wrong in (np.array([41.0, 0.0]), np.array([np.nan, 0.0]), 1, np.zeros(3)):
        with pytest.raises(ValueError, match="action must be in Box"):
            env.step(wrong)


def test_standing_and_flying_back_earn_their_way_reach_no_goal_and_see_what_moves():
    for speed in (0.0, -10.0):
        events, told = flown([np.array([0.0, speed])] * 10, vehicle="displaced")
        assert told[:, 2] == pytest.approx(speed / 200.0)
        assert not told[:, 3].any()
        assert (events.size > 0) == (speed != 0.0)


def test_a_way_of_several_parts_stops_where_its_first_part_does():
    fields = {"vehicle": "displaced", "layout": EMPTY, "control_hz": 20.0, "observation": "none"}
    told = flown([np.array([30.0, 5.0])] * 40, **fields)[1]
    assert told[-1, 3]
    assert abs(told[-1, 0]) == pytest.approx(15.0 - 0.3)
    share = (told[-1, 0] - told[-2, 0]) / 1.5
    assert told[-1, 2] == pytest.approx(5.0 * 0.05 * share - 100.0)


@pytest.mark.parametrize("memory", ["reference", "frame"])
def test_the_parts_of_a_way_are_seen_as_one_way(memory):
    camera = {"memory": memory}
    slow = {"control_hz": 20.0, "camera": camera, "speed_mps": 5.0}
    actions = [np.array([1.0, 5.0])] * 6
    cut, told = flown(actions, vehicle="displaced", body={"top_speed_mps": 10.0}, **slow)
    whole, _ = flown([0] * 6, **slow)
    assert (np.diff(cut["t"]) >= 0).all()
    assert 0.5 < len(cut) / len(whole) < 2.0
    assert cut["t"].max() <= told[-1, 5]


def test_wind_is_the_vehicles_own_affair():
    told = flown([np.array([0.0, 20.0])] * 5, vehicle="displaced", body={"wind_x_mps": 2.0}, layout=EMPTY)[1]
    assert np.diff(told[:, 0]) == pytest.approx(0.01)


def test_a_task_judges_every_step_of_its_own_vehicles_alone():
    told = flown([0] * 250, task="gentle", layout=EMPTY, observation="none")[1]
    assert told[:, 2] == pytest.approx(-abs(told[0, 0]))
    assert told[-1, 1] == pytest.approx(20.0)
    assert told[-1, 3] == 1.0
    configs = [EnvConfig(task=task, layout=EMPTY, observation="none") for task in ("gentle", "corridor")]
    env = CorridorVectorEnv(2, configs)
    env.reset(seed=0)
    rewards = env.step(np.zeros(2, int))[1]
    assert rewards[0] <= 0.0
    assert rewards[1] == pytest.approx(0.1)


def test_a_reward_that_is_no_number_stops_the_episode(monkeypatch):
    @numba.njit
    def judge(vehicle):
        vehicle.reward = np.nan

    monkeypatch.setitem(TASKS, "gentle", f"{__name__}:wrong_judge")
    monkeypatch.setitem(globals(), "wrong_judge", judge)
    with pytest.raises(ValueError, match="episode 0, step 1, seed 4: the reward must be finite; got nan"):
        flown([0], task="gentle", observation="none")


def test_the_vehicle_of_the_manual_flies_its_circle(tmp_path, monkeypatch):
    page = Path(__file__).parents[2].joinpath("docs/vehicles.md").read_text()
    (tmp_path / "glider.py").write_text(
        next(re.finditer(r"```python\n(\"\"\"A vehicle.*?)```", page, re.S))[1]
    )
    monkeypatch.syspath_prepend(tmp_path)
    importlib.import_module("glider")
    try:
        body = {"turn_radps": 1.0}
        told = flown([np.ones(1)] * 300, vehicle="glider", speed_mps=2.0, body=body, layout=EMPTY)[1]
        x, y = told[:, 0] - told[0, 0], told[:, 1] - told[0, 1]
        assert np.hypot(x - 2.0, y) == pytest.approx(2.0, rel=0.02)
    finally:
        del VEHICLES["glider"]


def test_unknown_rows_and_keys_are_refused():
    with pytest.raises(ValueError, match=r"vehicle\n.*must be one of kinematic, .*got 'boat'"):
        EnvConfig(vehicle="boat")
    with pytest.raises(ValueError, match=r"task\n.*must be one of corridor.*got 'race'"):
        EnvConfig(task="race")
    with pytest.raises(ValueError, match="body must be empty for vehicle 'kinematic'"):
        CorridorEnv(EnvConfig(body={"tau_s": 1.0}))
