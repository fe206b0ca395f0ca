"""A batch of vehicles: their records, and the events of their last steps."""

import dataclasses
from typing import Any

import numpy as np

from core.neighbour_filter import NEVER, filter_all
from envs.config import EnvConfig
from envs.events import EVENT
from envs.events.faults import FaultState
from envs.kinematics import Point, clock_us
from envs.scene import Scene
from envs.scene.moving import MovingBody, Throws
from envs.scene.paths import moving_sections
from envs.sensor import Sensor, check_sensed
from envs.vehicles import task
from envs.vehicles.bodies import Bodies
from envs.vehicles.dynamics import Dynamics
from envs.vehicles.step import (
    BAD_REWARD,
    GOOD,
    TOO_MANY_FALSE,
    VEHICLE,
    corridor_list,
    set_corridor,
    step_all,
    way_of,
)

NOTHING = np.zeros((0, 7))  # sections of a scene in which nothing stands
NOTHING.flags.writeable = False  # as the sections of a scene, so that numba sees one type
NOTHING_MOVES = np.zeros((0, 9))


@dataclasses.dataclass
class Moving:
    """The moving bodies in a vehicle's scene.

    Attributes:
        bodies: Moving bodies on their current paths; if balls are thrown, the ball comes last.
        throws: Throws of the episode; None: no balls.
        sections: float64 (M, 9), filled by `envs.scene.paths.moving_sections`.
        thrown: Number of throws so far.
    """

    bodies: tuple[MovingBody, ...]
    throws: Throws | None
    sections: np.ndarray
    thrown: int = 0

    def throw(self, t_s: float, state: tuple[float, ...]) -> None:
        """Throw the ball at a vehicle of `state` x, y [m], vx, vy [m/s], if a throw is due."""
        throws = self.throws.throws if self.throws is not None else ()
        if self.throws is not None and self.thrown < len(throws) and throws[self.thrown].t_s <= t_s:
            ball = self.throws.thrown(self.thrown, t_s, (state[0], state[1], state[2], state[3]))
            self.bodies, self.thrown = (*self.bodies[:-1], ball), self.thrown + 1


class StepError(ValueError):
    """Error in a step, with the row of the vehicle."""

    def __init__(self, row: int, reason: str) -> None:
        """Store the row and the reason."""
        super().__init__(reason)
        self.row = row


class Vehicles:
    """A batch of vehicles, each in its own corridor.

    Attributes:
        rows: (B,) VEHICLE, state of each vehicle and the results of its last step.
        events: EVENT of the last step of all vehicles, one after the other, faults included.
        ends: int64 (B + 1,), vehicle b has events ends[b] .. ends[b + 1] - 1.
        seen: EVENT that pass the neighbour filter of their vehicle.
        seen_ends: int64 (B + 1,), like `ends`, for `seen`.
        num_seen: int64 (B,), number of events in `seen` in each vehicle's last step.
    """

    def __init__(self, count: int) -> None:
        """Allocate `count` vehicles, none of which has started."""
        self.rows = np.zeros(count, VEHICLE)
        self.rows["over"] = True
        self._sensors: list[Sensor | None] = [None] * count
        self._in_python: set[int] = set()
        self._corridors: Any = None
        self._faults: Any = None  # faults that the compiled step applies
        self._faults_of: list[FaultState | None] = [None] * count
        self._bodies = Bodies(count)
        self._straight = np.zeros(count, np.int64)  # headings for `step_all` if actions are a Box
        self._moving: dict[int, Moving] = {}  # row -> moving bodies of its scene, if it has any
        self._judges: dict[int, task.Judge] = {}  # row -> judge of its task, if not "corridor"
        self._decided = np.zeros((count, 0), np.int64)  # ring buffers of actions not yet taken
        self._last_us = np.full((count, 0, 0), NEVER)  # state of the neighbour filters
        self._support, self._tau_us = np.zeros((2, count), np.int64)
        self.num_seen = np.zeros(count, np.int64)
        self.forget_events()

    def start(
        self,
        row: int,
        config: EnvConfig,
        scene: Scene,
        sensor: Sensor,
        spawn: Point,
        dynamics: Dynamics,
    ) -> None:
        """Start a vehicle at `spawn`, x and y [m], in a scene to which its sensor has been reset."""
        vehicle = self.rows[row : row + 1]
        vehicle[:] = np.zeros(1, VEHICLE)
        self.num_seen[row] = 0
        vehicle["spawn_x_m"] = vehicle["x_m"] = spawn[0]
        vehicle["spawn_y_m"] = vehicle["y_m"] = spawn[1]
        vehicle["parts"] = self._bodies.start(row, config, dynamics, spawn)
        vehicle["vx_mps"], vehicle["vy_mps"] = dynamics.state[2:4]
        vehicle["speed_mps"], vehicle["control_hz"] = config.speed_mps, config.control_hz
        vehicle["radius_m"], vehicle["height_m"] = config.vehicle_radius_m, config.camera_height_m
        vehicle["half_width_m"], vehicle["length_m"] = 0.5 * scene.width_m, scene.length_m
        vehicle["limit_us"], vehicle["by_looks"] = config.time_limit_s * 1e6, sensor.sees_by_looks
        vehicle["max_step_m"] = sensor.plan.max_step_m if sensor.sees_by_looks else np.inf
        vehicle["window_us"], vehicle["problem"] = clock_us(1, config.control_hz), GOOD
        self._set_delay(row, config.delay_steps, dynamics.straight)
        self._set_task(row, config.task)
        self._sensors[row] = sensor
        moving = self._start_moving(row, scene)
        corridor = scene.sections(config.camera_height_m), moving, sensor.view()
        faults = sensor.faults()
        if self._corridors is None:
            self._corridors = corridor_list(corridor, len(self.rows))
            self._faults = corridor_list(faults, len(self.rows))
            self._faults_of = [faults] * len(self.rows)
        set_corridor(self._corridors, row, corridor)
        if faults is not self._faults_of[row]:  # numba is slow to find the type of a random stream
            set_corridor(self._faults, row, faults)
            self._faults_of[row] = faults
        self._set_filter(row, config)
        self._in_python.discard(row)
        if sensor.needs_python:
            self._in_python.add(row)
        if len(self.rows) == 1:
            self.forget_events()

    def pass_through(self, row: int) -> None:
        """Let a started vehicle fly through everything, walls and the goal line included."""
        sensor = self._sensors[row]
        assert sensor is not None  # noqa: S101  for the type checker
        self.rows["half_width_m"][row] = self.rows["length_m"][row] = np.inf
        set_corridor(self._corridors, row, (NOTHING, NOTHING_MOVES, sensor.view()))

    def step(self, actions: np.ndarray, active: np.ndarray) -> None:
        """Simulate one control step of the active vehicles; results are in `rows`, `events` and `ends`.

        Args:
            actions: int64 (B,) or float64 (B, C), valid; decided now, and taken when the delay of each
                vehicle is over.
            active: bool (B,); the others stay unchanged, without events. At least one vehicle has started.

        Raises:
            StepError: A number became NaN or infinite; the vehicle's episode is over.
        """
        rows = self.rows
        taken = self._exchange(actions, active)
        headings = taken
        self._move_bodies(active)
        if self._bodies.dynamics:
            self._bodies.move(taken, active)
            rows["vx_mps"], rows["vy_mps"] = self._bodies.velocities
            headings = taken if taken.ndim == 1 else self._straight
        self.events, self.ends, self._true, self._true_ends = step_all(
            rows, self._corridors, self._faults, headings, self._bodies.ways, active
        )
        if self._judges:
            self._judge(active)
        wrong = active & (rows["problem"] != GOOD)
        if wrong.any():
            self._refuse(int(wrong.argmax()))
        in_python = [row for row in sorted(self._in_python) if active[row]]
        if in_python:
            parts = [self.events_of(row) for row in range(len(rows))]
            for row in in_python:
                parts[row] = self._sense(row, parts[row])
            np.cumsum([part.size for part in parts], out=self.ends[1:])
            self.events = np.concatenate(parts)
        counts = np.diff(self.ends)[active]
        rows["num_events"][active] = self.num_seen[active] = counts
        self.seen, self.seen_ends = self.events, self.ends
        if self._support.any():
            filters = self._last_us, self._support, self._tau_us
            self.seen, self.seen_ends = filter_all(self.events, self.ends, *filters)
            self.num_seen[active] = np.diff(self.seen_ends)[active]

    def events_of(self, row: int) -> np.ndarray:
        """Return the EVENT array of a vehicle in the last step; empty if the vehicle was not active."""
        return self._part_of(row, self.events, self.ends)

    def seen_of(self, row: int) -> np.ndarray:
        """Return the events of a vehicle that pass its neighbour filter."""
        return self._part_of(row, self.seen, self.seen_ends)

    def true_of(self, row: int) -> np.ndarray:
        """Return the events of a vehicle before the faults of its sensor."""
        sensor = self._sensors[row]
        if row in self._in_python and sensor is not None and self.rows["t_us"][row]:
            return sensor.true_events
        return self._part_of(row, self._true, self._true_ends)

    def _part_of(self, row: int, events: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Return the part of a vehicle in the events of the last step; empty before its first step."""
        return events[ends[row] : ends[row + 1]] if self.rows["t_us"][row] else np.empty(0, EVENT)

    def decided(self, row: int) -> np.ndarray:
        """Return the actions that a vehicle has decided and not yet taken, the next one first."""
        delay = self.rows["delay"][row]
        turns = (self.rows["steps"][row] + np.arange(delay)) % max(1, delay)
        return self._decided[row, turns]

    def state_of_action(self, row: int) -> np.ndarray:
        """Return the state of a vehicle with a body when its next decision is taken, float64 (S,)."""
        return self._bodies.state_after(row, self.decided(row))

    def moving(self, row: int) -> tuple[MovingBody, ...]:
        """Return the moving bodies of a vehicle's scene on their current paths."""
        return self._moving[row].bodies if row in self._moving else ()

    def forget_events(self) -> None:
        """Forget the events of the last step."""
        self.events, self.ends = np.empty(0, EVENT), np.zeros(len(self.rows) + 1, np.int64)
        self.seen, self.seen_ends = self.events, self.ends
        self._true, self._true_ends = self.events, self.ends.copy()

    def _set_delay(self, row: int, steps: int, straight: Any) -> None:
        """Start an episode with `steps` pending decisions to fly straight ahead."""
        self.rows["delay"][row] = steps
        action = np.asarray(straight)
        if self._decided.shape[2:] != action.shape or self._decided.dtype != action.dtype:
            self._decided = np.zeros((len(self.rows), 0, *action.shape), action.dtype)
        missing = steps - self._decided.shape[1]
        if missing > 0:
            self._decided = np.pad(self._decided, ((0, 0), (0, missing), *[(0, 0)] * action.ndim))
        self._decided[row] = action

    def _start_moving(self, row: int, scene: Scene) -> np.ndarray:
        """Start the moving bodies of an episode; return the array of their sections, (M, 9)."""
        self._moving.pop(row, None)
        if not scene.movers:
            return NOTHING_MOVES
        sections = np.zeros((len(scene.movers), 9))
        self._moving[row] = Moving(scene.movers, scene.throws, sections)
        return sections

    def _move_bodies(self, active: np.ndarray) -> None:
        """Move the bodies of the active vehicles' scenes through the next control step."""
        for row, moving in self._moving.items():
            vehicle, sensor = self.rows[row], self._sensors[row]
            if not active[row] or sensor is None:
                continue
            end_us = clock_us(int(vehicle["steps"]) + 1, float(vehicle["control_hz"]))
            span_s = 1e-6 * int(vehicle["t_us"]), 1e-6 * end_us
            # Balls are aimed at a kinematic vehicle as if it flew straight ahead.
            ahead = "vy_mps" if vehicle["parts"] else "speed_mps"
            state = tuple(float(vehicle[name]) for name in ("x_m", "y_m", "vx_mps", ahead))
            moving.throw(span_s[0], state)
            moving_sections(moving.bodies, *span_s, float(vehicle["height_m"]), moving.sections)
            sensor.move_bodies(moving.bodies, *span_s)

    def _set_task(self, row: int, name: str) -> None:
        """Set the task of a new episode."""
        judge = task.judge_of(name)
        self._judges.pop(row, None)
        if judge is not None:
            self._judges[row] = judge

    def _judge(self, active: np.ndarray) -> None:
        """Judge the last step of the active vehicles whose task is not "corridor"."""
        for judge in set(self._judges.values()):
            own = [self._judges.get(row) is judge for row in range(len(self.rows))]
            task.loop_over(judge)(self.rows, active & own)

    def _exchange(self, actions: np.ndarray, active: np.ndarray) -> np.ndarray:
        """Queue the new decisions; return the decisions that are due now, given each vehicle's delay."""
        rows = self.rows
        if not self._decided.shape[1]:  # no vehicle has had a delay so far
            return actions
        late = np.flatnonzero(active & (rows["delay"] > 0))
        turn, taken = rows["steps"][late] % rows["delay"][late], actions.copy()
        taken[late] = self._decided[late, turn]
        self._decided[late, turn] = actions[late]
        return taken

    def _set_filter(self, row: int, config: EnvConfig) -> None:
        """Start the neighbour filter of an episode, if it has one."""
        self._support[row], self._tau_us[row] = config.filter_support, config.filter_tau_us
        if config.filter_support > 0:
            shape = config.camera.height + 2, config.camera.width + 2
            if any(np.less(self._last_us.shape[1:], shape)):
                before, sides = self._last_us, np.maximum(self._last_us.shape[1:], shape)
                self._last_us = np.full((len(self.rows), *sides), NEVER)
                self._last_us[:, : before.shape[1], : before.shape[2]] = before
            self._last_us[row] = NEVER

    def _sense(self, row: int, events: np.ndarray) -> np.ndarray:
        """Return the events of a step that the compiled call did not simulate completely."""
        vehicle, sensor = self.rows[row], self._sensors[row]
        assert sensor is not None  # noqa: S101  for the type checker
        start_us, t_us = int(vehicle["start_us"]), int(vehicle["t_us"])
        try:
            if vehicle["by_looks"]:
                events = sensor.with_faults(events, start_us, t_us)
                vehicle["dropped"] += sensor.lost
                return events
            start = float(vehicle["start_x_m"]), float(vehicle["start_y_m"])
            end = float(vehicle["x_m"]), float(vehicle["y_m"])
            way = self._bodies.way(row) if vehicle["parts"] else None
            sensor.step(start, end, float(vehicle["share"]), t_us, way)
        except ValueError as error:
            vehicle["over"] = True
            raise StepError(row, str(error)) from error
        vehicle["dropped"], vehicle["renders"] = sensor.dropped, sensor.renders
        return sensor.events

    def _refuse(self, row: int) -> None:
        """Raise the error that the compiled call found."""
        vehicle, sensor = self.rows[row].copy(), self._sensors[row]
        assert sensor is not None  # noqa: S101  for the type checker
        if vehicle["problem"] == BAD_REWARD:
            way = f"from {vehicle['start_x_m']}, {vehicle['start_y_m']} to {vehicle['x_m']}, {vehicle['y_m']}"
            raise StepError(row, f"the reward must be finite; got {vehicle['reward']} on the way {way}.")
        try:
            if vehicle["problem"] == TOO_MANY_FALSE:
                sensor.check_faults(int(vehicle["start_us"]), int(vehicle["t_us"]))
            check_sensed(int(vehicle["problem"]), way_of(vehicle), sensor.view().scratch.columns)
        except ValueError as error:
            raise StepError(row, str(error)) from error
