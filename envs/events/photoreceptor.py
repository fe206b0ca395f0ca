"""From light to a pixel's response: a reproducible logarithm, the response curve, 8-bit encodings.

The logarithm uses only +, -, *, / and bit shifts, which IEEE 754 rounds in exactly one way, so
that a level is crossed on every machine or on none. A loop over it compiles to wide
instructions, unlike calls of a library's `log`.
"""

import math
from typing import NamedTuple

import numba
import numpy as np

from core.pictures import GAMMA
from envs.compiled import kernel

MAX_LUMINANCE = float(np.finfo(np.float32).max)
ROOT_HALF = 0x3FE6A09E667F3BCD  # the bits of sqrt(1/2)
INVERSE_LN2 = 1.4426950408889634
LN2_HIGH, LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10  # sum: ln 2; k * HIGH is exact


class Curve(NamedTuple):
    """A response curve: log(max(L + shift, knee)), plus gain * (L - knee) below the knee.

    Attributes:
        shift: Added to the luminance L.
        knee: Luminance below which the response is linear; 0: it is linear nowhere.
        gain: Slope of the linear part.
        lowest: Logarithm of the knee; -inf if the knee is 0.
    """

    shift: float
    knee: float
    gain: float
    lowest: float


def response_curve(response: str, luminance_floor: float) -> Curve:
    """Return the response curve of a camera's settings.

    With a = luminance_floor and L the luminance: "log" is log(L + a). "lin_log" is log(L)
    from a upwards and log(a) + (L - a) / a below it; value and slope are continuous at a.

    Args:
        response: "log" or "lin_log".
        luminance_floor: a > 0, relative to white = 1.
    """
    if response == "log":
        return Curve(luminance_floor, 0.0, 0.0, -math.inf)
    return Curve(0.0, luminance_floor, 1.0 / luminance_floor, math.log(luminance_floor))


@kernel
def natural_logarithm(values, exponents):
    """Replace each of `values` (float64, normal, > 0) by its logarithm; `exponents` is room, int64 (N,).

    x = 2^k (1 + f) with 1 + f in [sqrt(1/2), sqrt(2)); log(1 + f) is the odd series in
    s = f / (2 + f), as in Tang (1990) and fdlibm. The error is below 1 ulp
    (tests/envs/events/test_photoreceptor.py).
    """
    bits = values.view(np.int64)
    for i in range(values.size):
        k = (bits[i] - ROOT_HALF) >> 52
        exponents[i] = k
        bits[i] -= k << 52
    for i in range(values.size):
        f = values[i] - 1.0
        s = f / (2.0 + f)
        z = s * s
        r = 1.479819860511658591e-01 * z + 1.531383769920937332e-01
        r = r * z + 1.818357216161805012e-01
        r = r * z + 2.222219843214978396e-01
        r = r * z + 2.857142874366239149e-01
        r = r * z + 3.999999999940941908e-01
        r = (r * z + 6.666666666666735130e-01) * z
        half = 0.5 * f * f
        k = exponents[i]
        values[i] = k * LN2_HIGH - ((half - (s * (half + r) + k * LN2_LOW)) - f)


@kernel
def respond(curve, luminance, levels, exponents):
    """Write the responses to `luminance` (float32 (N,), finite, >= 0) into the first N `levels` (float64).

    `exponents` is room, int64 (N,).
    """
    levels = levels[: luminance.size]
    for i in range(luminance.size):
        levels[i] = max(luminance[i] + curve.shift, curve.knee)
    natural_logarithm(levels, exponents)
    if curve.gain > 0.0:
        for i in range(luminance.size):
            levels[i] += min(luminance[i] - curve.knee, 0.0) * curve.gain


@kernel
def exponential(values, exponents):
    """Replace each of `values` (float64, between -700 and 700) by its exponential, relative error 1e-12.

    `exponents` is room, int64 (N,).
    """
    bits = values.view(np.int64)
    for i in range(values.size):
        k = np.rint(values[i] * INVERSE_LN2)
        exponents[i] = np.int64(k)
        values[i] = values[i] - k * LN2_HIGH - k * LN2_LOW
    for i in range(values.size):
        r = values[i]
        e = r * (1.0 / 3628800.0) + 1.0 / 362880.0
        e = e * r + 1.0 / 40320.0
        e = e * r + 1.0 / 5040.0
        e = e * r + 1.0 / 720.0
        e = e * r + 1.0 / 120.0
        e = e * r + 1.0 / 24.0
        e = e * r + 1.0 / 6.0
        e = e * r + 0.5
        values[i] = (e * r + 1.0) * r + 1.0
    for i in range(values.size):
        bits[i] += exponents[i] << 52


@kernel
def light_of(curve, levels, exponents):
    """Replace responses (float64) by their luminances; negative if no luminance has so low a response.

    `exponents` is room, int64 (N,).
    """
    if curve.knee == 0.0:
        exponential(levels, exponents)
        for i in range(levels.size):
            levels[i] -= curve.shift
        return
    first = 0  # start of a run above the knee, because the exponential is fast over long runs
    for i in range(levels.size):
        if levels[i] < curve.lowest:
            exponential(levels[first:i], exponents[first:i])
            levels[i] = curve.knee + (levels[i] - curve.lowest) * curve.knee
            first = i + 1
    exponential(levels[first:], exponents[first:])


def encoding_tables(encoding: str) -> tuple[np.ndarray, np.ndarray]:
    """Return an 8-bit encoding's bounds between codes, float32 (255,), and the codes' values, float32 (256,).

    "linear8" rounds the luminance to the nearest multiple of 1/255. "gamma8" rounds the luminance to the
    power 1/2.2 in the same way, and decodes the result. Light above 1 has code 255.
    """
    gamma = {"linear8": 1.0, "gamma8": GAMMA}[encoding]
    codes = np.arange(256) / 255.0
    bounds = ((np.arange(255) + 0.5) / 255.0) ** gamma
    return bounds.astype(np.float32), (codes**gamma).astype(np.float32)


@numba.njit(cache=True, error_model="numpy")
def encode(luminance, bounds, meanings, out):
    """Write the 8-bit version of `luminance` into `out`; return the first invalid index, or -1."""
    for i in range(luminance.size):
        light = luminance[i]
        if not 0.0 <= light <= MAX_LUMINANCE:
            return i
        code = 0
        for half in (128, 64, 32, 16, 8, 4, 2, 1):
            if light >= bounds[code + half - 1]:
                code += half
        out[i] = meanings[code]
    return -1
