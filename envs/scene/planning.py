"""The cheapest path to the goal from anywhere in a corridor, by dynamic programming on a lattice.

The vehicle knows the geometry and moves on a lattice of `LATTICE_M` by steps ahead or 45 degrees to a side.
Each place has a price, which falls with its clearance. The geometry is the scene's sections at the vehicle's
height: of bodies (of a gate, its posts) and of the surfaces of a mesh. Moving textures do not count. A moving
body is priced at the place where it will be when the vehicle gets there.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np

from envs.scene.collision import MARGIN
from envs.scene.moving import MovingBody
from envs.scene.obstacles import OBSTACLE, body_sections
from envs.scene.scene import Scene

LATTICE_M = 0.25
CLEARANCE_SCALE_M = 0.4  # the price of a place falls by a factor e over this distance from contact
FELT_M = 6 * CLEARANCE_SCALE_M  # an obstacle farther than this from contact adds nothing
BLOCKED = 1e3  # price of a place in contact
SIDE_PRICE = 0.01  # of a lattice step to the side, so that the straighter of two free paths wins


@dataclass(frozen=True)
class CostToGo:
    """Cost of the cheapest way to the goal line from each place of the lattice.

    Attributes:
        costs: (rows in y, columns in x), float64; row 0 is y = 0.
        prices: Price of being at each place, of the same shape.
        first_x_m: x of column 0 [m].
    """

    costs: np.ndarray
    prices: np.ndarray
    first_x_m: float

    def of_actions(self, x_m: float, y_m: float, sight_m: float = math.inf) -> np.ndarray:
        """Return the cost of each action at a place: ahead, left, right; float64 (3,).

        The cost is that of a lattice step in the action's direction and of the cheapest way from there,
        interpolated between the four nearest places. Outside the lattice the values at its edge count.

        Args:
            x_m: x of the place [m].
            y_m: y of the place [m].
            sight_m: Distance ahead at which ways end, whatever stands behind [m]; infinite: at the goal line.
        """
        column, row, ahead = (x_m - self.first_x_m) / LATTICE_M, y_m / LATTICE_M, sight_m / LATTICE_M
        if ahead >= len(self.costs):
            return _of_actions(self.costs, column, row)
        return _of_actions_in_sight(self.prices, column, row, max(1, round(ahead)))

    def among(
        self, moving: Sequence[MovingBody], now: tuple[float, float], vehicle: tuple[float, float, float]
    ) -> "CostToGo":
        """Return the plan with moving bodies added; arguments as for `prices_among`."""
        if not moving:
            return self
        prices = prices_among(moving, self.prices, self.first_x_m, now, vehicle)
        return CostToGo(_costs(prices), prices, self.first_x_m)


def cost_to_go(scene: Scene, radius_m: float, height_m: float = 2.0, through_x_m: float = 0.0) -> CostToGo:
    """Plan for a vehicle of `radius_m` at `height_m` [m]; one lattice column is at x = `through_x_m` [m].

    Raises:
        ValueError: The lane is too narrow for the vehicle.
    """
    if 0.5 * scene.width_m <= radius_m:
        raise ValueError(f"a lane must be wider than the vehicle, got {scene.width_m} m and {radius_m} m")
    prices, first_x_m = lattice_prices(scene, through_x_m, radius_m, height_m)
    return CostToGo(_costs(prices), prices, first_x_m)


def passable_among(scene: Scene, radius_m: float, height_m: float, speed_mps: float) -> bool:
    """Whether the planner finds a way from every start among standing and moving bodies from time 0 on.

    Thrown balls do not count. Like the planner, it assumes that the vehicle reaches each row when it would by
    flying straight ahead, so True is no proof for a vehicle that turns much.

    Args:
        scene: The corridor.
        radius_m: Radius of the vehicle [m].
        height_m: Height of the vehicle [m].
        speed_mps: Speed of the vehicle [m/s].
    """
    vehicle = radius_m, height_m, speed_mps
    plan = cost_to_go(scene, radius_m, height_m).among(scene.moving, (0.0, 0.0), vehicle)
    first, last = ((x_m - plan.first_x_m) / LATTICE_M for x_m in scene.spawn_range_m)
    costs = _costs(np.where(plan.prices >= BLOCKED, BLOCKED, 0.0))  # clearance prices may add up to BLOCKED
    return bool((costs[0, max(0, math.floor(first)) : math.ceil(last) + 1] < BLOCKED).all())


def lattice_prices(
    scene: Scene, through_x_m: float, radius_m: float, height_m: float
) -> tuple[np.ndarray, float]:
    """Return the price of each place of the lattice, (rows in y, columns in x), and column 0's x [m].

    A place in contact costs `BLOCKED`; other places cost less the farther they are from contact. The
    outermost columns are in contact with the walls, or out of the vehicle's reach.
    """
    half = 0.5 * scene.width_m - radius_m
    wide = min(half, max(map(abs, scene.spawn_range_m)) + scene.length_m)
    left, right = (math.floor((wide + side * through_x_m) / LATTICE_M) + 1 for side in (1, -1))
    x_m = through_x_m + np.arange(-left, right + 1) * LATTICE_M
    y_m = np.arange(math.ceil(scene.length_m / LATTICE_M) + 1) * LATTICE_M
    clearance = np.broadcast_to(half - np.abs(x_m), (len(y_m), len(x_m))).copy()
    _approach(clearance, scene.sections(height_m), x_m, y_m, radius_m, FELT_M)
    return _price(clearance), float(x_m[0])


def _price(clearance: np.ndarray) -> np.ndarray:
    """Return the price of places with a clearance [m], of the same shape."""
    price = np.exp(-np.maximum(clearance, 0.0) / CLEARANCE_SCALE_M)
    return np.where(clearance <= 0.5 * LATTICE_M, BLOCKED, price)


def prices_among(
    moving: Sequence[MovingBody],
    prices: np.ndarray,
    first_x_m: float,
    now: tuple[float, float],
    vehicle: tuple[float, float, float],
) -> np.ndarray:
    """Return the prices of `lattice_prices` with moving bodies added.

    Args:
        moving: The moving bodies; each row is priced at the time when the vehicle would get there straight.
        prices: Prices without moving bodies.
        first_x_m: x of column 0 [m].
        now: The time [s] and the vehicle's y [m].
        vehicle: Radius [m], height [m] and speed [m/s] of the vehicle.
    """
    radius_m, height_m, speed_mps = vehicle
    y_m, x_m = (LATTICE_M * np.arange(size) for size in prices.shape)
    times_s, prices = np.maximum(now[0], now[0] + (y_m - now[1]) / speed_mps), prices.copy()
    for one in moving:
        reach_m = max(float(one.body["rx"]), float(one.body["ry"])) + radius_m + FELT_M
        first_m = max(one.places_m[:, 1].min() - reach_m, now[1] - LATTICE_M)
        last_m = one.places_m[:, 1].max() + reach_m
        rows = slice(*np.searchsorted(y_m, (first_m, last_m)))  # other rows are behind, or always far from it
        bodies = np.array([one.body] * len(y_m[rows]), OBSTACLE)
        bodies["x"], bodies["y"], bodies["z"] = one.places(times_s[rows]).T
        there = (np.abs(bodies["z"] - height_m) <= bodies["rz"]) & (
            np.abs(bodies["y"] - y_m[rows]) <= reach_m
        )
        x, y, _, _, hx, hy, r = body_sections(bodies[there], height_m).T[:, :, None]
        across = np.maximum(np.abs(y_m[rows][there][:, None] - y) - hy, 0.0)
        clearance = np.hypot(np.maximum(np.abs(first_x_m + x_m - x) - hx, 0.0), across) - r - radius_m
        prices[rows][there] = np.maximum(prices[rows][there], _price(clearance))
    return prices


@numba.njit(cache=True, error_model="numpy")
def _approach(
    clearance: np.ndarray, sections: np.ndarray, x_m: np.ndarray, y_m: np.ndarray, radius: float, reach: float
) -> None:
    """Lower the clearance of the places in rows within `reach` of a section to their distance from it."""
    for k in range(len(sections)):
        x, y, ux, uy, hx, hy, r = sections[k]
        size = r + radius
        deep = abs(uy) * hx + abs(ux) * hy + size + reach
        for j in range(np.searchsorted(y_m, y - deep), np.searchsorted(y_m, y + deep)):
            dy = y_m[j] - y
            for i in range(len(x_m)):
                dx = x_m[i] - x
                along = max(abs(dx * ux + dy * uy) - hx, 0.0)
                across = max(abs(dy * ux - dx * uy) - hy, 0.0)
                most = clearance[j, i] + size
                if most > 0.0 and along * along + across * across <= MARGIN * most * most:
                    clearance[j, i] = min(clearance[j, i], math.hypot(along, across) - size)


@numba.njit(cache=True, error_model="numpy")
def _costs(prices: np.ndarray) -> np.ndarray:
    """Return the smallest sum of prices to the last row; each step to a side adds `SIDE_PRICE`."""
    costs = prices.copy()
    rows, columns = prices.shape
    for j in range(rows - 2, -1, -1):
        for i in range(columns):
            best = costs[j + 1, i]
            if i > 0:
                best = min(best, costs[j + 1, i - 1] + SIDE_PRICE)
            if i < columns - 1:
                best = min(best, costs[j + 1, i + 1] + SIDE_PRICE)
            costs[j, i] += best
    return costs


@numba.njit(cache=True, error_model="numpy")
def _of_actions(costs: np.ndarray, column: float, row: float) -> np.ndarray:
    """Return `CostToGo.of_actions` for a place given in lattice steps."""
    last_row, last_column = costs.shape[0] - 1, costs.shape[1] - 1
    y = min(max(row + 1.0, 0.0), float(last_row))
    j = min(int(y), last_row - 1)
    found = np.empty(3)
    for action, side in enumerate((0.0, -1.0, 1.0)):
        x = min(max(column + side, 0.0), float(last_column))
        i = min(int(x), last_column - 1)
        near = costs[j, i] + (x - i) * (costs[j, i + 1] - costs[j, i])
        far = costs[j + 1, i] + (x - i) * (costs[j + 1, i + 1] - costs[j + 1, i])
        found[action] = near + (y - j) * (far - near) + SIDE_PRICE * abs(side)
    return found


@numba.njit(cache=True, error_model="numpy")
def _of_actions_in_sight(prices: np.ndarray, column: float, row: float, rows_ahead: int) -> np.ndarray:
    """Return `_of_actions` for ways that end `rows_ahead` rows after the next row.

    Only the places that such a way can reach are priced, with enough columns at each side that the edge has
    no effect.
    """
    rows, columns = prices.shape
    first = min(int(min(max(row + 1.0, 0.0), rows - 1.0)), rows - 2)
    after_last = min(first + rows_ahead + 1, rows)
    reach, middle = after_last - first + 3, int(min(max(column, 0.0), columns - 1.0))
    left, right = max(middle - reach, 0), min(middle + reach, columns)
    costs = _costs(prices[first:after_last, left:right])
    return _of_actions(costs, column - left, row - first)
