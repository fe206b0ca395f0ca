"""The cheapest path of a vehicle with a body: dynamic programming over place and velocity.

The plan assumes that the vehicle flies ahead at `EnvConfig.speed_mps` and accelerates left, right or not at
all. Rows of the lattice are `ROW_S` of flight apart. For each row the cost-to-go is tabulated over x and over
the sideways velocity, in steps of the velocity gained by accelerating for one row. Places have the prices of
`envs.scene.planning`. The cost of a command in any state then follows from the vehicle's own dynamics: the
command is held for `LOOK_S`, and the cost-to-go is read at the resulting state.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numba
import numpy as np

from envs.config import EnvConfig
from envs.scene.moving import MovingBody
from envs.scene.planning import LATTICE_M, SIDE_PRICE, CostToGo, cost_to_go, lattice_prices, prices_among
from envs.scene.scene import Scene
from envs.vehicles.dynamics import WAY_S, Dynamics

ROW_S = 0.05  # approximate time between rows; a row is a whole number of lattice steps
LOOK_S = 0.1  # time for which a command is held before the cost-to-go is read


@dataclass(frozen=True)
class BodyPlan:
    """Cost-to-go of a corridor for one vehicle.

    Attributes:
        costs: float32 (rows, sideways velocities, columns); row 0 is y = 0.
        prices: float64 (lattice rows, columns), price of being at each place, see `envs.scene.planning`.
        first_x_m: x of column 0 [m].
        row_m: Distance between rows [m].
        step_mps: Step between sideways velocities [m/s]; the middle velocity is 0.
        dynamics: The vehicle; its action space is a Discrete.
    """

    costs: np.ndarray
    prices: np.ndarray
    first_x_m: float
    row_m: float
    step_mps: float
    dynamics: Dynamics

    def of_actions(self, state: np.ndarray) -> np.ndarray:
        """Return the cost of each action in a state of the dynamics, float64 (K,)."""
        own = self.dynamics
        sizes = self.first_x_m, self.row_m, self.step_mps
        label: np.ndarray = _label_by(own.move)(
            self.costs, self.prices, sizes, state, own.commands, own.wind, own.parameters
        )
        return label


class Planner:
    """The plans of one environment (`envs.corridor.CorridorEnv`), computed again when they become invalid.

    A plan stays valid while the scene is the same and its moving bodies keep to their paths. Among moving
    bodies a kinematic vehicle plans at every step, because flying to a side takes it longer per row than
    flying straight ahead.
    """

    def __init__(self) -> None:
        """Start without a plan."""
        self._scene: Scene | None = None
        self._moving: tuple[MovingBody, ...] = ()
        self._plan: BodyPlan
        self._headings: CostToGo

    def costs(self, env: Any, sight_m: float = math.inf) -> np.ndarray:
        """Return the cost of each action where it takes effect, float64 (K,).

        Args:
            env: The environment, in an episode.
            sight_m: Distance ahead at which ways of a kinematic vehicle end [m]; infinite: at the goal line.
        """
        config, same = env.config, env.scene is self._scene
        if env.dynamics.move is None:
            if not same:
                self._headings = cost_to_go(env.scene, config.vehicle_radius_m, config.camera_height_m)
                self._scene = env.scene
            vehicle = config.vehicle_radius_m, config.camera_height_m, config.speed_mps
            plan = self._headings.among(env.moving, _now(env), vehicle)
            x_m, y_m = env.place_of_action()
            return plan.of_actions(x_m, y_m, sight_m)
        if not same or env.moving != self._moving:
            self._plan = plan_body(env.scene, config, env.dynamics, env.moving, _now(env))
            self._scene, self._moving = env.scene, env.moving
        return self._plan.of_actions(env.state_of_action())


def _now(env: Any) -> tuple[float, float]:
    """Return the time [s] and the vehicle's y [m]."""
    return 1e-6 * env.info()["t_us"], env.camera_pose()[1]


def plan_body(
    scene: Scene,
    config: EnvConfig,
    dynamics: Dynamics,
    moving: Sequence[MovingBody] = (),
    now: tuple[float, float] = (0.0, 0.0),
) -> BodyPlan:
    """Plan a corridor for a vehicle with a body.

    Args:
        scene: The corridor.
        config: Settings of the episode.
        dynamics: The vehicle.
        moving: Moving bodies; each row is priced at the time when the vehicle gets there.
        now: The time [s] and the vehicle's y [m].

    Raises:
        ValueError: The vehicle has no discrete commands or no `Dynamics.sideways`.
    """
    if dynamics.commands is None or dynamics.sideways is None:
        rule = "a planner needs a vehicle with discrete commands that states `Dynamics.sideways`"
        raise ValueError(f"{rule}; got vehicle {config.vehicle!r} with {dynamics.action_space}")
    speed_mps, acceleration_mps2 = dynamics.sideways
    prices, first_x_m = lattice_prices(scene, 0.0, config.vehicle_radius_m, config.camera_height_m)
    vehicle = config.vehicle_radius_m, config.camera_height_m, config.speed_mps
    prices = prices_among(moving, prices, first_x_m, now, vehicle)
    stride = max(1, round(ROW_S * config.speed_mps / LATTICE_M))
    row_s = stride * LATTICE_M / config.speed_mps
    step_mps = min(acceleration_mps2 * row_s, speed_mps)
    half = int(speed_mps / step_mps + 1e-9)
    costs = _costs(prices, stride, row_s, step_mps, half)
    return BodyPlan(costs, prices, first_x_m, stride * LATTICE_M, step_mps, dynamics)


@numba.njit(cache=True, error_model="numpy")
def _costs(prices: np.ndarray, stride: int, row_s: float, step_mps: float, half: int) -> np.ndarray:
    """Return the smallest sum of prices to the last row, from each row, velocity and column."""
    last, columns = prices.shape[0] - 1, prices.shape[1]
    rows = (last + stride - 1) // stride + 1
    costs = np.zeros((rows, 2 * half + 1, columns), np.float32)
    for row in range(rows - 2, -1, -1):
        for speed in range(2 * half + 1):
            costs[row, speed] = np.inf
            for push in (0, -1, 1):
                if not 0 <= speed + push <= 2 * half:
                    continue
                for column in range(columns):
                    total, x = SIDE_PRICE * abs(push), float(column)
                    for part in range(1, stride + 1):
                        share = part / stride
                        moved = (speed - half) * share + 0.5 * push * share * share
                        x = column + moved * step_mps * row_s / LATTICE_M
                        total += _between(prices[min(row * stride + part, last)], x)
                    total += _between(costs[row + 1, speed + push], x)
                    costs[row, speed, column] = min(costs[row, speed, column], total)
    return costs


@numba.njit(cache=True, error_model="numpy")
def _between(values: np.ndarray, place: float) -> float:
    """Return the linearly interpolated value at a place; outside the array, the value at its edge."""
    place = min(max(place, 0.0), len(values) - 1.0)
    first = min(int(place), len(values) - 2)
    return values[first] + (place - first) * (values[first + 1] - values[first])


@numba.njit(cache=True, error_model="numpy")
def _cost_at(costs: np.ndarray, column: float, row: float, speed: float) -> float:
    """Return the cost-to-go interpolated between rows, velocities and columns, all in lattice steps."""
    row = min(max(row, 0.0), len(costs) - 1.0)
    j = max(0, min(int(row), len(costs) - 2))
    speed = min(max(speed, 0.0), costs.shape[1] - 1.0)
    k = max(0, min(int(speed), costs.shape[1] - 2))
    after, found = min(k + 1, costs.shape[1] - 1), 0.0
    for ahead in range(2):
        own = costs[min(j + ahead, len(costs) - 1)]
        slow, fast = _between(own[k], column), _between(own[after], column)
        share = row - j if ahead else 1.0 - (row - j)
        found += share * (slow + (speed - k) * (fast - slow))
    return found


@lru_cache(maxsize=16)
def _label_by(move: Callable[..., None] | None) -> Any:
    """Return the compiled function that computes the cost of each command in a state, using `move`."""
    steps = math.ceil(LOOK_S / WAY_S)

    @numba.njit(error_model="numpy")
    def label(
        costs: Any, prices: Any, sizes: Any, state: Any, commands: Any, wind: Any, parameters: Any
    ) -> Any:
        first_x_m, row_m, step_mps = sizes
        found, own = np.empty(len(commands)), np.empty_like(state)
        for k in range(len(commands)):
            own[:] = state
            total = 0.0
            for _ in range(steps):
                before_m = own[1]
                move(own, commands[k], wind, parameters, WAY_S)  # type: ignore[misc]  # a body moves
                row = min(max(own[1] / LATTICE_M, 0.0), len(prices) - 1.0)
                price = _between(prices[int(row + 0.5)], (own[0] - first_x_m) / LATTICE_M)
                total += price * max(0.0, own[1] - before_m) / LATTICE_M
            column, speed = (own[0] - first_x_m) / LATTICE_M, own[2] / step_mps + costs.shape[1] // 2
            found[k] = total + _cost_at(costs, column, own[1] / row_m, speed)
        return found

    return label
