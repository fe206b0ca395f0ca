"""Faults of a real sensor: dead and hot pixels, lost events, events without cause (appendix D.3).

`draw_pixel_faults` draws the faulty pixels of an episode, `apply_faults` applies their faults to the events
of one interval; `RealSensor` adds what acts on the pixels themselves, and what happens between them and the
reader. What is off costs nothing and draws nothing.

A plug-in adds a fault by `ADDED_FAULTS[name] = make`. At the start of an episode `make(amount, shape, rng)`
is called, with the amount of `faults.added.NAME`, the image's (H, W) and the episode's random stream. It
returns `apply(events, t0_us, t1_us)`, which is called after the faults of this file and before the readout,
with EVENT of the interval (t0_us, t1_us], and returns what they become: EVENT, sorted by t.
"""

import dataclasses
import math
from collections.abc import Sequence

import numba
import numpy as np

from envs.config import ADDED_FAULTS, CameraConfig, FaultsConfig
from envs.events.camera import MAX_EVENTS_PER_FRAME
from envs.events.disturbances import disturb
from envs.events.emission import EVENT
from envs.events.noise_labels import NoiseLabels
from envs.events.pixel_noise import PixelNoise, PixelState, no_noise
from envs.events.readout import Readout

NO_NOISE = no_noise()
LABELLED = np.dtype([*EVENT.descr, ("is_noise", "?")])
Span = tuple[int, int]  # [us], without its begin
Noise = tuple[np.ndarray, np.ndarray, np.ndarray]  # int64 each: times [us], flat pixels, polarities


@dataclasses.dataclass(frozen=True)
class PixelFaults:
    """The pixels' faults of one episode.

    Attributes:
        dead: bool (H, W), scattered ones and the block; these never fire, not even noise.
        live: int64 (L,), flat indices of the others.
        hot: int64 (K,), flat indices of the hot ones among these.
    """

    dead: np.ndarray
    live: np.ndarray
    hot: np.ndarray


def draw_pixel_faults(shape: tuple[int, int], faults: FaultsConfig, rng: np.random.Generator) -> PixelFaults:
    """Draw which pixels are dead (scattered: appendix D.3, induced sparsity; or in a block) or hot.

    Args:
        shape: (H, W).
        faults: How many. Numbers of pixels are rounded to the nearest; dead ones are not hot.
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


class Bursts:
    """When bursts of false events begin and end: a Poisson process of beginnings, all of one length."""

    def __init__(self, faults: FaultsConfig, t_us: int, rng: np.random.Generator) -> None:
        """Begin at a time [us], without a burst; `rng` draws when the next begins."""
        self._pause_us, self._length_us = 1e6 / faults.burst_hz, 1e3 * faults.burst_ms
        self._rng, self._begun_us = rng, list[float]()
        self._next_us = t_us + rng.exponential(self._pause_us)

    def until(self, t0_us: int, t1_us: int) -> list[Span]:
        """Return the parts of (t0_us, t1_us] that each burst fills; spans may overlap, as bursts may."""
        while self._next_us < t1_us:
            self._begun_us.append(self._next_us)
            self._next_us += self._rng.exponential(self._pause_us)
        ends = [(begun_us, begun_us + self._length_us) for begun_us in self._begun_us]
        self._begun_us = [begun_us for begun_us, end_us in ends if end_us > t1_us]
        spans = [(max(t0_us, round(begun)), min(t1_us, round(end))) for begun, end in ends]
        return [span for span in spans if span[0] < span[1]]


class RealSensor:
    """All that a real sensor adds to the events of one camera, from its first frame on.

    Attributes:
        lost: Events of the last interval that the readout lost.
        is_noise: bool (N,), which events of the last interval no change of the light fired; empty unless
            asked for. A displaced or flipped event is none; but all that a plug-in returns otherwise than it
            got it, be it only later, is one.
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
            camera: Its settings.
            faults: The faults.
            state: Its `state`, and the flat pixel y * W + x of each pixel of its memory, int64.
            rng: Source of all draws.
            t_us: The time of that frame [us].
            labels: Whether `is_noise` is wanted.

        Raises:
            ValueError: The pixels are too slow for the rate of shot noise.
        """
        self._faults, self._rng, self.lost = faults, rng, 0
        self._labels, self.is_noise = labels, np.empty(0, bool)
        shape = camera.height, camera.width
        self._pixels = draw_pixel_faults(shape, faults, rng)
        self._noise = self._readout = self._noise_labels = None
        if faults.shot_noise_hz > 0.0 or faults.leak_hz > 0.0:
            own, numbers = state
            rest = own[1][1]["first_level"].copy()  # before the noise moves the levels
            alive = np.where(self._pixels.dead.flat[numbers], -1, numbers)
            self._noise = PixelNoise(camera, faults, own, alive, t_us, rng)
            if labels:
                self._noise_labels = NoiseLabels(own, numbers, rest)
        bursts = faults.burst_hz > 0.0 and faults.burst_ms > 0.0 and faults.burst_activity_hz > 0.0
        self._bursts = Bursts(faults, t_us, rng) if bursts else None
        if has_readout(camera):
            self._readout = Readout(camera, t_us, rng, LABELLED if labels else EVENT)
        amounts = sorted(faults.added.items())
        self._added = {
            name: ADDED_FAULTS[name](amount, shape, rng) for name, amount in amounts if amount > 0.0
        }

    @property
    def pixel_noise(self) -> PixelState:
        """Return the state of the pixel noise; `NO_NOISE` if the pixels have none."""
        return self._noise.state if self._noise is not None else NO_NOISE

    def events(
        self, events: np.ndarray, t0_us: int, t1_us: int, fired: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the events that leave the sensor in (t0_us, t1_us], given those that the light fired.

        The camera has seen the light of t1_us. `fired` is what `pixel_noise.fire` found of `pixel_noise` for
        this interval, if that was called. As `apply_faults`, which also says what is raised.
        """
        noise, labels = None, None
        kept = self._noise.kept() if self._noise_labels is not None and self._noise is not None else None
        if self._noise is not None:
            noise = self._noise.events(t0_us, t1_us) if fired is None else self._noise.of_image(fired)
        if self._noise_labels is not None and noise is not None and kept is not None:
            pixels = events["y"].astype(np.int64) * self._pixels.dead.shape[1] + events["x"]
            of_light, labels = self._noise_labels.of((pixels, events["p"]), noise[1:], t1_us, kept)
            events = labelled(events, of_light)
        drawn = self._pixels, self._rng
        bursts = self._bursts.until(t0_us, t1_us) if self._bursts is not None else ()
        span = t0_us, t1_us
        events, is_noise = _with_faults(events, span, self._faults, *drawn, noise, labels, bursts)
        for name, apply in self._added.items():
            before, events = events, apply(events, t0_us, t1_us)
            _check_added(name, events, (t0_us, t1_us), self._pixels.dead.shape)
            if self._labels:
                is_noise = ~np.isin(events, before[~is_noise])
        if not self._labels:
            return events if self._readout is None else self._sent(events, t1_us)
        self.is_noise = is_noise
        if self._readout is not None:
            events, self.is_noise = unlabelled(self._sent(labelled(events, is_noise), t1_us))
        return events

    def _sent(self, events: np.ndarray, t1_us: int) -> np.ndarray:
        """Return the events that the readout sends until a time [us]."""
        assert self._readout is not None  # noqa: S101  for the type checker
        sent, self.lost = self._readout.send(events, t1_us)
        return sent


def labelled(events: np.ndarray, is_noise: np.ndarray) -> np.ndarray:
    """`LABELLED` (N,) of EVENT (N,) and bool (N,)."""
    rows = np.empty(events.size, LABELLED)
    for name in EVENT.names or ():
        rows[name] = events[name]
    rows["is_noise"] = is_noise
    return rows


def unlabelled(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """EVENT (N,) and bool (N,) of `LABELLED` (N,); events without labels are no noise."""
    if rows.dtype != LABELLED:
        return rows, np.zeros(rows.size, bool)
    return rows[list(EVENT.names or ())].astype(EVENT), rows["is_noise"].copy()


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


def has_readout(camera: CameraConfig) -> bool:
    """Whether events leave the sensor otherwise than the pixels fire them."""
    return camera.latency_us > 0 or camera.latency_jitter_us > 0.0 or camera.readout_hz > 0.0


def apply_faults(
    events: np.ndarray,
    t0_us: int,
    t1_us: int,
    faults: FaultsConfig,
    pixels: PixelFaults,
    rng: np.random.Generator,
    noise: Noise | None = None,
) -> np.ndarray:
    """Lose true events and add false ones.

    Of the true events those of dead pixels are lost, and each other one with probability
    event_dropout; some are displaced or flipped (`envs.events.disturbances`). To the rest are
    added, in an interval of T seconds, at uniform times and with uniform polarities:

    - background_activity: Poisson, this share of the true events left (appendix D.3);
    - background_activity_hz: Poisson, rate * T per live pixel;
    - hot_pixel_hz: Poisson, rate * T per hot pixel.

    Args:
        events: EVENT of the interval, sorted by (t, y, x).
        t0_us: Start of the interval [us].
        t1_us: Its end [us], later than the start.
        faults: How much.
        pixels: Which pixels.
        rng: Source of the draws.
        noise: What the noise of the pixels fired in the interval, if they have any.

    Returns:
        EVENT with t in (t0_us, t1_us], sorted by (t, y, x), true events first where all are equal.

    Raises:
        ValueError: The interval is empty, or more than 2**24 false events are to be expected.
    """
    return _with_faults(events, (t0_us, t1_us), faults, pixels, rng, noise)[0]


def _with_faults(
    events: np.ndarray,
    span_us: tuple[int, int],
    faults: FaultsConfig,
    pixels: PixelFaults,
    rng: np.random.Generator,
    noise: Noise | None,
    labels: np.ndarray | None = None,
    bursts: Sequence[Span] = (),
) -> tuple[np.ndarray, np.ndarray]:
    """`apply_faults` and the false events of `bursts`, and which of the events are noise, bool (N,).

    All that is added is noise, except where `labels` (bool, one for each event of `noise`) says otherwise; so
    are those events that come as LABELLED with that label.
    """
    t0_us, t1_us = span_us
    if t1_us <= t0_us:
        raise ValueError(f"faults need t1_us > t0_us; got {t0_us} and {t1_us}.")
    if faults.sparsity > 0.0 or faults.dead_block > 0.0:
        events = events[~pixels.dead[events["y"], events["x"]]]
    if faults.event_dropout > 0.0:
        events = events[rng.random(events.size) >= faults.event_dropout]
    events = disturb(events, faults, pixels.dead.shape, rng)
    kinds = _expected(events.size, span_us, faults, pixels, bursts)
    expected = sum(mean for _, mean, _ in kinds)
    if expected > MAX_EVENTS_PER_FRAME:
        raise ValueError(
            f"faults may add {MAX_EVENTS_PER_FRAME} events to an interval; these rates add about "
            f"{expected:.3g} from {t0_us} to {t1_us} us. Lower the rates or shorten the interval."
        )
    drawn = [
        (where[rng.integers(0, where.size, int(rng.poisson(mean)))], span) for where, mean, span in kinds
    ]
    false = [_at_any_time(where, span, rng) for where, span in drawn] + ([noise] if noise else [])
    events, is_noise = unlabelled(events)
    if not sum(part[0].size for part in false):
        return events, is_noise
    times, places, polarities = (np.concatenate(parts) for parts in zip(*false, strict=True))
    are_noise = np.ones(times.size, bool)
    if labels is not None:
        are_noise[times.size - labels.size :] = labels
    return _merged((events, is_noise), (times, places, polarities, are_noise), t0_us, pixels.dead.shape)


def _expected(
    num_events: int, span_us: Span, faults: FaultsConfig, pixels: PixelFaults, bursts: Sequence[Span]
) -> list[tuple[np.ndarray, float, Span]]:
    """Return pixels, mean number of events of all of them, and when, of each kind of noise that is on."""
    kinds, seconds = [], (span_us[1] - span_us[0]) * 1e-6
    background = faults.background_activity * num_events
    background += faults.background_activity_hz * seconds * pixels.live.size
    if background > 0.0 and pixels.live.size:
        kinds.append((pixels.live, background, span_us))
    if faults.hot_pixel_hz > 0.0 and pixels.hot.size:
        kinds.append((pixels.hot, faults.hot_pixel_hz * seconds * pixels.hot.size, span_us))
    for begin_us, end_us in bursts if pixels.live.size else ():
        mean = faults.burst_activity_hz * (end_us - begin_us) * 1e-6 * pixels.live.size
        kinds.append((pixels.live, mean, (begin_us, end_us)))
    return kinds


def _at_any_time(where: np.ndarray, span_us: Span, rng: np.random.Generator) -> Noise:
    """Draw events at these flat pixels with uniform times and polarities."""
    times = rng.integers(*span_us, where.size) + 1
    return times, where, 2 * rng.integers(0, 2, where.size) - 1


@numba.njit(cache=True, error_model="numpy")
def _merged(
    light: tuple[np.ndarray, np.ndarray],
    false: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    t0_us: int,
    shape: tuple[int, int],
) -> tuple[np.ndarray, np.ndarray]:
    """Merge events with false ones and sort them by (t, y, x); of equal ones the true events come first.

    Args:
        light: EVENT (N,), sorted, and their labels, bool (N,).
        false: Times [us], flat pixels, polarities and labels of M events.
        t0_us: A time before all of them [us].
        shape: (H, W).

    Returns:
        EVENT (N + M,), and their labels.
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
