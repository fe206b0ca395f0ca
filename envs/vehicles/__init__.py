"""Vehicles on their way through corridors, many of them in one compiled call."""

from envs.vehicles.vehicles import StepError, Vehicles

__all__ = ["StepError", "Vehicles"]
