"""Measure what the events of a sideways sliding camera say about depth, recorded and simulated."""
