"""Vehicles side by side: where each is, and what its last step brought."""

from typing import Any

import numpy as np

from envs.config import EnvConfig
from envs.events import EVENT
from envs.flight.step import BAD_REWARD, FLIGHT, GOOD, fly, line_up, put, way_of
from envs.kinematics import Outcome, clock_us
from envs.scene import Scene
from envs.sensor import Sensor, check_sensed


class FlightError(ValueError):
    """A step that went wrong, and the row of the vehicle."""

    def __init__(self, row: int, reason: str) -> None:
        """Remember both."""
        super().__init__(reason)
        self.row = row


class Flights:
    """Vehicles side by side, each in a corridor of its own.

    Attributes:
        rows: (B,) FLIGHT, where each is and what its last step brought.
        events: EVENT of the last step of all, vehicle after vehicle, faults included.
        ends: int64 (B + 1,), vehicle b has events ends[b] .. ends[b + 1] - 1.
    """

    def __init__(self, count: int) -> None:
        """Room for `count` vehicles, none of which has started."""
        self.rows = np.zeros(count, FLIGHT)
        self.rows["over"] = True
        self._sensors: list[Sensor | None] = [None] * count
        self._by_hand: set[int] = set()
        self._corridors: Any = None
        self.forget_events()

    def start(self, row: int, config: EnvConfig, scene: Scene, sensor: Sensor, spawn_x_m: float) -> None:
        """Put a vehicle at the start of a scene that its sensor has been reset to."""
        flight = self.rows[row : row + 1]
        flight[:] = np.zeros(1, FLIGHT)
        flight["spawn_x_m"] = flight["x_m"] = spawn_x_m
        flight["speed_mps"], flight["control_hz"] = config.speed_mps, config.control_hz
        flight["radius_m"], flight["height_m"] = config.vehicle_radius_m, config.camera_height_m
        flight["half_width_m"], flight["length_m"] = 0.5 * scene.width_m, scene.length_m
        flight["limit_us"], flight["by_looks"] = config.time_limit_s * 1e6, sensor.sees_by_looks
        flight["max_step_m"] = sensor.plan.max_step_m if sensor.sees_by_looks else np.inf
        flight["window_us"], flight["problem"] = clock_us(1, config.control_hz), GOOD
        self._sensors[row] = sensor
        corridor = scene.sections(config.camera_height_m), sensor.view()
        if self._corridors is None:
            self._corridors = line_up(corridor, len(self.rows))
        put(self._corridors, row, corridor)
        self._by_hand.discard(row)
        if not sensor.sees_by_looks or sensor.has_faults:
            self._by_hand.add(row)
        if len(self.rows) == 1:
            self.forget_events()

    def step(self, actions: np.ndarray, active: np.ndarray) -> None:
        """One control step of the active vehicles; `rows`, `events` and `ends` tell what it brought.

        Args:
            actions: int64 (B,), valid.
            active: bool (B,); others stay as they are, without events. At least one vehicle has started.

        Raises:
            FlightError: A number became NaN or infinite; the vehicle's flight is over.
        """
        rows = self.rows
        self.events, self.ends = fly(rows, self._corridors, actions, active)
        wrong = rows["problem"] != GOOD
        if wrong.any():
            self._refuse(int((wrong & active).argmax()))
        by_hand = [row for row in sorted(self._by_hand) if active[row]]
        if by_hand:
            parts = [self.events_of(row) for row in range(len(rows))]
            for row in by_hand:
                parts[row] = self._sense(row, parts[row])
            np.cumsum([part.size for part in parts], out=self.ends[1:])
            self.events = np.concatenate(parts)
        rows["num_events"][active] = np.diff(self.ends)[active]

    def events_of(self, row: int) -> np.ndarray:
        """EVENT array of a vehicle in the last step of any; empty if it did not take part."""
        if not self.rows["t_us"][row]:
            return np.empty(0, EVENT)
        return self.events[self.ends[row] : self.ends[row + 1]]

    def forget_events(self) -> None:
        """Begin anew with a step that had no events."""
        self.events, self.ends = np.empty(0, EVENT), np.zeros(len(self.rows) + 1, np.int64)

    def _sense(self, row: int, events: np.ndarray) -> np.ndarray:
        """Events of a step that the compiled call has not simulated to the end."""
        flight, sensor = self.rows[row], self._sensors[row]
        assert sensor is not None  # noqa: S101  for the type checker
        start_us, t_us = int(flight["start_us"]), int(flight["t_us"])
        try:
            if flight["by_looks"]:
                return sensor.spoil(events, start_us, t_us)
            end = float(flight["x_m"]), float(flight["y_m"])
            share, ends = float(flight["share"]), (bool(flight["success"]), bool(flight["collision"]))
            outcome = Outcome(end, share, float(flight["reward"]), *ends)
            sensor.step((float(flight["start_x_m"]), float(flight["start_y_m"])), outcome, t_us)
        except ValueError as error:
            flight["over"] = True
            raise FlightError(row, str(error)) from error
        flight["dropped"], flight["renders"] = sensor.dropped, sensor.renders
        return sensor.events

    def _refuse(self, row: int) -> None:
        """Raise the error of a step that the compiled call has found."""
        flight, sensor = self.rows[row].copy(), self._sensors[row]
        assert sensor is not None  # noqa: S101  for the type checker
        if flight["problem"] == BAD_REWARD:
            way = f"from {flight['start_x_m']}, {flight['start_y_m']} to {flight['x_m']}, {flight['y_m']}"
            raise FlightError(row, f"the reward must be finite; got {flight['reward']} on the way {way}.")
        try:
            check_sensed(int(flight["problem"]), way_of(flight), sensor.view().scratch.image)
        except ValueError as error:
            raise FlightError(row, str(error)) from error
