"""Noise: a sum of waves, each of which has a known mean over a parallelogram.

The waves come from `envs.scene.textures.noise_waves`. At a given height a pixel always shows the same
piece of the ground relative to the camera. So the mean of each wave over each pixel of the ground is
tabulated, and the camera's position only shifts the phases of the waves. Numbers are float32. Means over
parallelograms are accurate to 1e-5 of the noise, means over the ground, which combine several
parallelograms, to 0.02 (tests/envs/raycast/test_noise.py).
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numba
import numpy as np

from envs.compiled import inlined, kernel
from envs.raycast.records import Mixing, Noise, Record
from envs.scene.textures import TILE_PERIODS, noise_waves

WAVES = len(noise_waves(0)[0])  # a multiple of four, because `mean_noise` adds four at a time
PARTS = 64  # most parts of a ground pixel; with more, waves cancel
LONGEST = 1e6  # [tiles] longest side of a parallelogram
MAX_TABLE = 2**22  # most numbers in a table of the ground; larger images average each pixel in each render

REAL = np.float32
PI, ONE, TWO, HALF = REAL(math.pi), REAL(1.0), REAL(2.0), REAL(0.5)
# Taylor series of sin(pi x), accurate to 6e-8 for |x| <= 1/2.
SINE = tuple(REAL((-1) ** k * math.pi ** (2 * k + 1) / math.factorial(2 * k + 1)) for k in range(6))


class Footprint(NamedTuple):
    """The parallelogram of a surface to average over, given by its two sides in s and q."""

    one_s: float
    one_q: float
    other_s: float
    other_q: float


def make_mixing(height: int) -> Mixing:
    """Allocate room for images of `height` rows."""
    return Mixing(np.zeros(WAVES, REAL), np.zeros(2 * WAVES, REAL), np.zeros(height, REAL))


def waves_of(seed: int) -> np.ndarray:
    """Return the waves of a seed, float32 (4, WAVES), see `Noise`."""
    cycles, amplitudes = noise_waves(seed)
    turn = np.angle(amplitudes) / (2.0 * math.pi)
    return np.stack([cycles[:, 0], cycles[:, 1], turn, np.abs(amplitudes)]).astype(REAL)


NO_NOISE = Noise(np.zeros((1, 4, WAVES), REAL), np.zeros((0, 0, 0), REAL), 0.0)


@inlined
def _sine(x: np.float32) -> np.float32:
    """Return the sine of pi * x for |x| <= 1/2."""
    y = x * x
    return x * (SINE[0] + y * (SINE[1] + y * (SINE[2] + y * (SINE[3] + y * (SINE[4] + y * SINE[5])))))


@inlined
def _cosine_of_turn(turn: np.float32) -> np.float32:
    """Return the cosine of 2 pi * turn."""
    return _sine(HALF - TWO * abs(turn - np.rint(turn)))


@inlined
def _mean_over(cycles: np.float32) -> np.float32:
    """Return the factor by which averaging over `cycles` weakens a wave: sin(pi x) / (pi x)."""
    turn = cycles - TWO * np.rint(HALF * cycles)
    size = abs(turn)
    sine = np.copysign(_sine(min(size, ONE - size)), turn)
    return sine / (PI * cycles) if abs(cycles) > REAL(1e-3) else ONE


@inlined
def _bounded(side: float) -> np.float32:
    """Limit a side [tiles] to `LONGEST` for float32; over longer sides waves average to nothing."""
    return REAL(min(max(side, -LONGEST), LONGEST))


@kernel
def mean_noise(waves: np.ndarray, terms: np.ndarray, s: float, q: float, sides: Footprint) -> float:
    """Return the mean of noise over the parallelogram around (s, q) [tiles]; `waves` are (4, WAVES)."""
    left, down = REAL(s - np.floor(s)), REAL(q - np.floor(q))
    one_s, one_q = _bounded(sides.one_s), _bounded(sides.one_q)
    other_s, other_q = _bounded(sides.other_s), _bounded(sides.other_q)
    for k in range(WAVES):
        along_s, along_q = waves[0, k], waves[1, k]
        weight = _mean_over(along_s * one_s + along_q * one_q)
        weight *= _mean_over(along_s * other_s + along_q * other_q)
        turn = along_s * left + along_q * down + waves[2, k]
        terms[k] = waves[3, k] * weight * _cosine_of_turn(turn)
    # Four independent sums, which run in parallel.
    first = second = third = fourth = REAL(0.0)
    for k in range(0, WAVES, 4):
        first += terms[k]
        second += terms[k + 1]
        third += terms[k + 2]
        fourth += terms[k + 3]
    return float((first + second) + (third + fourth))


@inlined
def is_tabulated(noise: Noise, frame: Record) -> bool:
    """Whether the table of the ground holds for the current pose."""
    ahead = frame.cos == 1.0 and frame.sin == 0.0
    return ahead and noise.ground.size > 0 and noise.height == frame.eye_z


@kernel
def turn_waves(noise: Noise, frame: Record, mixing: Mixing) -> None:
    """Shift the phases of the ground's waves to the eye's position, if the ground is tabulated."""
    if not is_tabulated(noise, frame):
        return
    look, turned = frame.ground_texture, mixing.turned
    waves, scale = noise.waves[look.noise], look.frequency / TILE_PERIODS
    s = (frame.eye_x - look.speed_s * frame.time) * scale
    q = (frame.eye_y - look.speed_q * frame.time) * scale
    s, q = REAL(s - np.floor(s)), REAL(q - np.floor(q))
    for k in range(WAVES):
        turn = waves[0, k] * s + waves[1, k] * q + waves[2, k]
        turned[k] = waves[3, k] * _cosine_of_turn(turn)
        turned[WAVES + k] = -waves[3, k] * _cosine_of_turn(turn - REAL(0.25))


@kernel
def mix_ground(noise: Noise, mixing: Mixing, column: int) -> None:
    """Fill the end of `mixing.means` with the means of the noise over the ground pixels of a column."""
    table, turned = noise.ground[column], mixing.turned
    rows = table.shape[1]
    means = mixing.means[len(mixing.means) - rows :]
    means[:] = REAL(0.0)
    for k in range(2 * WAVES):
        weight = turned[k]
        for row in range(rows):
            means[row] += weight * table[k, row]


@lru_cache(maxsize=8)
def tabulate_ground(width: int, height: int, focal: float, eye_m: float, period_m: float) -> np.ndarray:
    """Return `Noise.ground` for a camera that looks along q from `eye_m` above the ground.

    Empty if it would have more than `MAX_TABLE` numbers, or if the eye is on the ground.
    """
    rows = height // 2
    if eye_m <= 0.0 or width * rows * 2 * WAVES > MAX_TABLE:
        return NO_NOISE.ground
    table = np.empty((width, 2 * WAVES, rows), REAL)
    _fill_ground(waves_of(0), focal, eye_m / (TILE_PERIODS * period_m), 0.5 * (height % 2), table)
    return table


@numba.njit(cache=True, error_model="numpy")
def _fill_ground(waves: np.ndarray, focal: float, eye: float, first: float, table: np.ndarray) -> None:
    """Average each wave over each ground pixel; row 0 is `first` rows below the horizon, `eye` in tiles.

    A pixel is cut into parts of equal height, in each of which depths are taken as evenly spread.
    """
    width, rows = table.shape[0], table.shape[2]
    table[:] = 0.0
    for row in range(rows):
        low, drop = first + row, focal * eye
        long = drop / max(low, 1.0 / PARTS) - drop / (low + 1.0)
        parts = min(PARTS, 2 + int(8.0 * long))
        for part in range(parts):
            near = drop / (low + (part + 1.0) / parts)
            far = drop / max(low + part / parts, 1e-6)
            depth, long = 0.5 * (near + far), far - near
            for column in range(width):
                u = (column + 0.5 - 0.5 * width) / focal
                _add_part(waves, depth, long, u, 1.0 / focal, table[column, :, row])
        table[:, :, row] /= parts


@kernel
def _add_part(waves: np.ndarray, depth: float, long: float, u: float, wide: float, means: np.ndarray) -> None:
    """Add the means of all waves over the ground at `depth` +- `long` / 2 and at slopes `wide` around `u`."""
    for k in range(WAVES):
        cycles = waves[0, k] * u + waves[1, k]
        weight = _mean_over(REAL(waves[0, k] * depth * wide)) * _mean_over(REAL(cycles * long))
        turn = cycles * depth
        turn = REAL(turn - np.rint(turn))
        means[k] += weight * _cosine_of_turn(turn)
        means[WAVES + k] += weight * _cosine_of_turn(turn - REAL(0.25))
