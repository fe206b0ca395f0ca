"""Vehicles on their way through corridors, many of them in one compiled call."""

from envs.flight.flights import FlightError, Flights

__all__ = ["FlightError", "Flights"]
