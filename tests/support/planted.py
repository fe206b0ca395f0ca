"""Recordings of a simulated sensor whose settings are known."""

import dataclasses

import numpy as np

from envs.config import CameraConfig, FaultsConfig
from jobs.tools.calibrate.footage import Footage, simulate, still_footage

HZ, SECONDS = 100, 10.0


def moving_footage(width=32, waving=12, flickering=4, still=24, seed=0):
    """Rows whose light waves slowly, rows that flicker by a factor of seven, and rows that rest; 10 s."""
    rng, t = np.random.default_rng(seed), np.arange(int(SECONDS * HZ) + 1) / HZ
    height = waving + flickering + still
    response = np.zeros((t.size, height, width), np.float32)
    base = rng.uniform(np.log(0.05), np.log(0.4), (height, width)).astype(np.float32)
    times = t[:, None, None].astype(np.float32)
    for hz in rng.uniform(0.3, 3.0, 6):
        phase = (2 * np.pi * rng.random((waving, width))).astype(np.float32)
        response[:, :waving] += 0.45 * np.sin(np.float32(2 * np.pi * hz) * times + phase)
    rates = rng.uniform(2, 5, (flickering, width)).astype(np.float32)
    response[:, waving : waving + flickering] = np.sign(np.sin(2 * np.pi * rates * times))
    light = np.clip(np.exp(base + response), 0.0, 1.0).astype(np.float32)
    return Footage(light, np.rint(t * 1e6).astype(np.int64))


def planted(footage, camera=None, faults=None, seed=7):
    """The events of a sensor with these settings."""
    height, width = footage.luminance.shape[1:]
    camera = dataclasses.replace(CameraConfig(**(camera or {})), width=width, height=height)
    return simulate(footage, camera, FaultsConfig(**(faults or {})), seed)


def still_planted(side, luminance, camera=None, faults=None, seed=7):
    """10 s of a uniform scene: its events, and the two frames that say all."""
    frames = Footage(
        np.full((101, side, side), luminance, np.float32), np.arange(0, 10_000_001, 100_000, dtype=np.int64)
    )
    return planted(frames, camera, faults, seed), still_footage((side, side), luminance, (0, 10_000_000))
