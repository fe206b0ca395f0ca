"""The vehicle's event camera: where it looks within a control step, and the events of what it sees."""

from envs.sensor.sensor import Sensor

__all__ = ["Sensor"]
