"""Vehicles that fly through corridors, many in one compiled call."""

from envs.vehicles.vehicles import StepError, Vehicles

__all__ = ["StepError", "Vehicles"]
