"""One control step of one sensor along a way that no vehicle would fly."""

import numpy as np

from envs.config import EnvConfig
from envs.events import EVENT
from envs.fidelity import sub_renders
from envs.kinematics import Outcome, Point
from envs.raycast.silhouettes import Way
from envs.sensor import Sensor, check_sensed, sense_way


def step_sensor(config: EnvConfig, sensor: Sensor, start: Point, outcome: Outcome, end_us: int) -> None:
    """Step any sensor, as a vehicle does that flies from `start` to `outcome.end`."""
    if not sensor.sees_by_looks:
        sensor.step(start, outcome.end, outcome.share, end_us, None)
        return
    begin_us, view = sensor.t_us, sensor.view()
    moving_us = round(outcome.share * (end_us - begin_us))
    events, sensor.dropped, sensor.renders = np.empty(0, EVENT), 0, 0
    if moving_us:
        way = Way(*start, *outcome.end, config.camera_height_m, begin_us, moving_us)
        way_m = outcome.share * config.speed_mps / config.control_hz
        parts = min(sub_renders(way_m, sensor.plan.max_step_m), moving_us)
        bad, sensor.dropped, columns, events = sense_way(view, way, parts)
        check_sensed(bad, way, view.scratch.columns)
        sensor.renders = columns / config.camera.width
    sensor.t_us, sensor.events = end_us, sensor.with_faults(events, begin_us, end_us)
