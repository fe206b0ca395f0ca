"""One control step of many vehicles in one compiled call.

It moves each vehicle, finds contact and goal, and simulates every sensor with adaptive column rendering
(`Sensor.sees_by_looks`), including its faults. Python handles other sensors and rarer faults
(`RealSensor.is_compiled`) afterwards. A kinematic vehicle is moved here; for other vehicles
`envs.vehicles.bodies` provides the way of the step.
"""

import math

import numba
import numpy as np
from numba.typed import List

from envs.events import EVENT
from envs.events.camera import MAX_EVENTS_PER_FRAME
from envs.events.emission import concatenated
from envs.events.faults import spoil
from envs.fidelity import sub_renders
from envs.kinematics import Lane, advance, clock_us, follow, planned_position
from envs.raycast.silhouettes import Way
from envs.sensor import joined, sense_way

GOOD, BAD_REWARD, TOO_MANY_FALSE = -1, -10, -11

_FLOATS = (
    *("spawn_x_m", "spawn_y_m", "x_m", "y_m"),
    *("vx_mps", "vy_mps"),  # of a vehicle with a body
    *("speed_mps", "control_hz", "radius_m", "height_m", "half_width_m", "length_m"),
    *("max_step_m", "limit_us"),  # longest way between two renders; time limit of the episode
    # The last step: its start, the share of it in which the vehicle moved, its reward, its renders.
    *("start_x_m", "start_y_m", "share", "reward", "renders"),
)
_WHOLE = (
    "steps",  # of the episode so far
    *("forward", "left", "right"),  # number of times each action was taken
    "parts",  # straight parts of the way of a step; 0: the vehicle is kinematic
    "delay",  # steps from a decision to its action
    *("start_us", "t_us"),  # start and end of the last step
    "window_us",  # length of the last step; before any step, the length of the first
    *("num_events", "dropped"),  # number of events of the last step, and of events lost in it
    "problem",  # `GOOD`, `BAD_REWARD`, `TOO_MANY_FALSE`, or the problem that `sense_way` reports
)
_FLAGS = ("by_looks", "success", "collision", "truncated", "over")
VEHICLE = np.dtype(
    [(name, "f8") for name in _FLOATS] + [(name, "i8") for name in _WHOLE] + [(name, "?") for name in _FLAGS],
    align=True,
)


@numba.njit(cache=True, error_model="numpy")
def corridor_list(corridor, count):
    """Return a typed list that repeats one element `count` times.

    The element is a corridor (standing sections, moving sections and a `View`) or a `FaultState`.
    """
    corridors = List()
    for _ in range(count):
        corridors.append(corridor)
    return corridors


@numba.njit(cache=True, error_model="numpy")
def set_corridor(corridors, row, corridor):
    """Replace one element of a list from `corridor_list`."""
    corridors[row] = corridor


@numba.njit(cache=True, error_model="numpy")
def step_all(rows, corridors, faulty, actions, ways, active):
    """Simulate one control step of all active vehicles.

    Args:
        rows: (B,) VEHICLE, changed in place.
        corridors: A list of B corridors, see `corridor_list`.
        faulty: A list of B `FaultState`; used for sensors with `by_looks`.
        actions: int64 (B,), used for kinematic vehicles.
        ways: float64 (B, N, 2), the planned places of vehicles with bodies, `Bodies.ways`.
        active: bool (B,).

    Returns:
        EVENT of the sensors with `by_looks`, vehicle after vehicle; int64 (B + 1,), the bounds of each
        vehicle's events; and both again before faults. Without faults the event arrays are the same object.
    """
    found, ends = [np.empty(0, EVENT)], np.zeros(rows.size + 1, np.int64)
    true, true_ends, spoilt = [np.empty(0, EVENT)], np.zeros(rows.size + 1, np.int64), False
    for row in range(rows.size):
        ends[row + 1], true_ends[row + 1] = ends[row], true_ends[row]
        if active[row]:
            sections, moving, view = corridors[row]
            _move(rows[row], actions[row], (sections, moving), ways[row])
            if rows[row].by_looks and rows[row].problem == GOOD:
                events = _look(rows[row], view, ways[row])
                true.append(events)
                true_ends[row + 1] += events.size
                faults = faulty[row]
                if faults.is_on and rows[row].problem == GOOD:  # here, because the camera's memory is cached
                    span_us, spoilt = (rows[row].start_us, rows[row].t_us), True
                    events = spoil(events, span_us, view.model, view.memory, faults)
                    if faults.expected[0] > MAX_EVENTS_PER_FRAME:
                        rows[row].problem = TOO_MANY_FALSE
                found.append(events)
                ends[row + 1] += events.size
            rows[row].over |= rows[row].problem != GOOD
    together = concatenated(found, ends[-1])
    return together, ends, concatenated(true, true_ends[-1]) if spoilt else together, true_ends


@numba.njit(cache=True, error_model="numpy")
def _move(vehicle, action, still_and_moving, way):
    """Move a vehicle and store the result in its record."""
    vehicle.steps += 1
    lane = Lane(vehicle.radius_m, vehicle.half_width_m, vehicle.length_m)
    start = vehicle.x_m, vehicle.y_m
    if vehicle.parts == 0:
        vehicle.forward += action == 0
        vehicle.left += action == 1
        vehicle.right += action == 2
        moves = vehicle.forward, vehicle.left, vehicle.right
        step_m = vehicle.speed_mps, vehicle.control_hz
        x_m, y_m = planned_position(vehicle.spawn_x_m, moves, step_m)
        planned = x_m, vehicle.spawn_y_m + y_m
        outcome = advance(lane, still_and_moving, (0.0, 1.0), start, planned)
    else:
        outcome = follow(lane, still_and_moving, way[: vehicle.parts + 1])
    vehicle.start_x_m, vehicle.start_y_m = start
    vehicle.x_m, vehicle.y_m = outcome.end
    vehicle.share, vehicle.reward = outcome.share, outcome.reward
    vehicle.success, vehicle.collision = outcome.success, outcome.collision
    vehicle.start_us, vehicle.t_us = vehicle.t_us, clock_us(vehicle.steps, vehicle.control_hz)
    vehicle.window_us = vehicle.t_us - vehicle.start_us
    vehicle.dropped, vehicle.renders = 0, 0.0
    ended = outcome.success or outcome.collision
    vehicle.truncated = not ended and vehicle.t_us >= vehicle.limit_us
    vehicle.over = ended or vehicle.truncated
    vehicle.problem = GOOD if np.isfinite(outcome.reward) else BAD_REWARD


@numba.njit(cache=True, error_model="numpy")
def way_of(vehicle):
    """Return the `Way` of the last step of a kinematic vehicle, up to where it stopped."""
    moving_us = round(vehicle.share * vehicle.window_us)
    place = vehicle.start_x_m, vehicle.start_y_m, vehicle.x_m, vehicle.y_m
    return Way(place[0], place[1], place[2], place[3], vehicle.height_m, vehicle.start_us, moving_us)


@numba.njit(cache=True, error_model="numpy")
def way_of_part(vehicle, way, part):
    """Return the `Way` of one part of the last step, up to where the vehicle stopped."""
    begin_us = vehicle.start_us + vehicle.window_us * part // vehicle.parts
    end_us = vehicle.start_us + vehicle.window_us * (part + 1) // vehicle.parts
    share = min(1.0, max(0.0, vehicle.share * vehicle.parts - part))
    end = (way[part + 1, 0], way[part + 1, 1]) if share == 1.0 else (vehicle.x_m, vehicle.y_m)
    moving_us = round(share * (end_us - begin_us))
    return Way(way[part, 0], way[part, 1], end[0], end[1], vehicle.height_m, begin_us, moving_us)


@numba.njit(cache=True, error_model="numpy", inline="always")
def _look(vehicle, view, way):
    """Return the sorted events of a vehicle's last step."""
    events = _look_along(vehicle, view, way, 0)
    for part in range(1, vehicle.parts):
        if vehicle.problem == GOOD:
            events = joined(events, _look_along(vehicle, view, way, part))
    return events


@numba.njit(cache=True, error_model="numpy", inline="always")
def _look_along(vehicle, view, places, part):
    """Return the events of a part of the last step; there are none once the vehicle has stopped."""
    if vehicle.parts == 0:
        way, way_m = way_of(vehicle), vehicle.share * vehicle.speed_mps / vehicle.control_hz
    else:
        way = way_of_part(vehicle, places, part)
        way_m = math.hypot(way.end_x - way.start_x, way.end_y - way.start_y)
    if way.moving_us == 0:
        return np.empty(0, EVENT)
    parts = min(sub_renders(way_m, vehicle.max_step_m), way.moving_us)
    vehicle.problem, dropped, columns, events = sense_way(view, way, parts)
    vehicle.dropped += dropped
    vehicle.renders += columns / view.seen_us.size
    return events
