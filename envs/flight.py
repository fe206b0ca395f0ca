"""Vehicles on their way through corridors, and one control step of many of them in one compiled call.

The call moves each vehicle, finds contact and goal, and simulates the camera of every sensor that
sees by looks (`envs.sensor`). Other sensors, and faults, take their turn in Python afterwards.
"""

from typing import Any

import numba
import numpy as np
from numba.typed import List

from envs.config import EnvConfig
from envs.events import EVENT
from envs.fidelity import parts_of
from envs.kinematics import Lane, Outcome, advance, clock_us, planned_position
from envs.raycast.silhouettes import Way
from envs.scene import Scene
from envs.sensor import Sensor, check_sensed, sense_way

GOOD, BAD_REWARD = -1, -10

_FLOATS = (
    *("spawn_x_m", "x_m", "y_m"),
    *("speed_mps", "control_hz", "radius_m", "height_m", "half_width_m", "length_m"),
    *("max_step_m", "limit_us"),  # way between two renders, and when the time is up
    # The last step: where it began, the share of it that was flown, its reward, its renders.
    *("start_x_m", "start_y_m", "share", "reward", "renders"),
)
_WHOLE = (
    *("forward", "left", "right"),  # how often each action was taken
    *("start_us", "t_us", "window_us"),  # when the last step began and ended; its length, or that of the first
    *("num_events", "dropped"),  # events of it, and those that the camera lost in it
    "problem",  # `GOOD`, `BAD_REWARD`, or what `sense_way` says
)
_FLAGS = ("by_looks", "success", "collision", "truncated", "over")
FLIGHT = np.dtype(
    [(name, "f8") for name in _FLOATS] + [(name, "i8") for name in _WHOLE] + [(name, "?") for name in _FLAGS],
    align=True,
)


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


@numba.njit(cache=True, error_model="numpy")
def line_up(corridor, count):
    """A list with `count` times the same corridor: level sections of what stands there, and a `View`."""
    corridors = List()
    for _ in range(count):
        corridors.append(corridor)
    return corridors


@numba.njit(cache=True, error_model="numpy")
def put(corridors, row, corridor):
    """Exchange one corridor of a list."""
    corridors[row] = corridor


@numba.njit(cache=True, error_model="numpy")
def fly(rows, corridors, actions, active):
    """One control step of all active vehicles.

    Args:
        rows: (B,) FLIGHT, changed in place.
        corridors: A list of B, see `line_up`.
        actions: int64 (B,).
        active: bool (B,).

    Returns:
        EVENT of those that see by looks, vehicle after vehicle; int64 (B + 1,), where the events of each end.
    """
    found, ends = [np.empty(0, EVENT)], np.zeros(rows.size + 1, np.int64)
    for row in range(rows.size):
        ends[row + 1] = ends[row]
        if active[row]:
            sections, view = corridors[row]
            _move(rows[row], actions[row], sections)
            if rows[row].by_looks and rows[row].problem == GOOD:
                events = _look(rows[row], view)
                found.append(events)
                ends[row + 1] += events.size
            rows[row].over |= rows[row].problem != GOOD
    together, size = np.empty(ends[-1], EVENT), 0
    for events in found:
        together[size : size + events.size] = events
        size += events.size
    return together, ends


@numba.njit(cache=True, error_model="numpy")
def _move(flight, action, sections):
    """Move a vehicle, and say what that brought."""
    flight.forward += action == 0
    flight.left += action == 1
    flight.right += action == 2
    moves, step_m = (flight.forward, flight.left, flight.right), (flight.speed_mps, flight.control_hz)
    lane = Lane(flight.radius_m, flight.half_width_m, flight.length_m)
    start = flight.x_m, flight.y_m
    outcome = advance(lane, sections, start, planned_position(flight.spawn_x_m, moves, step_m))
    flight.start_x_m, flight.start_y_m = start
    flight.x_m, flight.y_m = outcome.end
    flight.share, flight.reward = outcome.share, outcome.reward
    flight.success, flight.collision = outcome.success, outcome.collision
    flight.start_us, flight.t_us = flight.t_us, clock_us(sum(moves), flight.control_hz)
    flight.window_us = flight.t_us - flight.start_us
    flight.dropped, flight.renders = 0, 0.0
    ended = outcome.success or outcome.collision
    flight.truncated = not ended and flight.t_us >= flight.limit_us
    flight.over = ended or flight.truncated
    flight.problem = GOOD if np.isfinite(outcome.reward) else BAD_REWARD


@numba.njit(cache=True, error_model="numpy")
def way_of(flight):
    """The `Way` of the last step, up to where the vehicle stopped."""
    moving_us = np.int64(np.rint(flight.share * flight.window_us))
    place = flight.start_x_m, flight.start_y_m, flight.x_m, flight.y_m
    return Way(place[0], place[1], place[2], place[3], flight.height_m, flight.start_us, moving_us)


@numba.njit(cache=True, error_model="numpy")
def _look(flight, view):
    """Events of the last step of a vehicle; it stands still, and sees nothing, once it has stopped."""
    way = way_of(flight)
    if way.moving_us == 0:
        return np.empty(0, EVENT)
    way_m = flight.share * flight.speed_mps / flight.control_hz
    parts = min(parts_of(way_m, flight.max_step_m), way.moving_us)
    flight.problem, flight.dropped, columns, events = sense_way(view, way, parts)
    flight.renders = columns / view.seen_us.size
    return events
