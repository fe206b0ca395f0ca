"""The planner of vehicles with a body: its costs by an independent recursion, and its flights."""

import functools
import math

import numpy as np
import pytest

from envs.config import EnvConfig
from envs.corridor import CorridorEnv
from envs.scene.planning import LATTICE_M, SIDE_PRICE
from envs.vehicles.dynamics import make_dynamics
from envs.vehicles.planning import _costs, plan_body

BODY = {"vehicle": "point_mass", "body": {"primitives": 15}, "control_hz": 100.0, "observation": "none"}


def flown(seed, choose=None, **settings):
    """An episode that takes the planner's cheapest action, or what `choose(costs)` says; its last info."""
    env = CorridorEnv(**{**BODY, "scene": "poles_eval", "time_limit_s": 20.0, "split": "eval", **settings})
    env.reset(seed=seed)
    plan = plan_body(env.scene, env.config, env.dynamics)
    while True:
        costs = plan.of_actions(env.state_of_action())
        _, _, terminated, truncated, info = env.step(int(costs.argmin()) if choose is None else choose(costs))
        if terminated or truncated:
            return info


def test_costs_are_those_of_a_recursion_over_all_pushes():
    rng, stride, row_s, step_mps, half = np.random.default_rng(0), 2, 0.05, 0.75, 2
    prices = rng.uniform(0.0, 1.0, (9, 12))
    columns = np.arange(12)

    @functools.lru_cache(None)
    def least(row, speed, x):
        if row == 4:
            return 0.0
        ways = []
        for push in (-1, 0, 1):
            if abs(speed + push) <= half:
                places = [
                    x + (speed * share + 0.5 * push * share**2) * step_mps * row_s / LATTICE_M
                    for share in (0.5, 1.0)
                ]
                own = [np.interp(place, columns, prices[2 * row + k + 1]) for k, place in enumerate(places)]
                low = min(max(places[1], 0.0), 11.0)
                first = min(int(low), 10)
                after = [least(row + 1, speed + push, float(first + k)) for k in (0, 1)]
                between = after[0] + (low - first) * (after[1] - after[0])
                ways.append(SIDE_PRICE * abs(push) + sum(own) + between)
        return min(ways)

    costs = _costs(prices, stride, row_s, step_mps, half)
    expected = [[[least(row, s - half, float(x)) for x in range(12)] for s in range(5)] for row in range(5)]
    assert np.allclose(costs, expected, atol=1e-5)


def test_where_nothing_stands_straight_on_is_cheapest_and_sides_are_equal():
    env = CorridorEnv(**BODY, layout={"num_obstacles": 0})
    env.reset(seed=0)
    plan = plan_body(env.scene, env.config, env.dynamics)
    costs = plan.of_actions(np.array([0.0, 40.0, 0.0, 20.0, 0.0, 0.0]))
    assert costs.argmin() == 7
    assert np.allclose(costs, costs[::-1], atol=1e-3)


DISTURBED = {"drag_per_s": 0.3, "wind_x_mps": 3.0, "mass_ratio": 1.15}


@pytest.mark.parametrize(
    "settings", [{}, {"action_delay_ms": 100.0, "body": {"primitives": 15, **DISTURBED}}]
)
def test_the_planner_comes_through(settings):
    assert all(flown(seed, **settings)["success"] for seed in range(4))


def test_it_finds_back_from_random_actions():
    rng = np.random.default_rng(3)

    def sometimes(costs):
        return int(rng.integers(15)) if rng.random() < 0.3 else int(costs.argmin())

    assert sum(flown(seed, sometimes)["success"] for seed in range(4)) >= 3


def test_a_vehicle_that_cannot_be_planned_for_is_refused():
    env = CorridorEnv(**{**BODY, "body": {}})
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"discrete commands .* got vehicle 'point_mass' with Box"):
        plan_body(env.scene, env.config, env.dynamics)
    speed, acceleration = make_dynamics(EnvConfig(**BODY)).sideways
    assert speed == 5.0
    assert math.isclose(acceleration, 15.0)
