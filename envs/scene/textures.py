"""Textures: patterns on surfaces, still or moving.

A texture multiplies the albedo of its surface by 1 + contrast * P(s - vs t, q - vq t), where
P is the pattern, in [-1, 1], and (s, q) are surface coordinates in metres:

- ground, caps and level faces of boxes: (x, y)
- walls and the sides of boxes that face x: (y, z); those that face y: (x, z)
- poles, cones and ellipsoids: (x0 + k * azimuth, y0 + z), with the azimuth
  atan2(y - y0, x - x0) around their axis (x0, y0), and k such that a whole number of
  periods (of tiles, for noise) fits around the body, as near to its circumference as possible
"""

import functools
import math
from dataclasses import dataclass

import numpy as np

PLAIN, CHECKER, STRIPES, RINGS, NOISE = range(5)
PATTERNS = ("plain", "checker", "stripes", "rings", "noise")
TILE_PERIODS = 4  # periods along each axis after which the noise repeats
TILE = 256  # texels along each axis of the noise's tile


@dataclass(frozen=True)
class Texture:
    """One pattern.

    Attributes:
        pattern: "plain": 0. "checker": +-1 in squares of half a period. "stripes": +-1 along
            s. "rings": +-1 along q. "noise": a sum of waves between 1 and 2 periods long.
        period_m: Length of one period along either axis [m].
        contrast: Depth of the pattern, in [0, 1].
        velocity_mps: Velocity of the pattern along s and q [m/s].
        seed: Seed of the noise.
    """

    pattern: str = "plain"
    period_m: float = 1.0
    contrast: float = 0.0
    velocity_mps: tuple[float, float] = (0.0, 0.0)
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the values; ValueError names the wrong one and the rule."""
        if self.pattern not in PATTERNS:
            raise ValueError(f"texture pattern must be one of {PATTERNS}; got {self.pattern!r}.")
        if not 1e-3 <= self.period_m <= 1e4:
            raise ValueError(f"texture period_m must be in [0.001, 10000] m; got {self.period_m!r}.")
        if not 0.0 <= self.contrast <= 1.0:
            raise ValueError(f"texture contrast must be in [0, 1]; got {self.contrast!r}.")
        if not (len(self.velocity_mps) == 2 and all(abs(v) <= 1e4 for v in self.velocity_mps)):
            raise ValueError(
                f"texture velocity_mps must be two numbers within +-10000 m/s; got {self.velocity_mps!r}."
            )
        if not (isinstance(self.seed, int) and self.seed >= 0):
            raise ValueError(f"texture seed must be a whole number >= 0; got {self.seed!r}.")

    @property
    def depth(self) -> float:
        """Largest change of the albedo, as a share of its mean."""
        return 0.0 if self.pattern == "plain" else self.contrast

    @property
    def plain(self) -> bool:
        """Whether the surface looks the same everywhere."""
        return self.depth == 0.0

    @property
    def sharp(self) -> bool:
        """Whether the surface shows edges."""
        return not self.plain and self.pattern != "noise"


def around(texture: Texture, radius_m: float) -> float:
    """Return the metres of surface coordinate per radian around a round body, so that the pattern closes.

    Args:
        texture: The texture.
        radius_m: Largest radius of the body [m].
    """
    repeat = texture.period_m * (TILE_PERIODS if texture.pattern == "noise" else 1)
    return max(1, round(2.0 * math.pi * radius_m / repeat)) * repeat / (2.0 * math.pi)


@functools.cache
def noise_waves(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the waves of the noise: cycles per tile along (s, q), (M, 2), and complex amplitudes (M,).

    P(s, q) = Re sum of amplitude * exp(2 pi i (a s + b q)), s and q in tiles. These are all waves
    of a half-plane with TILE_PERIODS / 2 to TILE_PERIODS cycles a tile, equally strong, with
    random phases; the largest |P| among the texels is 1.
    """
    span = range(-TILE_PERIODS, TILE_PERIODS + 1)
    half = [(a, b) for a in span for b in span if a > 0 or (a == 0 and b > 0)]
    cycles = np.array([k for k in half if TILE_PERIODS / 2 <= math.hypot(*k) <= TILE_PERIODS])
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * math.pi, len(cycles))
    amplitudes = np.exp(1j * phases)
    amplitudes /= np.abs(_sum_waves(cycles, amplitudes)).max()
    return cycles, amplitudes


def _sum_waves(cycles: np.ndarray, amplitudes: np.ndarray) -> np.ndarray:
    """Return the sum of the waves at the texels, (TILE, TILE) float64, q along rows and s along columns.

    It adds wave by wave, because the rounding of BLAS depends on the number of threads and the processor.
    """
    turns = 2j * math.pi / TILE * np.arange(TILE)
    along_s, along_q = np.exp(np.outer(cycles[:, 0], turns)), np.exp(np.outer(cycles[:, 1], turns))
    total = np.zeros((TILE, TILE))
    for s, q, amplitude in zip(along_s, along_q, amplitudes, strict=True):
        wave = (q * amplitude)[:, None]
        total += wave.real * s.real - wave.imag * s.imag
    return total


@functools.cache
def noise_tile(seed: int) -> np.ndarray:
    """Return a tile of the noise, (TILE, TILE) float32, read-only: tile[j, i] is P at s = i, q = j texels."""
    tile = _sum_waves(*noise_waves(seed)).astype(np.float32)
    tile.flags.writeable = False
    return tile
