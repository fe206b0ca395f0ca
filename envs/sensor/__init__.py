"""The vehicle's event camera: its renders within a control step and the events that follow from them."""

from envs.sensor.looks import joined, sense_way
from envs.sensor.sensor import Sensor, check_sensed

__all__ = ["Sensor", "check_sensed", "joined", "sense_way"]
