"""The vehicle's event camera: its looks within a control step, and the events that they give."""

from envs.sensor.looks import joined, sense_way
from envs.sensor.sensor import Sensor, check_sensed

__all__ = ["Sensor", "check_sensed", "joined", "sense_way"]
