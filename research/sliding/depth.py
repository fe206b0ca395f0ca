"""Depth from frames of a camera that slides sideways by known ways: multiple-baseline stereo.

A point at depth Z moves by focal * way / Z pixels against the way. For each depth that is tried all frames
are moved back by that much; where it is the true one they agree with the reference (Okutomi & Kanade 1993).
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import map_coordinates, uniform_filter

WINDOW = 9  # pixels of a patch
MOST_PER_M, TRIED = 4.0, 81  # inverse depths [1 / m]


class Lens(NamedTuple):
    """A pinhole with the distortion of Brown (1966), as OpenCV orders it; pixels where it has a unit."""

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0


def distorted(lens: Lens, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Row and column at which the lens shows what a pinhole shows at each pixel, float64 (H, W) each."""
    row, column = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
    x, y = (column - lens.cx) / lens.fx, (row - lens.cy) / lens.fy
    r = x * x + y * y
    radial = 1.0 + r * (lens.k1 + r * (lens.k2 + r * lens.k3))
    across = x * radial + 2.0 * lens.p1 * x * y + lens.p2 * (r + 2.0 * x * x)
    down = y * radial + lens.p1 * (r + 2.0 * y * y) + 2.0 * lens.p2 * x * y
    return lens.fy * down + lens.cy, lens.fx * across + lens.cx


def straightened(picture: np.ndarray, lens: Lens) -> np.ndarray:
    """A picture (H, W) as a pinhole had taken it, float64."""
    return map_coordinates(
        picture.astype(np.float64), distorted(lens, picture.shape), order=1, mode="nearest"
    )


def inverse_depth(
    pictures: np.ndarray, ways_m: np.ndarray, reference: int, focal: float
) -> tuple[np.ndarray, np.ndarray]:
    """Inverse depth [1 / m] at each pixel of one of the pictures, and how well it is known.

    Args:
        pictures: float64 (K, H, W), of a pinhole.
        ways_m: To the right, of each picture [m], (K,).
        reference: Which picture.
        focal: Focal length [pixels].

    Returns:
        float64 (H, W) twice; the second is the mean error of all depths over that of the best one.
    """
    tried = np.linspace(0.0, MOST_PER_M, TRIED)
    normal = np.stack([_normalised(picture) for picture in pictures])
    column = np.arange(pictures.shape[2], dtype=np.float64)
    errors = np.empty((TRIED, *pictures.shape[1:]))
    for place, inverse in enumerate(tried):
        total, seen = np.zeros(pictures.shape[1:]), np.zeros(pictures.shape[2])
        for k, way in enumerate(ways_m - ways_m[reference]):
            if k != reference:
                at = column - focal * way * inverse
                inside = (at >= 0.0) & (at <= column[-1])
                moved = _columns(normal[k], np.clip(at, 0.0, column[-1]))
                total += np.abs(moved - normal[reference]) * inside
                seen += inside
        errors[place] = uniform_filter(total / np.maximum(seen, 1.0), WINDOW)
    best = errors.argmin(axis=0)
    least = np.take_along_axis(errors, best[None], 0)[0]
    return tried[best], errors.mean(axis=0) / np.maximum(least, 1e-9)


def _normalised(picture: np.ndarray) -> np.ndarray:
    """A picture less its local mean, in local standard deviations and two greys: flat parts stay flat."""
    mean = uniform_filter(picture, 2 * WINDOW + 1)
    spread = np.sqrt(np.maximum(uniform_filter(picture * picture, 2 * WINDOW + 1) - mean * mean, 0.0))
    return (picture - mean) / (spread + 2.0)


def _columns(picture: np.ndarray, at: np.ndarray) -> np.ndarray:
    """A picture read at fractional columns, (W,)."""
    left = np.minimum(at.astype(np.int64), picture.shape[1] - 2)
    share = at - left
    return picture[:, left] * (1.0 - share) + picture[:, left + 1] * share
