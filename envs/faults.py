"""What a real sensor does wrong: dead and hot pixels, lost events, events without cause (appendix D.3).

`draw_pixel_faults` says once per episode which pixels are faulty, `apply_faults` treats the
events of one interval. A fault that is off costs nothing and draws nothing.
"""

import dataclasses

import numpy as np

from envs.config import FaultsConfig
from envs.events import EVENT, MAX_EVENTS_PER_FRAME

SHOT_NOISE_FALL = 0.75  # from black to white, as a share of the noise in black (v2e)


@dataclasses.dataclass(frozen=True)
class PixelFaults:
    """The pixels' faults of one episode.

    Attributes:
        dead: bool (H, W); these never fire, not even noise.
        live: int64 (L,), flat indices of the others.
        hot: int64 (K,), flat indices of the hot ones among these.
        leak_phase: float64 (L,), part of a leak period until each live pixel's first leak
            event; of length 0 without leakage.
    """

    dead: np.ndarray
    live: np.ndarray
    hot: np.ndarray
    leak_phase: np.ndarray


def draw_pixel_faults(shape: tuple[int, int], faults: FaultsConfig, rng: np.random.Generator) -> PixelFaults:
    """Draw which pixels are dead (appendix D.3, induced sparsity) or hot, and when each leaks.

    Args:
        shape: (H, W).
        faults: How many. Numbers of pixels are rounded to the nearest; dead ones are not hot.
        rng: Source of the draws; the same stream gives the same pixels.
    """
    dead = np.zeros(shape, bool)
    if faults.sparsity > 0.0:
        dead.flat[rng.permutation(dead.size)[: round(faults.sparsity * dead.size)]] = True
    live = np.flatnonzero(~dead)
    hot, phase = live[:0], np.zeros(0)
    if faults.hot_pixel_share > 0.0:
        hot = np.sort(rng.permutation(live)[: round(faults.hot_pixel_share * dead.size)])
    if faults.leak_hz > 0.0:
        phase = rng.random(live.size)
    return PixelFaults(dead, live, hot, phase)


def apply_faults(
    events: np.ndarray,
    t0_us: int,
    t1_us: int,
    luminance: np.ndarray,
    faults: FaultsConfig,
    pixels: PixelFaults,
    rng: np.random.Generator,
) -> np.ndarray:
    """Lose true events and add false ones.

    Of the true events those of dead pixels are lost, and each other one with probability
    event_dropout. To the rest are added, in an interval of T seconds:

    - background_activity: Poisson, this share of the true events left (appendix D.3);
    - background_activity_hz: Poisson, rate * T per live pixel;
    - shot_noise_hz: Poisson, rate * T * (1 - 0.75 L) per live pixel, with the luminance L
      clipped to [0, 1] (v2e's formula: white has a quarter of the noise of black);
    - hot_pixel_hz: Poisson, rate * T per hot pixel;
    - leak_hz: an ON event of each live pixel every 1 / rate seconds since time 0, shifted by
      the pixel's phase, however time is cut into intervals.

    Times of all but the last are uniform in the interval; so are their polarities.

    Args:
        events: EVENT of the interval, sorted by (t, y, x).
        t0_us: Start of the interval [us].
        t1_us: Its end [us], later than the start.
        luminance: float32 (H, W), what the pixels see; 1 is white.
        faults: How much.
        pixels: Which pixels.
        rng: Source of the draws.

    Returns:
        EVENT with t in (t0_us, t1_us], sorted by (t, y, x), true events first where all are equal.

    Raises:
        ValueError: The interval is empty, or more than 2**24 false events are to be expected.
    """
    if t1_us <= t0_us:
        raise ValueError(f"faults need t1_us > t0_us; got {t0_us} and {t1_us}.")
    if faults.sparsity > 0.0:
        events = events[~pixels.dead[events["y"], events["x"]]]
    if faults.event_dropout > 0.0:
        events = events[rng.random(events.size) >= faults.event_dropout]
    seconds = (t1_us - t0_us) * 1e-6
    means = _expected(events.size, seconds, luminance, faults, pixels)
    expected = sum(float(mean.sum()) for _, mean in means) + faults.leak_hz * pixels.live.size * seconds
    if expected > MAX_EVENTS_PER_FRAME:
        raise ValueError(
            f"faults may add {MAX_EVENTS_PER_FRAME} events to an interval; these rates add about "
            f"{expected:.3g} from {t0_us} to {t1_us} us. Lower the rates or shorten the interval."
        )
    width = pixels.dead.shape[1]
    noise = [_at_any_time(_drawn(where, mean, rng), (t0_us, t1_us), width, rng) for where, mean in means]
    if faults.leak_hz > 0.0:
        noise.append(_leak(t0_us, t1_us, faults.leak_hz, pixels))
    if sum(batch.size for batch in noise) == 0:
        return events
    both = np.concatenate((events, *noise))
    return both[np.lexsort((both["x"], both["y"], both["t"]))]


def _expected(
    num_events: int, seconds: float, luminance: np.ndarray, faults: FaultsConfig, pixels: PixelFaults
) -> list[tuple[np.ndarray, np.ndarray]]:
    """For each kind of noise that is on: flat pixels, and means of their false events, or one for all."""
    means = []
    background = faults.background_activity * num_events
    background += faults.background_activity_hz * seconds * pixels.live.size
    if background > 0.0:
        means.append((pixels.live, np.array([background])))
    if faults.shot_noise_hz > 0.0:
        light = np.minimum(luminance.ravel()[pixels.live], 1.0)
        means.append((pixels.live, faults.shot_noise_hz * seconds * (1.0 - SHOT_NOISE_FALL * light)))
    if faults.hot_pixel_hz > 0.0:
        means.append((pixels.hot, np.array([faults.hot_pixel_hz * seconds * pixels.hot.size])))
    return means


def _drawn(where: np.ndarray, mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Flat pixels of false events: Poisson around each pixel's mean, or around one mean for all alike."""
    if where.size == 0:
        return where
    upto = np.cumsum(mean, dtype=np.float64)
    number = int(rng.poisson(upto[-1]))
    if mean.size == 1:
        return where[rng.integers(0, where.size, number)]
    place = np.searchsorted(upto, rng.random(number) * upto[-1], side="right")
    return where[np.minimum(place, where.size - 1)]


def _at_any_time(
    where: np.ndarray, span_us: tuple[int, int], width: int, rng: np.random.Generator
) -> np.ndarray:
    """EVENT at these flat pixels, times and polarities uniform."""
    noise = np.empty(where.size, EVENT)
    noise["t"] = rng.integers(*span_us, where.size) + 1
    noise["y"], noise["x"] = np.divmod(where, width)
    noise["p"] = 2 * rng.integers(0, 2, where.size) - 1
    return noise


def _leak(t0_us: int, t1_us: int, leak_hz: float, pixels: PixelFaults) -> np.ndarray:
    """EVENT of leakage; event k of a pixel comes (k + phase) / rate seconds after time 0."""
    first = np.floor(t0_us * 1e-6 * leak_hz - pixels.leak_phase)
    number = (np.floor(t1_us * 1e-6 * leak_hz - pixels.leak_phase) - first).astype(np.int64)
    which = np.repeat(np.arange(pixels.live.size), number)
    order = np.arange(which.size) - np.repeat(np.cumsum(number) - number, number)
    seconds = (first[which] + 1.0 + order + pixels.leak_phase[which]) / leak_hz
    noise = np.empty(which.size, EVENT)
    noise["t"] = np.clip(np.ceil(seconds * 1e6), t0_us + 1, t1_us)
    noise["y"], noise["x"] = np.divmod(pixels.live[which], pixels.dead.shape[1])
    noise["p"] = 1
    return noise
