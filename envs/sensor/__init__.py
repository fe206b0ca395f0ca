"""The vehicle's event camera: where it looks within a control step, and the events of what it sees."""

from envs.sensor.looks import joined, sense_way
from envs.sensor.sensor import Sensor, check_sensed

__all__ = ["Sensor", "check_sensed", "joined", "sense_way"]
