"""Label the events of a noisy pixel: whether the light fired them, or the noise.

Each noisy pixel gets a noiseless twin that sees the same light. The twin's level moves by whole thresholds,
and only with events of the light. An event belongs to the light if the light alone has moved at least half of
the way from that level to the next, and at least a quarter of a threshold since its last event. Otherwise the
event is noise.

So an event that noise fires a little early belongs to the light, and an event of a still pixel is noise. If a
level leaks, the events that the noiseless twin does not fire are noise. The rule does not use time, so it is
independent of the step. For a pixel's first event the light needs to move only a tenth of the way, because
the pixel's level may start anywhere between two events.
"""

from typing import NamedTuple

import numba
import numpy as np

from envs.compiled import inlined, kernel
from envs.events.crossings import level_of, named
from envs.events.photoreceptor import respond

NEAR = 0.5  # of a threshold: smallest change of the light from the level at an event of the light
MOVED = 0.25  # of a threshold: smallest change of the light since its last event
FIRST = 0.1  # of the way to a pixel's first event: smallest change of the light, if the event is the light's


class Noiseless(NamedTuple):
    """State of the N noiseless pixels, in the order of the camera's memory, float64; changed in place.

    Attributes:
        level: Level of the noiseless pixel.
        rest: Response at the last event of the light, or at the first frame before any.
        noisy: Level of the noisy pixel at the end of the last interval; NaN in a refractory period.
        is_new: Whether the light has not fired yet, bool.
        waits: Whether `level` must be set at the end of the pixel's refractory period, bool.
    """

    level: np.ndarray
    rest: np.ndarray
    noisy: np.ndarray
    is_new: np.ndarray
    waits: np.ndarray


class NoiseLabels:
    """The noiseless pixels of one camera, and the labels derived from them."""

    def __init__(self, state: tuple, numbers: np.ndarray, rest: np.ndarray) -> None:
        """Start with the levels of a camera whose noise has just been drawn.

        Args:
            state: `EventCamera.state`.
            numbers: Flat pixel y * W + x of each pixel of its memory, int64 (N,).
            rest: Responses to the first frame, float64 (N,), in the order of the memory.
        """
        self._model, self._memory, _ = state
        self._place = np.empty_like(numbers)
        self._place[numbers] = np.arange(numbers.size)
        level = np.empty(numbers.size)
        levels_at(-(2**62), self._model, self._memory, level)
        self._noiseless = Noiseless(
            level, rest.copy(), level.copy(), np.ones(level.size, bool), np.zeros(level.size, bool)
        )

    def of(
        self,
        light: tuple[np.ndarray, np.ndarray],
        noise: tuple[np.ndarray, np.ndarray],
        t1_us: int,
        kept: tuple[np.ndarray, np.ndarray],
    ) -> tuple[np.ndarray, np.ndarray]:
        """Label the events of an interval; call it once, after the noise of the interval has been fired.

        Args:
            light: Flat pixels y * W + x and polarities of the events that the camera fired, in time order.
            noise: Pixels and polarities of the events from `pixel_noise.fire`, in its order.
            t1_us: End of the interval [us].
            kept: `kept` and `kept_us` of the pixel noise before it was fired.

        Returns:
            Whether each event of `light` and of `noise` is noise, two bool arrays.
        """
        (places, signs), (noisy_places, noisy_signs) = (
            (self._place[pixels], polarities.astype(np.int64)) for pixels, polarities in (light, noise)
        )
        return label(
            (places, signs),
            (noisy_places, noisy_signs),
            t1_us,
            kept,
            self._model,
            self._memory,
            self._noiseless,
        )


@numba.njit(cache=True, error_model="numpy")
def levels_at(t_us, model, memory, levels):
    """Write the remembered levels, float64 (N,); NaN for pixels in a refractory period at `t_us`."""
    model, memory = named(model, memory)
    on, off = model.thresholds.on, model.thresholds.off
    for i in range(levels.size):
        k = i if on.size > 1 else 0
        levels[i] = level_of(memory, i, on[k], off[k])
        if model.rule.refractory_us > 0 and memory.refractory_end_us[i] > t_us:
            levels[i] = np.nan


@numba.njit(cache=True, error_model="numpy")
def label(light, noise, t1_us, kept, model, memory, noiseless):
    """Label the events of an interval, see `NoiseLabels.of`; pixels are numbers of the memory."""
    rows, shared = model, memory
    model, memory = named(model, memory)
    of_light, of_noise = np.zeros(light[0].size, np.bool_), np.ones(noise[0].size, np.bool_)
    if model.rule.forgets:  # the level is the last frame's, so exactly the events of `noise` are noise
        return of_light, of_noise
    for k in range(of_light.size):
        i, sign = light[0][k], light[1][k]
        size = _threshold(i, sign, model)
        start = noiseless.level[i] if np.isnan(noiseless.noisy[i]) else noiseless.noisy[i]
        of_light[k] = _is_noise(i, sign, size, start + sign * size, noiseless)
        noiseless.noisy[i], noiseless.waits[i] = start + sign * size, True
    responses, exponents = np.empty(of_noise.size), np.empty(of_noise.size, np.int64)
    respond(model.curve, memory.previous[noise[0]], responses, exponents)
    for k in range(of_noise.size):
        i, sign = noise[0][k], noise[1][k]
        of_noise[k] = _is_noise(i, sign, _threshold(i, sign, model), responses[k], noiseless)
        if model.rule.refractory_us > 0:
            _settle(i, responses[k], noiseless)
            noiseless.waits[i] = memory.refractory_end_us[i] > t1_us
    levels_at(t1_us, rows, shared, noiseless.noisy)
    if model.rule.refractory_us > 0:
        _leave_refractory_periods(memory, kept, noiseless)
    return of_light, of_noise


@inlined
def _threshold(i, sign, model):
    """Return the threshold of a pixel in one direction."""
    k = i if model.thresholds.on.size > 1 else 0
    return model.thresholds.on[k] if sign > 0 else model.thresholds.off[k]


@inlined
def _is_noise(i, sign, size, response, noiseless):
    """Whether the noise fired an event; if not, this also moves the noiseless pixel's level.

    The level moves by whole thresholds to the one nearest to the light, because the noisy pixel may have
    missed some.
    """
    moved, change = sign * (response - noiseless.rest[i]), sign * (response - noiseless.level[i])
    if noiseless.is_new[i]:
        if moved < FIRST * (size - change + moved):
            return True
        change = max(change, NEAR * size)
    elif change < NEAR * size or moved < MOVED * size:
        return True
    noiseless.level[i] += sign * size * np.floor(change / size + 0.5)
    noiseless.rest[i], noiseless.is_new[i] = response, False
    return False


@inlined
def _settle(i, response, noiseless):
    """Set the level of a noiseless pixel to the response to its light."""
    noiseless.level[i] = noiseless.rest[i] = response
    noiseless.is_new[i] = False


@kernel
def _leave_refractory_periods(memory, kept, noiseless):
    """Set a noiseless pixel's level to the light at the end of its refractory period, as the camera does.

    The noisy pixel's level is then the light's plus the noise that was kept. Earlier noise has no effect.
    """
    for i in range(noiseless.waits.size):
        if noiseless.waits[i] and not np.isnan(noiseless.noisy[i]):
            added = kept[0][i] if kept[1][i] == memory.refractory_end_us[i] else 0.0
            _settle(i, noiseless.noisy[i] - added, noiseless)
            noiseless.waits[i] = False
