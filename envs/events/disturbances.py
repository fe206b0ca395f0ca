"""Wrong events: displaced by a pixel, or of the other polarity.

No sensor makes such errors in these shares. They let a study compare kinds of errors at the same share of
wrong events (`conf/exp/dose_response.yaml`).
"""

import numpy as np

from envs.config import FaultsConfig

NEIGHBOURS = np.array([(dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1) if dx or dy])


def disturb(
    events: np.ndarray, faults: FaultsConfig, shape: tuple[int, int], rng: np.random.Generator
) -> np.ndarray:
    """Displace a share of the events to one of their 8 neighbours, and flip the polarity of a share.

    Each event is drawn independently. An event that would leave the image is displaced the opposite way.

    Args:
        events: EVENT sorted by (t, y, x); not changed.
        faults: `displaced` and `flipped`, the shares.
        shape: (H, W), at least 2 x 2 pixels if events are displaced.
        rng: Source of the draws; a share of 0 draws nothing.

    Returns:
        The same number of EVENT, sorted by (t, y, x).
    """
    if faults.displaced == faults.flipped == 0.0:
        return events
    events = events.copy()
    if faults.displaced > 0.0:
        moved = np.flatnonzero(rng.random(events.size) < faults.displaced)
        steps = NEIGHBOURS[rng.integers(0, len(NEIGHBOURS), moved.size)]
        for step, name, size in zip(steps.T, "xy", shape[::-1], strict=True):
            before = events[name][moved].astype(np.int64)
            after = before + step
            events[name][moved] = np.where((after < 0) | (after >= size), before - step, after)
        events = events[np.lexsort((events["x"], events["y"], events["t"]))]
    if faults.flipped > 0.0:
        turned = rng.random(events.size) < faults.flipped
        events["p"][turned] = -events["p"][turned]
    return events
