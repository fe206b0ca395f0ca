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


def infos_of(episode):
    """The info of each place of an RLlib episode, a dict each; ours holds arrays, RLlib's own a list."""
    infos = episode.get_infos()
    columns = zip(*infos.values(), strict=True) if isinstance(infos, dict) else ()
    return [dict(zip(infos, values, strict=True)) for values in columns] or infos
