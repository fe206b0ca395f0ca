"""Faults of a real sensor: dead and hot pixels, lost events, events without cause (appendix D.3).

`draw_pixel_faults` draws the faulty pixels of an episode, `apply_faults` applies all faults to the
events of one interval. A fault that is off costs nothing and draws nothing.

A plug-in adds a fault by `ADDED_FAULTS[name] = make`. At the start of an episode `make(amount, shape, rng)`
is called, with the amount of `faults.added.NAME`, the image's (H, W) and the episode's random stream. It
returns `apply(events, t0_us, t1_us, luminance)`, which is called after the faults of this file with the
arguments of `apply_faults`, and returns what the events become: EVENT, sorted by t.
"""

import dataclasses
from collections.abc import Callable, Mapping

import numba
import numpy as np

from envs.config import ADDED_FAULTS, FaultsConfig
from envs.events.camera import MAX_EVENTS_PER_FRAME
from envs.events.disturbances import disturb
from envs.events.emission import EVENT

Noise = tuple[np.ndarray, np.ndarray, np.ndarray]  # int64 each: times [us], flat pixels, polarities
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
        added: What applies each fault of a plug-in, by its name.
    """

    dead: np.ndarray
    live: np.ndarray
    hot: np.ndarray
    leak_phase: np.ndarray
    added: Mapping[str, Callable[..., np.ndarray]] = dataclasses.field(default_factory=dict)


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
    amounts = sorted(faults.added.items())
    added = {name: ADDED_FAULTS[name](amount, shape, rng) for name, amount in amounts if amount > 0.0}
    return PixelFaults(dead, live, hot, phase, added)


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
    event_dropout; some are displaced or flipped (`envs.events.disturbances`). To the rest are
    added, in an interval of T seconds:

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
        ValueError: The interval is empty, more than 2**24 false events are to be expected, or a plug-in's
            fault returned something else than events of the interval.
    """
    events = _with_own_faults(events, t0_us, t1_us, luminance, faults, pixels, rng)
    for name, apply in pixels.added.items():
        events = apply(events, t0_us, t1_us, luminance)
        _check_added(name, events, (t0_us, t1_us), luminance.shape)
    return events


def _check_added(name: str, events: np.ndarray, span_us: tuple[int, int], shape: tuple[int, ...]) -> None:
    """Raise ValueError if a plug-in's fault returned what is not events of this interval and image."""
    rule = f"fault {name!r} of {ADDED_FAULTS[name].__module__} must return EVENT"
    if getattr(events, "dtype", None) != EVENT or events.ndim != 1:
        raise ValueError(f"{rule} (N,), got {type(events).__name__} {getattr(events, 'dtype', '')}".strip())
    t = events["t"]
    if t.size and (t[0] <= span_us[0] or t[-1] > span_us[1] or (t[1:] < t[:-1]).any()):
        raise ValueError(f"{rule} sorted by t and with t in ({span_us[0]}, {span_us[1]}] us")
    if t.size and (events["y"].max() >= shape[0] or events["x"].max() >= shape[1]):
        raise ValueError(f"{rule} inside an image of {shape[1]} x {shape[0]} pixels")
    if not np.isin(events["p"], (-1, 1)).all():
        raise ValueError(f"{rule} with p in {{-1, 1}}")


def _with_own_faults(
    events: np.ndarray,
    t0_us: int,
    t1_us: int,
    luminance: np.ndarray,
    faults: FaultsConfig,
    pixels: PixelFaults,
    rng: np.random.Generator,
) -> np.ndarray:
    """As `apply_faults`, of the faults of this file."""
    if t1_us <= t0_us:
        raise ValueError(f"faults need t1_us > t0_us; got {t0_us} and {t1_us}.")
    if faults.sparsity > 0.0:
        events = events[~pixels.dead[events["y"], events["x"]]]
    if faults.event_dropout > 0.0:
        events = events[rng.random(events.size) >= faults.event_dropout]
    events = disturb(events, faults, pixels.dead.shape, rng)
    seconds = (t1_us - t0_us) * 1e-6
    kinds = _expected(events.size, seconds, luminance, faults, pixels)
    expected = sum(float(upto[-1]) for _, upto in kinds) + faults.leak_hz * pixels.live.size * seconds
    if expected > MAX_EVENTS_PER_FRAME:
        raise ValueError(
            f"faults may add {MAX_EVENTS_PER_FRAME} events to an interval; these rates add about "
            f"{expected:.3g} from {t0_us} to {t1_us} us. Lower the rates or shorten the interval."
        )
    noise = [_at_any_time(_drawn(where, upto, rng), (t0_us, t1_us), rng) for where, upto in kinds]
    if faults.leak_hz > 0.0:
        noise.append(_leak(t0_us, t1_us, faults.leak_hz, pixels.live, pixels.leak_phase))
    if not noise:
        return events
    times, places, polarities = (np.concatenate(parts) for parts in zip(*noise, strict=True))
    if times.size == 0:
        return events
    order = np.lexsort((places, times))
    return _merged(events, times[order], places[order], polarities[order], pixels.dead.shape[1])


def _expected(
    num_events: int, seconds: float, luminance: np.ndarray, faults: FaultsConfig, pixels: PixelFaults
) -> list[tuple[np.ndarray, np.ndarray]]:
    """For each kind of noise that is on: flat pixels, and the mean number of false events up to each.

    One number where all pixels are alike.
    """
    kinds = []
    background = faults.background_activity * num_events
    background += faults.background_activity_hz * seconds * pixels.live.size
    if background > 0.0 and pixels.live.size:
        kinds.append((pixels.live, np.array([background])))
    if faults.shot_noise_hz > 0.0 and pixels.live.size:
        in_black = faults.shot_noise_hz * seconds
        kinds.append((pixels.live, _shot_noise(luminance.ravel(), pixels.live, in_black)))
    if faults.hot_pixel_hz > 0.0 and pixels.hot.size:
        kinds.append((pixels.hot, np.array([faults.hot_pixel_hz * seconds * pixels.hot.size])))
    return kinds


@numba.njit(cache=True, error_model="numpy")
def _shot_noise(luminance: np.ndarray, live: np.ndarray, in_black: float) -> np.ndarray:
    """Mean number of shot noise events up to each live pixel, float64 (L,); `in_black` is a black pixel's."""
    black, white, fall = np.float32(in_black), np.float32(1.0), np.float32(SHOT_NOISE_FALL)
    upto, total = np.empty(live.size), 0.0
    for k in range(live.size):
        total += black * (white - fall * min(luminance[live[k]], white))
        upto[k] = total
    return upto


def _drawn(where: np.ndarray, upto: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Flat pixels of false events: Poisson around each pixel's mean, or around one mean for all alike."""
    number = int(rng.poisson(upto[-1]))
    if upto.size == 1:
        return where[rng.integers(0, where.size, number)]
    place = np.searchsorted(upto, rng.random(number) * upto[-1], side="right")
    return where[np.minimum(place, where.size - 1)]


def _at_any_time(where: np.ndarray, span_us: tuple[int, int], rng: np.random.Generator) -> Noise:
    """Events at these flat pixels, times and polarities uniform."""
    times = rng.integers(*span_us, where.size) + 1
    return times, where, 2 * rng.integers(0, 2, where.size) - 1


@numba.njit(cache=True, error_model="numpy")
def _leak(t0_us: int, t1_us: int, leak_hz: float, live: np.ndarray, phase: np.ndarray) -> Noise:
    """Events of leakage; event k of a pixel comes (k + phase) / rate seconds after time 0."""
    first, last = np.empty(live.size), np.empty(live.size)
    total = 0
    for k in range(live.size):
        first[k] = np.floor(t0_us * 1e-6 * leak_hz - phase[k])
        last[k] = np.floor(t1_us * 1e-6 * leak_hz - phase[k])
        total += int(last[k] - first[k])
    times, places, n = np.empty(total, np.int64), np.empty(total, np.int64), 0
    for k in range(live.size):
        for order in range(int(last[k] - first[k])):
            seconds = (first[k] + 1.0 + order + phase[k]) / leak_hz
            times[n] = int(min(max(np.ceil(seconds * 1e6), t0_us + 1), t1_us))
            places[n] = live[k]
            n += 1
    return times, places, np.ones(total, np.int64)


@numba.njit(cache=True, error_model="numpy")
def _merged(
    events: np.ndarray, times: np.ndarray, places: np.ndarray, polarities: np.ndarray, width: int
) -> np.ndarray:
    """EVENT sorted by (t, y, x) of events and noise that are; of equal ones the true events come first."""
    both = np.empty(events.size + times.size, events.dtype)
    true = false = 0
    for k in range(both.size):
        first = false == times.size
        if not first and true < events.size:
            t, place = events[true]["t"], events[true]["y"] * np.int64(width) + events[true]["x"]
            first = t < times[false] or (t == times[false] and place <= places[false])
        if first:
            both[k] = events[true]
            true += 1
        else:
            both[k]["t"], both[k]["p"] = times[false], polarities[false]
            both[k]["y"], both[k]["x"] = places[false] // width, places[false] % width
            false += 1
    return both
