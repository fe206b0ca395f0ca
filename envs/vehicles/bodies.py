"""Bodies: the states of the vehicles in a batch that are not kinematic."""

from collections.abc import Callable
from typing import Any

import numpy as np

from envs.config import EnvConfig
from envs.kinematics import Point
from envs.vehicles.dynamics import Dynamics, loop_over, parts_of_step


class Bodies:
    """States, parameters and last ways of vehicles; rows of kinematic vehicles are unused.

    Attributes:
        dynamics: Row -> `Dynamics`, for the vehicles with a body.
        ways: float64 (B, parts + 1, 2), places at the ends of the parts of the last step [m].
    """

    def __init__(self, count: int) -> None:
        """Allocate `count` vehicles, all of them kinematic at first."""
        self.dynamics: dict[int, Dynamics] = {}
        self._state, self._parameters = np.zeros((count, 4)), np.zeros((count, 0))
        self._tables, self._wind = np.zeros((count, 0, 0)), np.zeros((count, 2))
        self._dt_s, self._parts = np.zeros(count), np.zeros(count, np.int64)
        self._rows = np.arange(count)
        self._kinds: list[tuple[Callable[..., None], np.ndarray]] | None = None
        self.ways = np.zeros((count, 1, 2))

    def start(self, row: int, config: EnvConfig, dynamics: Dynamics, place: Point) -> int:
        """Start an episode of one vehicle at `place`; return the parts of its steps, 0 if kinematic."""
        self.dynamics.pop(row, None)
        self._state[row], self._kinds = 0.0, None
        if dynamics.move is None:
            return 0
        self.dynamics[row] = dynamics
        parts = self._parts[row] = parts_of_step(config)
        self._dt_s[row] = 1.0 / (config.control_hz * parts)
        self._state = _with_room(self._state, dynamics.state.shape)
        self._parameters = _with_room(self._parameters, dynamics.parameters.shape)
        self.ways = _with_room(self.ways, (parts + 1, 2))
        self._state[row, : dynamics.state.size] = dynamics.state
        self._state[row, :2] = place
        self._parameters[row, : dynamics.parameters.size] = dynamics.parameters
        self._wind[row] = dynamics.wind
        if dynamics.commands is not None:
            self._tables = _with_room(self._tables, dynamics.commands.shape)
            self._tables[row, : len(dynamics.commands), : dynamics.commands.shape[1]] = dynamics.commands
        return int(parts)

    @property
    def velocities(self) -> np.ndarray:
        """Return the velocities of all vehicles, (2, B) [m/s]; 0 for kinematic vehicles."""
        return self._state[:, 2:4].T

    def move(self, actions: np.ndarray, active: np.ndarray) -> None:
        """Move the active vehicles through one control step, as if nothing stood in the way.

        Args:
            actions: (B,) integers or (B, C) float64, the actions taken now.
            active: bool (B,).
        """
        if self._kinds is None:
            self._kinds = self._find_kinds(len(active))
        commands = actions if actions.ndim > 1 else self._tables[self._rows, actions]
        for move_all, own in self._kinds:
            arrays = self._wind, self._parameters, self._dt_s, self._parts, self.ways
            move_all(self._state, commands, *arrays, own & active)

    def way(self, row: int) -> np.ndarray:
        """Return the planned places of a vehicle in its last step, (parts + 1, 2) [m]."""
        return self.ways[row, : self._parts[row] + 1]

    def state_after(self, row: int, actions: np.ndarray) -> np.ndarray:
        """Return the state of a vehicle after these actions, float64 (S,)."""
        dynamics, state = self.dynamics[row], self._state[row].copy()
        for action in actions:
            command = np.asarray(action if dynamics.commands is None else dynamics.commands[action], float)
            for _ in range(int(self._parts[row])):
                dynamics.move(state, command, self._wind[row], self._parameters[row], self._dt_s[row])  # type: ignore[misc]  # a body moves
        return state

    def _find_kinds(self, count: int) -> list[tuple[Callable[..., None], np.ndarray]]:
        """Return each compiled loop over vehicles, with the vehicles that it moves, bool (B,)."""
        own: dict[Any, np.ndarray] = {}
        for row, dynamics in self.dynamics.items():
            own.setdefault(dynamics.move, np.zeros(count, bool))[row] = True
        return [(loop_over(move), rows) for move, rows in own.items()]


def _with_room(array: np.ndarray, sides: tuple[int, ...]) -> np.ndarray:
    """Return `array` (B, ...) with at least these `sides` after B, padded with zeros."""
    missing = [(0, max(0, side - here)) for side, here in zip(sides, array.shape[1:], strict=True)]
    return np.pad(array, [(0, 0), *missing]) if any(more for _, more in missing) else array
