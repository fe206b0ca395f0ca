"""Flicker of lamps on the mains: the whole scene's light rises and falls at twice the mains frequency.

The luminance of a scene at time t is multiplied by 1 + depth * sin(2 pi (hz t + phase)), with a phase drawn
once per episode. Lamps follow the power, so 50 Hz mains flicker at 100 Hz and 60 Hz mains at 120 Hz. The sine
is a polynomial with an error below 1e-11, so that events do not depend on a library's sine.
"""

import math
from typing import NamedTuple

import numba
import numpy as np

from envs.compiled import inlined
from envs.config import FaultsConfig

LOOKS_A_PERIOD = 16  # light is taken as linear in between: an error of at most 1.9 % of the depth
TERMS = tuple((-1) ** k * (2.0 * math.pi) ** (2 * k + 1) / math.factorial(2 * k + 1) for k in range(9))


class Flicker(NamedTuple):
    """Flicker of the light in an episode.

    Attributes:
        depth: Amplitude as a share of the mean light; 0: no flicker.
        per_us: Periods per microsecond.
        phase: Phase at time 0 in periods, in [0, 1).
    """

    depth: float
    per_us: float
    phase: float


NO_FLICKER = Flicker(0.0, 0.0, 0.0)


def draw_flicker(faults: FaultsConfig, rng: np.random.Generator) -> Flicker:
    """Draw the flicker of an episode; without flicker it draws nothing from `rng`."""
    if faults.flicker_depth == 0.0 or faults.flicker_hz == 0.0:
        return NO_FLICKER
    return Flicker(faults.flicker_depth, faults.flicker_hz * 1e-6, float(rng.random()))


@inlined
def brightness(flicker, t_us):
    """Return the factor on the light at a time [us], float32."""
    periods = flicker.per_us * t_us + flicker.phase
    part = periods - np.floor(periods + 0.25)  # in [-0.25, 0.75)
    if part > 0.25:
        part = 0.5 - part
    square, sine = part * part, 0.0
    for k in range(len(TERMS) - 1, -1, -1):
        sine = sine * square + TERMS[k]
    return np.float32(max(0.0, 1.0 + flicker.depth * sine * part))


@numba.njit(cache=True, error_model="numpy")
def brightness_at(flicker, times_us):
    """Return the factors on the light at several times (int64 (K,) [us]), float32 (K,)."""
    factors = np.empty(times_us.size, np.float32)
    for k in range(times_us.size):
        factors[k] = brightness(flicker, times_us[k])
    return factors


@inlined
def looks_needed(flicker, length_us):
    """Return the number of parts of `length_us` [us] in each of which the light is linear enough."""
    return np.int64(np.ceil(flicker.per_us * length_us * LOOKS_A_PERIOD))
