"""Faults of a real sensor: dead and hot pixels, lost events, events without cause (appendix D.3).

`draw_pixel_faults` draws the faulty pixels of an episode, `apply_faults` applies the faults to the events of
one interval. `RealSensor` adds the noise of the pixels themselves and the readout. Faults that are off cost
nothing and draw nothing.

If only pixel noise, lost and false events are on, the compiled step of `envs.vehicles` applies all faults by
`spoil`; the other faults need Python after each step.

A plug-in adds a fault by `ADDED_FAULTS[name] = make`. At the start of an episode `make(amount, shape, rng)`
is called with the amount in `faults.added.NAME`, the image's (H, W) and the episode's random stream. It
returns `apply(events, t0_us, t1_us)`. This is called after the faults of this file and before the readout,
with the EVENT array of the interval (t0_us, t1_us], and returns the changed EVENT array, sorted by t.
"""

import dataclasses
import math
from typing import NamedTuple

import numba
import numpy as np

from envs.config import ADDED_FAULTS, CameraConfig, FaultsConfig
from envs.events.camera import MAX_EVENTS_PER_FRAME
from envs.events.disturbances import disturb
from envs.events.emission import EVENT
from envs.events.noise_labels import NoiseLabels
from envs.events.pixel_noise import PixelState, draw_noise, fire, kept_noise, no_noise
from envs.events.readout import Readout

LABELLED = np.dtype([*EVENT.descr, ("is_noise", "?")])
NO_BURSTS, NOTHING_FIRED = np.zeros((0, 2), np.int64), np.zeros((3, 0), np.int64)
NO_PIXELS = np.empty(0, np.int64)


@dataclasses.dataclass(frozen=True)
class PixelFaults:
    """The faulty pixels of one episode.

    Attributes:
        dead: bool (H, W), dead pixels, scattered or in the block; they never fire, not even noise.
        live: int64 (L,), flat indices of the other pixels.
        hot: int64 (K,), flat indices of the hot pixels among these.
    """

    dead: np.ndarray
    live: np.ndarray
    hot: np.ndarray


class Rates(NamedTuple):
    """Rates of lost and added events, as in `FaultsConfig`, and whether any pixel may be dead."""

    has_dead: bool
    event_dropout: float
    background_activity: float
    background_activity_hz: float
    hot_pixel_hz: float
    burst_activity_hz: float


class FaultState(NamedTuple):
    """The faults of one camera, in the form that compiled code takes.

    Attributes:
        is_on: Whether there are any faults.
        noise: Noise of the pixels, `PixelState`; all faults draw from its random stream.
        numbers: The flat pixel y * W + x of each pixel with noise, int64.
        dead, live, hot: As in `PixelFaults`.
        rates: `Rates`.
        expected: float64 (1,), expected number of false events in the last interval.
    """

    is_on: bool
    noise: PixelState
    numbers: np.ndarray
    dead: np.ndarray
    live: np.ndarray
    hot: np.ndarray
    rates: Rates
    expected: np.ndarray


def fault_state(
    faults: FaultsConfig, pixels: PixelFaults, noise: PixelState, numbers: np.ndarray = NO_PIXELS
) -> FaultState:
    """Return the faults of one camera for compiled code; `numbers` are the flat pixels of `noise`."""
    rates = Rates(
        faults.sparsity > 0.0 or faults.dead_block > 0.0,
        float(faults.event_dropout),
        float(faults.background_activity),
        float(faults.background_activity_hz),
        float(faults.hot_pixel_hz),
        float(faults.burst_activity_hz),
    )
    is_on = faults != FaultsConfig()
    return FaultState(is_on, noise, numbers, pixels.dead, pixels.live, pixels.hot, rates, np.zeros(1))


def draw_pixel_faults(shape: tuple[int, int], faults: FaultsConfig, rng: np.random.Generator) -> PixelFaults:
    """Draw which pixels are dead (scattered: appendix D.3, induced sparsity; or in a block) or hot.

    Args:
        shape: (H, W).
        faults: Shares of dead and hot pixels. Numbers of pixels are rounded; dead pixels are never hot.
        rng: Source of the draws; the same stream gives the same pixels.
    """
    dead = np.zeros(shape, bool)
    if faults.sparsity > 0.0:
        dead.flat[rng.permutation(dead.size)[: round(faults.sparsity * dead.size)]] = True
    if faults.dead_block > 0.0:
        sides = [round(math.sqrt(faults.dead_block) * side) for side in shape]
        top, left = (int(rng.integers(0, room - side + 1)) for room, side in zip(shape, sides, strict=True))
        dead[top : top + sides[0], left : left + sides[1]] = True
    live = np.flatnonzero(~dead)
    hot = live[:0]
    if faults.hot_pixel_share > 0.0:
        hot = np.sort(rng.permutation(live)[: round(faults.hot_pixel_share * dead.size)])
    return PixelFaults(dead, live, hot)


def _no_faults() -> FaultState:
    """Return the state of a camera without faults."""
    rng, faults = np.random.default_rng(0), FaultsConfig()
    return fault_state(faults, draw_pixel_faults((2, 2), faults, rng), no_noise(rng))


NO_FAULTS = _no_faults()


class Bursts:
    """Times of the bursts of false events: starts are a Poisson process, and all bursts have one length."""

    def __init__(self, faults: FaultsConfig, t_us: int, rng: np.random.Generator) -> None:
        """Start at time `t_us` [us] without a burst; `rng` draws the time of each next burst."""
        self._pause_us, self._length_us = 1e6 / faults.burst_hz, 1e3 * faults.burst_ms
        self._rng, self._begun_us = rng, list[float]()
        self._next_us = t_us + rng.exponential(self._pause_us)

    def until(self, t0_us: int, t1_us: int) -> np.ndarray:
        """Return the part (begin, end] of (t0_us, t1_us] covered by each burst, int64 (K, 2).

        The parts may overlap, because bursts may.
        """
        while self._next_us < t1_us:
            self._begun_us.append(self._next_us)
            self._next_us += self._rng.exponential(self._pause_us)
        ends = [(begun_us, begun_us + self._length_us) for begun_us in self._begun_us]
        self._begun_us = [begun_us for begun_us, end_us in ends if end_us > t1_us]
        spans = [(max(t0_us, round(begun)), min(t1_us, round(end))) for begun, end in ends]
        return np.array([span for span in spans if span[0] < span[1]], np.int64).reshape(-1, 2)


class RealSensor:
    """The faults and the readout that a real sensor adds to one camera, from its first frame on.

    Attributes:
        state: `FaultState`.
        lost: Number of events of the last interval that the readout lost.
        is_noise: bool (N,), whether each event of the last interval is noise, that is, was not fired by a
            change of the light; empty unless asked for. A displaced or flipped event is not noise. Events
            that a plug-in adds or modifies (even only in time) are noise.
    """

    def __init__(
        self,
        camera: CameraConfig,
        faults: FaultsConfig,
        state: tuple,
        rng: np.random.Generator,
        t_us: int,
        *,
        labels: bool = False,
    ) -> None:
        """Draw the faults of a camera that has just seen its first frame.

        Args:
            camera: Settings of the camera.
            faults: The faults.
            state: `state` of the camera, and the flat pixel y * W + x of each pixel of its memory, int64.
            rng: Source of all draws.
            t_us: The time of the first frame [us].
            labels: Whether to compute `is_noise`.

        Raises:
            ValueError: The pixels are too slow for the rate of shot noise.
        """
        self._faults, self.lost = faults, 0
        self._labels, self.is_noise = labels, np.empty(0, bool)
        shape = camera.height, camera.width
        self._pixels = draw_pixel_faults(shape, faults, rng)
        own, numbers = state
        self._model, self._memory, _ = own
        self._readout = self._noise_labels = None
        noise, alive = no_noise(rng), NO_PIXELS
        if faults.shot_noise_hz > 0.0 or faults.leak_hz > 0.0:
            rest = own[1][1]["first_level"].copy()  # before the noise moves the levels
            alive = np.where(self._pixels.dead.flat[numbers], -1, numbers)
            noise = draw_noise(camera, faults, own, alive, t_us, rng)
            if labels:
                self._noise_labels = NoiseLabels(own, numbers, rest)
        self.state = fault_state(faults, self._pixels, noise, alive)
        bursts = faults.burst_hz > 0.0 and faults.burst_ms > 0.0 and faults.burst_activity_hz > 0.0
        self._bursts = Bursts(faults, t_us, rng) if bursts else None
        if has_readout(camera):
            self._readout = Readout(camera, t_us, rng, LABELLED if labels else EVENT)
        amounts = sorted(faults.added.items())
        self._added = {
            name: ADDED_FAULTS[name](amount, shape, rng) for name, amount in amounts if amount > 0.0
        }

    @property
    def is_compiled(self) -> bool:
        """Whether `spoil` applies all faults."""
        disturbed = self._faults.displaced > 0.0 or self._faults.flipped > 0.0
        later = self._bursts is not None or self._readout is not None or bool(self._added)
        return not (disturbed or later or self._labels)

    def events(self, events: np.ndarray, t0_us: int, t1_us: int) -> np.ndarray:
        """Return the events that leave the sensor in (t0_us, t1_us], given the events fired by the light.

        Call it after the camera has seen the light of t1_us. Raises the same errors as `apply_faults`.
        """
        noise, labels, shape = NOTHING_FIRED, None, self._pixels.dead.shape
        kept = kept_noise(self.state.noise) if self._noise_labels is not None else None
        if self.state.numbers.size > 0:
            noise = fire(t0_us, t1_us, self._model, self._memory, self.state.noise)
        if self._noise_labels is not None and kept is not None:
            pixels, fired = events["y"].astype(np.int64) * shape[1] + events["x"], noise[1:]
            told = self.state.numbers[fired[0]], fired[1]
            of_light, labels = self._noise_labels.of((pixels, events["p"]), told, t1_us, kept)
            events = labelled(events, of_light)
        bursts = self._bursts.until(t0_us, t1_us) if self._bursts is not None else NO_BURSTS
        span = t0_us, t1_us
        events, is_noise = _with_faults(events, span, self._faults, self.state, noise, labels, bursts)
        for name, apply in self._added.items():
            before, events = events, apply(events, t0_us, t1_us)
            _check_added(name, events, span, shape)
            if self._labels:
                is_noise = ~np.isin(events, before[~is_noise])
        if not self._labels:
            return events if self._readout is None else self._sent(events, t1_us)
        self.is_noise = is_noise
        if self._readout is not None:
            events, self.is_noise = unlabelled(self._sent(labelled(events, is_noise), t1_us))
        return events

    def _sent(self, events: np.ndarray, t1_us: int) -> np.ndarray:
        """Return the events that the readout sends until `t1_us` [us]."""
        assert self._readout is not None  # noqa: S101  for the type checker
        sent, self.lost = self._readout.send(events, t1_us)
        return sent


def labelled(events: np.ndarray, is_noise: np.ndarray) -> np.ndarray:
    """Return events with labels, `LABELLED` (N,), from EVENT (N,) and bool (N,)."""
    rows = np.empty(events.size, LABELLED)
    for name in EVENT.names or ():
        rows[name] = events[name]
    rows["is_noise"] = is_noise
    return rows


def unlabelled(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return EVENT (N,) and labels, bool (N,), of `LABELLED` (N,); events without labels are not noise."""
    if rows.dtype != LABELLED:
        return rows, np.zeros(rows.size, bool)
    return rows[list(EVENT.names or ())].astype(EVENT), rows["is_noise"].copy()


def _check_added(name: str, events: np.ndarray, span_us: tuple[int, int], shape: tuple[int, ...]) -> None:
    """Raise ValueError if a plug-in's fault returned anything but events of this interval and image."""
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


def has_readout(camera: CameraConfig) -> bool:
    """Whether latency, jitter or a readout limit changes the events that the pixels fire."""
    return camera.latency_us > 0 or camera.latency_jitter_us > 0.0 or camera.readout_hz > 0.0


def apply_faults(
    events: np.ndarray,
    t0_us: int,
    t1_us: int,
    faults: FaultsConfig,
    pixels: PixelFaults,
    rng: np.random.Generator,
) -> np.ndarray:
    """Drop true events and add false events.

    The true events of dead pixels are lost, and each other true event is lost with probability
    event_dropout. Some are displaced or flipped (`envs.events.disturbances`). False events are
    added at uniform times and with uniform polarities; their numbers in T seconds are:

    - background_activity: Poisson, this share of the remaining true events (appendix D.3);
    - background_activity_hz: Poisson, rate * T per live pixel;
    - hot_pixel_hz: Poisson, rate * T per hot pixel.

    Args:
        events: EVENT of the interval, sorted by (t, y, x).
        t0_us: Start of the interval [us].
        t1_us: End of the interval [us], later than the start.
        faults: Rates of the faults.
        pixels: The faulty pixels.
        rng: Source of the draws.

    Returns:
        EVENT with t in (t0_us, t1_us], sorted by (t, y, x); true events come first in ties.

    Raises:
        ValueError: The interval is empty, or more than 2**24 false events are expected.
    """
    state = fault_state(faults, pixels, no_noise(rng))
    return _with_faults(events, (t0_us, t1_us), faults, state, NOTHING_FIRED)[0]


def _with_faults(
    events: np.ndarray,
    span_us: tuple[int, int],
    faults: FaultsConfig,
    state: FaultState,
    fired: np.ndarray,
    labels: np.ndarray | None = None,
    bursts: np.ndarray = NO_BURSTS,
) -> tuple[np.ndarray, np.ndarray]:
    """Apply the faults, add the events `fired` by pixel noise and bursts; return events and noise labels.

    Added events are noise, except where `labels` (bool, one per event of `fired`) says otherwise. Events that
    come as LABELLED keep their label.
    """
    t0_us, t1_us = span_us
    if t1_us <= t0_us:
        raise ValueError(f"faults need t1_us > t0_us; got {t0_us} and {t1_us}.")
    if state.rates.has_dead or state.rates.event_dropout > 0.0:
        events = lose(events, state)
    events = disturb(events, faults, state.dead.shape, state.noise.rng)
    events, is_noise = unlabelled(events)
    are_noise = np.ones(fired.shape[1], bool) if labels is None else labels
    events, is_noise = add_false((events, is_noise), (fired, are_noise), span_us, bursts, state)
    check_expected(state, span_us)
    return events, is_noise


def check_expected(state: FaultState, span_us: tuple[int, int]) -> None:
    """Raise ValueError if the expected number of false events in an interval exceeds the limit."""
    if state.expected[0] > MAX_EVENTS_PER_FRAME:
        raise ValueError(
            f"faults may add {MAX_EVENTS_PER_FRAME} events to an interval; these rates add about "
            f"{state.expected[0]:.3g} from {span_us[0]} to {span_us[1]} us. Lower the rates or shorten the "
            "interval."
        )


@numba.njit(cache=True, error_model="numpy")
def spoil(
    events: np.ndarray, span_us: tuple[int, int], model: tuple, memory: tuple, state: FaultState
) -> np.ndarray:
    """Apply a sensor's faults to the events of a step; requires `RealSensor.is_compiled`.

    Args:
        events: EVENT that the light fired, sorted by (t, y, x).
        span_us: Start and end of the step [us].
        model: Model of the camera, as in `EventCamera.state`.
        memory: Memory of the camera, after the light of the end of the step.
        state: `FaultState`, changed in place.

    Returns:
        EVENT, sorted; not valid if `state.expected` is more than `MAX_EVENTS_PER_FRAME`.
    """
    rates, fired = state.rates, np.empty((3, 0), np.int64)
    if state.numbers.size > 0:
        fired = fire(span_us[0], span_us[1], model, memory, state.noise)
    if rates.has_dead or rates.event_dropout > 0.0:
        events = lose(events, state)
    light, noise = (events, np.zeros(events.size, np.bool_)), (fired, np.ones(fired.shape[1], np.bool_))
    return add_false(light, noise, span_us, NO_BURSTS, state)[0]


@numba.njit(cache=True, error_model="numpy")
def lose(events: np.ndarray, state: FaultState) -> np.ndarray:
    """Return the events of live pixels, each dropped with probability event_dropout."""
    rates, rng, dead, count = state.rates, state.noise.rng, state.dead, 0
    kept = np.empty_like(events)
    for i in range(events.size):
        if not (rates.has_dead and dead[events[i]["y"], events[i]["x"]]):
            kept[count] = events[i]
            count += rates.event_dropout == 0.0 or rng.random() >= rates.event_dropout
    return kept[:count]


@numba.njit(cache=True, error_model="numpy")
def add_false(
    light: tuple[np.ndarray, np.ndarray],
    noise: tuple[np.ndarray, np.ndarray],
    span_us: tuple[int, int],
    bursts: np.ndarray,
    state: FaultState,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw events of the background, hot pixels and bursts; merge them and the pixels' noise with events.

    Args:
        light: EVENT (N,), sorted by (t, y, x), and whether each is noise, bool (N,).
        noise: Events from `fire`, and whether each is noise.
        span_us: Start and end of the interval [us].
        bursts: int64 (K, 2), start and end of each burst [us].
        state: `FaultState`.

    Returns:
        EVENT and whether each is noise. If too many false events are expected, it returns `light` unchanged.
    """
    means, spans, are_hot = _kinds(light[0].size, span_us, bursts, state)
    state.expected[0] = means.sum()
    if state.expected[0] > MAX_EVENTS_PER_FRAME:
        return light
    (fired, are_noise), rng, total = noise, state.noise.rng, noise[1].size
    parts = [np.empty(0, np.int64)]
    for kind in range(means.size):
        where = state.hot if are_hot[kind] else state.live
        part = rng.integers(0, where.size, rng.poisson(means[kind]))
        for j in range(part.size):
            part[j] = where[part[j]]
        parts.append(part)
        total += part.size
    if total == 0:
        return light
    false, labels, first = np.empty((3, total), np.int64), np.ones(total, np.bool_), 0
    for kind in range(means.size):
        part = parts[kind + 1]
        end = first + part.size
        false[0, first:end] = rng.integers(spans[kind, 0], spans[kind, 1], part.size) + 1
        false[1, first:end] = part
        false[2, first:end] = 2 * rng.integers(0, 2, part.size) - 1
        first = end
    for j in range(fired.shape[1]):
        false[0, first + j], false[2, first + j] = fired[0, j], fired[2, j]
        false[1, first + j], labels[first + j] = state.numbers[fired[1, j]], are_noise[j]
    return _merged(light, (false[0], false[1], false[2], labels), span_us[0], state.dead.shape)


@numba.njit(cache=True, error_model="numpy")
def _kinds(
    num_events: int, span_us: tuple[int, int], bursts: np.ndarray, state: FaultState
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean number, time span and whether of hot pixels, for each kind of false events that is on."""
    rates, seconds = state.rates, (span_us[1] - span_us[0]) * 1e-6
    most = 2 + len(bursts)
    means, spans, are_hot = np.empty(most), np.empty((most, 2), np.int64), np.zeros(most, np.bool_)
    spans[:2, 0], spans[:2, 1] = span_us
    live, count = state.live.size, 0
    background = rates.background_activity * num_events
    background += rates.background_activity_hz * seconds * live
    if background > 0.0 and live:
        means[0] = background
        count = 1
    if rates.hot_pixel_hz > 0.0 and state.hot.size:
        means[count], are_hot[count] = rates.hot_pixel_hz * seconds * state.hot.size, True
        count += 1
    for k in range(len(bursts) if live else 0):
        begin_us, end_us = bursts[k, 0], bursts[k, 1]
        means[count] = rates.burst_activity_hz * (end_us - begin_us) * 1e-6 * live
        spans[count, 0], spans[count, 1] = begin_us, end_us
        count += 1
    return means[:count], spans[:count], are_hot[:count]


@numba.njit(cache=True, error_model="numpy")
def _merged(
    light: tuple[np.ndarray, np.ndarray],
    false: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    t0_us: int,
    shape: tuple[int, int],
) -> tuple[np.ndarray, np.ndarray]:
    """Merge events with false events, sorted by (t, y, x); in ties the true events come first.

    Args:
        light: EVENT (N,), sorted, and their labels, bool (N,).
        false: Times [us], flat pixels, polarities and labels of M false events.
        t0_us: A time before all false events [us].
        shape: (H, W).

    Returns:
        EVENT (N + M,) and their labels.
    """
    (events, labels), (times, places, polarities, false_labels), width = light, false, shape[1]
    order = np.argsort((times - t0_us) * (shape[0] * width) + places, kind="mergesort")
    both = np.empty(events.size + times.size, events.dtype)
    is_noise = np.empty(both.size, np.bool_)
    true = added = 0
    for k in range(both.size):
        first, j = added == times.size, order[min(added, times.size - 1)]
        if not first and true < events.size:
            t, place = events[true]["t"], events[true]["y"] * np.int64(width) + events[true]["x"]
            first = t < times[j] or (t == times[j] and place <= places[j])
        if first:
            both[k], is_noise[k] = events[true], labels[true]
            true += 1
        else:
            is_noise[k] = false_labels[j]
            both[k]["t"], both[k]["p"] = times[j], polarities[j]
            both[k]["y"], both[k]["x"] = places[j] // width, places[j] % width
            added += 1
    return both, is_noise
