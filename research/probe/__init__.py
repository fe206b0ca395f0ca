"""Measure what a regression can read from a representation of events."""
