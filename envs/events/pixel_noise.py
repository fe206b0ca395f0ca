"""Noise inside the pixel: leakage moves its level, and shot noise crosses its levels.

Noise events are like any other event: they move the level that the pixel remembers, wait for the end of its
refractory period, and start a new one. So a still pixel does not drift.

Leakage lowers the level at the pixel's rate, one threshold from one ON event of a still pixel to the next.

Shot noise is a stationary Ornstein-Uhlenbeck process x on top of the pixel's response. Its standard deviation
sigma is a share of the pixel's thresholds; its time constant tau is the photoreceptor's. The mean time from
its mean up to a displacement d is (Siegert 1951; Hendrickson & Haefner, arXiv:2504.02803)

    m(d) = tau sqrt(2 pi) * integral of exp(y^2 / 2) Phi(y) dy from 0 to d / sigma,

and, if d is not small, this time is exponentially distributed. The time from d back to the mean is exactly
(tau / 2) log(1 + (d / sigma Z)^2) with a normal number Z. After that the level just left is the nearer one,
so ON and OFF alternate. Events are therefore drawn by waiting times, and no step of the simulation is too
long (first passages: Graca & Delbruck, arXiv:2505.07386). Sigma is chosen so that the rate, in the closed
form of `mean_rate`, is `shot_noise_hz` on average over all levels that a pixel may remember. A refractory
period of tau or more makes the noise rarer, because at its end the level is at the light, not a threshold
away.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numba
import numpy as np

from envs.compiled import inlined, kernel
from envs.config import CameraConfig, FaultsConfig
from envs.events.crossings import (
    BLOCK,
    Memory,
    Model,
    count_crossings,
    level_of,
    make_room,
    named,
    respond_at,
    set_quiet_bands,
    write_flagged,
)
from envs.events.emission import Span
from envs.events.refractory import never_be_quiet

DEFAULT_BANDWIDTH_HZ = 300.0  # of the noise if photoreceptors have no bandwidth limit: v2e's cutoff by day
SHOT_NOISE_FALL = 0.75  # decrease from black to white, as a share of the noise in black (v2e)
FIRED = 1024  # initial room for events
PER_SIGMA = 64  # entries per sigma in the tables of passage times and rates
MOST_SIGMAS, FEWEST_SIGMAS = 12.0, 0.5  # range of a threshold in sigmas
SLICE = 1 / 32  # of a threshold: largest leak of a level before the waiting times are computed again
SAME_LIGHT = 5e-4  # relative change of the light below which the waiting times are not updated


class Noise(NamedTuple):
    """The noise of N pixels, in the order of the camera's memory, float64; changed in place.

    Attributes:
        leak: Thresholds per second by which each level falls, until the pixel's next leak event.
        leak_mean: Mean of `leak`.
        shot: Each pixel's rate of shot noise over the nominal rate.
        budget: Each pixel's remaining waiting time at `from_us`, in mean waiting times.
        from_us: Time from which `budget` is used up [us].
        pace: Rate at which `budget` is used up [mean waiting times per us].
        since_us: Time up to which each level includes its leakage [us].
        rest_us: Time until which each pixel's noise returns to its mean [us].
        kept: Noise that becomes part of a pixel's level at the end of a refractory period.
        due_us: Time when each pixel must be updated again, if light and level stay the same [us].
        light, band: Each pixel's light and lower end of its quiet band at the last update, float32.
        kept_us: End of the refractory period of `kept` [us], int64.
    """

    leak: np.ndarray
    leak_mean: np.ndarray
    shot: np.ndarray
    budget: np.ndarray
    from_us: np.ndarray
    pace: np.ndarray
    since_us: np.ndarray
    rest_us: np.ndarray
    kept: np.ndarray
    due_us: np.ndarray
    light: np.ndarray
    band: np.ndarray
    kept_us: np.ndarray


class Process(NamedTuple):
    """The noise of one sensor.

    Attributes:
        sigma: Standard deviation of the shot noise, as a share of a pixel's mean threshold; 0: none.
        tau_us: Time constant of the shot noise [us].
        rates: Rate of passages by distance, in steps of sigma / PER_SIGMA [1 / us].
        jitter: Jitter of leakage, `FaultsConfig.leak_jitter`.
        slice_us: Longest time between two updates of the leakage [us].
    """

    sigma: float
    tau_us: float
    rates: np.ndarray
    jitter: float
    slice_us: float


@lru_cache(maxsize=1)
def passage_times() -> np.ndarray:
    """Return the mean time from the mean up to k / PER_SIGMA sigmas, in units of tau; float64."""
    fine = 16
    y = np.arange(int(MOST_SIGMAS * PER_SIGMA * fine) + 1) / (PER_SIGMA * fine)
    below = np.array([0.5 * math.erfc(-value / math.sqrt(2.0)) for value in y])
    density = math.sqrt(2.0 * math.pi) * np.exp(0.5 * y * y) * below
    area = np.cumsum(0.5 * (density[1:] + density[:-1])) / (PER_SIGMA * fine)
    return np.concatenate(([0.0], area[fine - 1 :: fine]))


@lru_cache(maxsize=1)
def return_times() -> np.ndarray:
    """Return the mean time from k / PER_SIGMA sigmas back to the mean, in units of tau; float64.

    It is sqrt(2 pi) times the integral of exp(y^2 / 2) Phi(-y), Siegert's formula for the other direction.
    """
    y = np.arange(int(MOST_SIGMAS * PER_SIGMA) + 1) / PER_SIGMA
    above = np.array([math.exp(0.5 * v * v) * 0.5 * math.erfc(v / math.sqrt(2.0)) for v in y])
    area = np.cumsum(0.5 * (above[1:] + above[:-1])) / PER_SIGMA * math.sqrt(2.0 * math.pi)
    return np.concatenate(([0.0], area))


def mean_rate(sigmas: float) -> float:
    """Return a still pixel's shot noise events per tau at `sigmas` sigmas a threshold, averaged over levels.

    Of the two levels around the light, the lower one is a share f of a threshold below it. A passage from one
    level to the other and back is a pair of events. So is a passage outwards, beyond the nearer level.
    """
    share, grid = (np.arange(256) + 0.5) / 256, np.arange(passage_times().size) / PER_SIGMA
    inwards = np.interp(sigmas * share, grid, passage_times())
    back = np.interp(sigmas * share, grid, return_times())
    outwards = np.interp(sigmas * (1.0 + share), grid, passage_times())
    pair, stays = inwards + back, inwards[::-1] / (inwards + inwards[::-1])
    return float(np.mean(2.0 / (pair + pair[::-1]) + 4.0 * stays / outwards))


@lru_cache(maxsize=16)
def threshold_in_sigmas(events_per_tau: float) -> float:
    """Compute the size of a threshold in sigmas from the rate of shot noise events per tau.

    Raises:
        ValueError: Noise of this bandwidth cannot cross thresholds that often.
    """
    low, high = FEWEST_SIGMAS, MOST_SIGMAS
    if events_per_tau > mean_rate(low):
        most = mean_rate(low) / events_per_tau
        raise ValueError(
            f"shot_noise_hz is too high for the bandwidth of the pixel: at most {most:.3g} of it; "
            "raise camera.cutoff_hz or use faults.background_activity_hz"
        )
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if mean_rate(middle) > events_per_tau else (low, middle)
    return 0.5 * (low + high)


class Noisy(NamedTuple):
    """A camera and its noise."""

    model: Model
    memory: Memory
    noise: Noise
    process: Process


class Still(NamedTuple):
    """A pixel under constant light.

    Attributes:
        pixel: Number of the pixel.
        response: Response to its light.
        light: Luminance of the pixel.
        low, high: Changes of the response down and up to the next events, at the end of the span.
        from_us: Time from which its noise is simulated [us].
    """

    pixel: int
    response: float
    light: float
    low: float
    high: float
    from_us: float


class PixelState(NamedTuple):
    """The noise of one camera's pixels, in the form that compiled code takes.

    Attributes:
        rows: Arrays of a `Noise`, as for `_noise`; of 0 pixels if there is no noise.
        process: `Process`.
        rng: Source of all draws.
        scratch: Two rooms for blocks of pixels, and flags and room as for `crossings.scan`.
    """

    rows: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
    process: Process
    rng: np.random.Generator
    scratch: tuple


@lru_cache(maxsize=4)
def _scratch(size: int) -> tuple:
    """Allocate scratch for `size` pixels; all cameras of a process share it, so it stays in the cache."""
    words = (size + 7) // 8
    return make_room(), make_room(), np.zeros(words, np.uint64), np.zeros(8 * words, np.int64)


def no_noise(rng: np.random.Generator) -> PixelState:
    """Return the state of a camera whose pixels have no noise; it draws nothing from `rng`."""
    rows = np.zeros((0, 9)), np.zeros((2, 0), np.float32), np.zeros(0), np.zeros(0, np.int64)
    return PixelState(rows, Process(0.0, 1.0, np.zeros(2), 0.0, 1.0), rng, _scratch(0))


def draw_noise(
    camera: CameraConfig,
    faults: FaultsConfig,
    state: tuple,
    numbers: np.ndarray,
    t_us: int,
    rng: np.random.Generator,
) -> PixelState:
    """Draw the noise of a camera that has just seen its first frame, and move its levels to random places.

    Args:
        camera: Settings of the camera.
        faults: Settings of the noise.
        state: `EventCamera.state` of the camera.
        numbers: int64 (N,), the flat pixel y * W + x of each pixel of its memory; -1: dead.
        t_us: The time of the first frame [us].
        rng: Source of all draws.

    Raises:
        ValueError: The bandwidth of the pixels is too low for `shot_noise_hz`.
    """
    size, alive = numbers.size, numbers >= 0
    tau_s = 1.0 / (2.0 * math.pi * (camera.cutoff_hz or DEFAULT_BANDWIDTH_HZ))
    spread = alive * 10.0 ** (faults.noise_spread * rng.standard_normal(size))
    sigma, shot = 0.0, np.zeros(size)
    if faults.shot_noise_hz > 0.0:
        sigma = 1.0 / threshold_in_sigmas(faults.shot_noise_hz * tau_s)
        shot = spread
    rates = np.append(1.0 / np.maximum(passage_times(), 1.0 / PER_SIGMA), 0.0) * (1e-6 / tau_s)
    slice_us = 1e6 * SLICE / max(faults.leak_hz, 1e-9)
    process = Process(sigma, 1e6 * tau_s, rates, float(faults.leak_jitter), slice_us)
    leak = faults.leak_hz * spread
    rows, seen = np.zeros((size, 9)), np.zeros((2, size), np.float32)
    rows[:, 0] = leak / np.maximum(1.0 + faults.leak_jitter * rng.standard_normal(size), 0.1)
    rows[:, 1], rows[:, 2], rows[:, 3] = leak, shot, rng.standard_exponential(size)
    rows[:, 4], rows[:, 6], rows[:, 7], seen[1] = t_us, t_us, -np.inf, np.nan
    due_us, kept_us = np.full(size, float(t_us)), np.full(size, np.iinfo(np.int64).min)
    move_levels(state[0], state[1], -rng.random(size) * alive)
    return PixelState((rows, seen, due_us, kept_us), process, rng, _scratch(size))


def kept_noise(state: PixelState) -> tuple[np.ndarray, np.ndarray]:
    """Return copies of `Noise.kept` and `Noise.kept_us`."""
    rows, _, _, kept_us = state.rows
    return rows[:, 8].copy(), kept_us.copy()


@numba.njit(cache=True, error_model="numpy")
def move_levels(model, memory, shares):
    """Move all remembered levels by these shares of the ON threshold, and the quiet bands with them.

    It also switches to stored bands, because from now on noise moves levels between the camera's own updates.
    """
    model, memory = named(model, memory)
    memory.is_banded[0] = True
    room, on = make_room(), model.thresholds.on
    for first in range(0, shares.size, BLOCK):
        pixels = np.arange(first, min(first + BLOCK, shares.size))
        for i in pixels:
            memory.first_level[i] += shares[i] * on[i if on.size > 1 else 0]
        set_quiet_bands(pixels, memory.first_level[first : first + pixels.size], model, memory, room)


@numba.njit(cache=True, error_model="numpy")
def fire(t0_us, t1_us, model, memory, state):
    """Fire the noise of (t0_us, t1_us], after the events of the light, under the light of t1_us.

    Args:
        t0_us: Start of the interval [us].
        t1_us: End of the interval [us].
        model: Model of the camera, as in `EventCamera.state`.
        memory: Memory of the camera, as in `EventCamera.state`.
        state: `PixelState`, changed in place.

    Returns:
        int64 (3, K): times [us], pixels of the memory, polarities.
    """
    (real, seen, due_us, kept_us), process, rng, scratch = state
    model, memory = named(model, memory)
    noise, (room, spare, flags, changed) = _noise(real, seen, due_us, kept_us), scratch
    parts = 1 + np.int64((t1_us - t0_us) / process.slice_us)  # fine enough for leakage
    noisy = Noisy(model, memory, noise, process)
    fired, count = np.empty((3, FIRED), np.int64), 0
    for part in range(parts):
        begin_us = t0_us + (t1_us - t0_us) * part // parts
        span = Span(begin_us, t0_us + (t1_us - t0_us) * (part + 1) // parts)
        found = _find(span, memory, noise, flags, changed)
        for first in range(0, found, BLOCK):
            pixels = changed[first : min(first + BLOCK, found)]
            _restore(pixels, t1_us, memory, noise)
            respond_at(pixels, memory.previous, model.curve, room.before, room)
            _wait(pixels, span, noisy, room)
            moved = 0
            for j in range(pixels.size):
                if room.after[j] > 0.0:
                    i, begin_us = pixels[j], np.float64(span.start_us)
                    still = Still(i, room.before[j], room.lights[j], room.low[j], room.high[j], begin_us)
                    count, still = _fire_pixel(still, span, t1_us, noisy, rng, fired, count)
                    while count == fired.shape[1]:
                        fired = _with_more_room(fired)
                        count, still = _fire_pixel(still, span, t1_us, noisy, rng, fired, count)
                    spare.exponents[moved] = i
                    moved += _is_free(i, t1_us, model, memory)
            _set_bands(spare.exponents[:moved], noisy, spare.levels, room)
    return fired[:, :count]


@numba.njit(cache=True, error_model="numpy")
def _with_more_room(fired):
    """Return a copy of the events with twice the room."""
    larger = np.empty((3, 2 * fired.shape[1]), np.int64)
    larger[:, : fired.shape[1]] = fired
    return larger


@numba.njit(cache=True, error_model="numpy", inline="always")
def _noise(real, seen, due_us, kept_us):
    """Return a `Noise` of float64 (N, 9), whose rows are read together, float32 (2, N), and two of (N,)."""
    return Noise(
        real[:, 0], real[:, 1], real[:, 2], real[:, 3], real[:, 4], real[:, 5], real[:, 6], real[:, 7],
        real[:, 8], due_us, seen[0], seen[1], kept_us,
    )  # fmt: skip


@kernel
def _find(span, memory, noise, flags, changed):
    """Write the pixels whose light or level has changed, or which are due; return their number."""
    flag, end_us, size = flags.view(np.uint8), np.float64(span.end_us), noise.due_us.size
    for i in range(size):
        other = abs(memory.previous[i] - noise.light[i]) > SAME_LIGHT * noise.light[i]
        flag[i] = other | (memory.quiet_low[i] != noise.band[i]) | (noise.due_us[i] <= end_us)
    return write_flagged(flags, size, 0, changed)


@kernel
def _restore(pixels, now_us, memory, noise):
    """Add the noise that pixels kept to the levels that they took at the end of a refractory period."""
    if memory.refractory_end_us.size > 0:
        for i in pixels:
            if noise.kept_us[i] < now_us and noise.kept[i] != 0.0:
                if noise.kept_us[i] == memory.refractory_end_us[i]:
                    memory.first_level[i] += noise.kept[i]
                    never_be_quiet(memory, i)
                noise.kept[i] = 0.0


@kernel
def _wait(pixels, span, noisy, room):
    """Advance pixels through a span, under the light at its end, if they do not fire; otherwise mark them.

    Of the columns of `room`, `before` holds the responses. The function fills `low` and `high` with the
    changes down and up to the next events at the end of the span, and sets `after` to 1 for pixels that fire.
    """
    model, memory, noise, process = noisy
    for j in range(pixels.size):
        i = pixels[j]
        on, off = _thresholds(i, model)
        noise.budget[i] -= noise.pace[i] * max(span.start_us - noise.from_us[i], 0.0)
        memory.first_level[i] -= noise.leak[i] * on * 1e-6 * (span.end_us - noise.since_us[i])
        level = level_of(memory, i, on, off)
        low, high = off + room.before[j] - level, on + level - room.before[j]
        pending = model.rule.carries and high <= -noise.leak[i] * on * 1e-6 * (span.end_us - span.start_us)
        begin_us = max(np.float64(span.start_us), _free_us(i, memory, noise))
        sigma = process.sigma * 0.5 * (on + off)
        rate = (_rate(low, sigma, process) + _rate(high, sigma, process)) * _dimmed(
            noise.shot[i], room.lights[j]
        )
        noise.since_us[i] = span.end_us
        left = noise.budget[i] - rate * max(span.end_us - begin_us, 0.0)
        due = min(low, high) <= 0.0 and begin_us < span.end_us and noise.leak_mean[i] + noise.shot[i] > 0.0
        room.low[j], room.high[j] = low, high
        room.after[j] = (left <= 0.0 or due) and not pending
        if not room.after[j]:
            noise.budget[i] = left
            fall = noise.leak[i] * on * 1e-6
            _schedule(i, room.lights[j], span.end_us, low, high, fall, rate, noisy)


@inlined
def _thresholds(i, model):
    """Return the ON and OFF threshold of a pixel."""
    k = i if model.thresholds.on.size > 1 else 0
    return model.thresholds.on[k], model.thresholds.off[k]


@inlined
def _free_us(i, memory, noise):
    """Return the time when a pixel's noise is back at its mean and its refractory period is over [us]."""
    if memory.refractory_end_us.size > 0:
        return max(noise.rest_us[i], np.float64(memory.refractory_end_us[i]))
    return noise.rest_us[i]


@inlined
def _schedule(i, light, now_us, low, high, fall, rate, noisy):
    """Set the time of a pixel's next update if its light stays the same: at the latest at its next event."""
    memory, noise, process = noisy.memory, noisy.noise, noisy.process
    begin_us = max(np.float64(now_us), _free_us(i, memory, noise))
    noise.pace[i], noise.from_us[i] = rate, begin_us
    noise.light[i], noise.band[i] = light, memory.quiet_low[i]
    due_us = begin_us + noise.budget[i] / rate if rate > 0.0 else np.inf
    if fall > 0.0:
        due_us = min(due_us, max(begin_us, now_us + high / fall), now_us + process.slice_us)
    noise.due_us[i] = begin_us if low <= 0.0 else due_us


@inlined
def _rate(change, sigma, process):
    """Return the rate at which noise of deviation `sigma` reaches a change of the response [1 / us]."""
    if sigma == 0.0:
        return 0.0
    place = min(max(change / sigma, 0.0) * PER_SIGMA, process.rates.size - 2.0)
    entry = int(place)
    return process.rates[entry] + (place - entry) * (process.rates[entry + 1] - process.rates[entry])


@inlined
def _dimmed(shot, light):
    """Return the rate of shot noise under a light, as a multiple of the nominal rate in black."""
    return shot * (1.0 - SHOT_NOISE_FALL * min(np.float64(light), 1.0))


@kernel
def _return_us(displaced, sigma, normal, process):
    """Return the time in which noise returns from a displacement to its mean [us]; `normal` is random."""
    if displaced == 0.0 or sigma == 0.0:
        return 0.0
    ratio = displaced / (sigma * normal)
    return 0.5 * process.tau_us * np.log1p(ratio * ratio)


@kernel
def _fire_pixel(still, span, now_us, noisy, rng, fired, count):
    """Add the events of one pixel in a span, one after the other, and set its level.

    Returns:
        The number of events in `fired`, and the pixel. If `fired` is full, call it again with more room.
    """
    model, memory, noise, process = noisy
    i, refractory_us = still.pixel, model.rule.refractory_us
    on, off = _thresholds(i, model)
    low, high, t = still.low, still.high, still.from_us
    sigma = process.sigma * 0.5 * (on + off)
    while True:
        if count == fired.shape[1]:
            return count, Still(i, still.response, still.light, low, high, t)
        begin = max(t, _free_us(i, memory, noise))
        up, down = _rate(high, sigma, process), _rate(low, sigma, process)
        rate = (up + down) * _dimmed(noise.shot[i], still.light)
        fall, due = noise.leak[i] * on * 1e-6, min(low, high) <= 0.0
        coming = begin + max(noise.budget[i], 0.0) / rate if rate > 0.0 else np.inf
        if due:
            coming = max(begin, span.end_us + high / fall if high <= 0.0 and fall > 0.0 else begin)
        if coming > span.end_us:
            noise.budget[i] -= 0.0 if due else rate * max(span.end_us - begin, 0.0)
            break
        event_us = np.int64(min(max(np.ceil(coming), span.start_us + 1), span.end_us))
        rises = high <= low if due else rng.random() * (up + down) < up
        fired[0, count], fired[1, count], fired[2, count] = event_us, i, 2 * rises - 1
        count += 1
        displaced = 0.0 if due else max(high, 0.0) if rises else -max(low, 0.0)
        if not due:
            noise.budget[i] = rng.standard_exponential()
        elif rises and fall > 0.0:
            noise.leak[i] = noise.leak_mean[i] / max(1.0 + process.jitter * rng.standard_normal(), 0.1)
            gained = (fall - noise.leak[i] * on * 1e-6) * (span.end_us - event_us)
            memory.first_level[i] += gained
            low, high = low - gained, high + gained
        low, high = (low - on, high + on) if rises else (low + off, high - off)
        count_crossings(memory, i, 1, rises, on, off)
        t = np.float64(event_us)
        if refractory_us > 0:
            t, displaced = _rest(still, event_us, now_us, displaced, sigma, noisy, rng)
            low, high = off - displaced, on + displaced
        noise.rest_us[i] = t + _return_us(displaced, sigma, rng.standard_normal(), process)
    _schedule(i, still.light, span.end_us, low, high, fall, rate, noisy)
    return count, still


@inlined
def _is_free(i, now_us, model, memory):
    """Whether no refractory period of a pixel outlasts the last frame."""
    return model.rule.refractory_us == 0 or memory.refractory_end_us[i] <= now_us


@kernel
def _set_bands(pixels, noisy, levels, room):
    """Set the quiet bands of pixels that fired, together, because exponentials are fast in blocks."""
    model, memory, noise, _ = noisy
    for j in range(pixels.size):
        on, off = _thresholds(pixels[j], model)
        levels[j] = level_of(memory, pixels[j], on, off)
    set_quiet_bands(pixels, levels, model, memory, room)
    for i in pixels:
        noise.band[i] = memory.quiet_low[i]


@kernel
def _rest(still, event_us, now_us, displaced, sigma, noisy, rng):
    """Start a refractory period; return its end [us] and the displacement of noise and level at that time.

    If the period outlasts the last frame, the camera ends it and takes the light of that moment as the level.
    The displacement by the noise is stored until then.
    """
    model, memory, noise, process = noisy
    refractory_us = model.rule.refractory_us
    i, end_us, left = still.pixel, event_us + refractory_us, np.exp(-refractory_us / process.tau_us)
    displaced = displaced * left + sigma * np.sqrt(1.0 - left * left) * rng.standard_normal()
    memory.refractory_end_us[i] = end_us
    if end_us <= now_us:
        memory.first_level[i], memory.on_count[i], memory.off_count[i] = still.response + displaced, 0, 0
    else:
        noise.kept[i], noise.kept_us[i] = displaced, end_us
        never_be_quiet(memory, i)
    return np.float64(end_us), displaced
