"""Calibrate the simulated camera: find the settings that reproduce a recording."""
