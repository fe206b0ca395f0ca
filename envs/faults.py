"""What a real sensor does wrong: dead pixels and events without cause (appendix D.3)."""

import numpy as np

from envs.config import FaultsConfig
from envs.events import EVENT


def dead_pixels(shape: tuple[int, int], sparsity: float, rng: np.random.Generator) -> np.ndarray:
    """Draw which pixels are off (appendix D.3, induced sparsity).

    Args:
        shape: (H, W).
        sparsity: Fraction of pixels that are off; their number is rounded to the nearest.
        rng: Source of the draw; the same stream gives the same pixels.

    Returns:
        bool (H, W), True where dead.

    Raises:
        ValueError: `sparsity` is not in [0, 1].
    """
    if not 0.0 <= sparsity <= 1.0:
        raise ValueError(f"sparsity must be a fraction in [0, 1]; got {sparsity}.")
    mask = np.zeros(shape, bool)
    mask.flat[rng.permutation(mask.size)[: round(sparsity * mask.size)]] = True
    return mask


def drop_dead(events: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The events (EVENT, order kept) of pixels that `mask` (bool (H, W)) does not call dead."""
    return events[~mask[events["y"], events["x"]]]


def add_background(
    events: np.ndarray,
    t0_us: int,
    t1_us: int,
    faults: FaultsConfig,
    dead: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """Add events without cause (appendix D.3, background activity).

    Their number is Poisson(background_activity * events) plus Poisson(background_activity_hz
    * live pixels * time). Each takes a live pixel, a microsecond of (t0_us, t1_us] and a
    polarity, all uniform.

    Args:
        events: EVENT of the interval, sorted by time, dead pixels already dropped.
        t0_us: Start of the interval [us].
        t1_us: Its end [us], later than the start.
        faults: How much.
        dead: bool (H, W), True where a pixel is dead.
        rng: Source of the draws.

    Returns:
        EVENT sorted by (t, y, x), true events first where all three are equal.

    Raises:
        ValueError: The interval is empty.
    """
    if t1_us <= t0_us:
        raise ValueError(f"background activity needs t1_us > t0_us; got {t0_us} and {t1_us}.")
    live = np.flatnonzero(~dead)
    rate = faults.background_activity_hz * live.size * (t1_us - t0_us) * 1e-6
    number = int(rng.poisson(faults.background_activity * events.size) + rng.poisson(rate))
    if number == 0 or live.size == 0:
        return events
    noise = np.empty(number, EVENT)
    noise["t"] = rng.integers(t0_us, t1_us, number) + 1
    noise["y"], noise["x"] = np.divmod(live[rng.integers(0, live.size, number)], dead.shape[1])
    noise["p"] = 2 * rng.integers(0, 2, number) - 1
    both = np.concatenate((events, noise))
    return both[np.lexsort((both["x"], both["y"], both["t"]))]
