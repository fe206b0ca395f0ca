"""Made-up episodes for tests of statistics."""

import numpy as np

from jobs.rollout.episodes import EPISODE


def flights(success, trials=20, offset_m=0.0):
    """EPISODE of one training that succeeds in its first corridors."""
    flown = np.zeros(trials, EPISODE)
    flown["seed"] = np.arange(trials)
    flown["success"][:success] = True
    flown["distance_m"] = np.where(flown["success"], 100.0, 40.0 + flown["seed"]) + offset_m
    flown["events_per_step"] = 300.0
    return flown
