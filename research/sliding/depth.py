"""Compute depth from frames of a camera that slides sideways by known distances: multiple-baseline stereo.

A point at depth Z moves by focal * distance / Z pixels, opposite to the camera. For each candidate depth all
frames are shifted back by that much; at the true depth they agree with the reference (Okutomi & Kanade 1993).
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import map_coordinates, uniform_filter

WINDOW = 9  # pixels of a patch
MOST_PER_M, TRIED = 4.0, 81  # largest inverse depth [1 / m], and number of candidates


class Lens(NamedTuple):
    """A pinhole with the distortion of Brown (1966), ordered as in OpenCV; lengths in pixels."""

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
    """Return the row and column at which the lens shows each pixel of a pinhole, float64 (H, W) each."""
    row, column = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
    x, y = (column - lens.cx) / lens.fx, (row - lens.cy) / lens.fy
    r = x * x + y * y
    radial = 1.0 + r * (lens.k1 + r * (lens.k2 + r * lens.k3))
    across = x * radial + 2.0 * lens.p1 * x * y + lens.p2 * (r + 2.0 * x * x)
    down = y * radial + lens.p1 * (r + 2.0 * y * y) + 2.0 * lens.p2 * x * y
    return lens.fy * down + lens.cy, lens.fx * across + lens.cx


def straightened(picture: np.ndarray, lens: Lens) -> np.ndarray:
    """Return a picture (H, W) as a pinhole would have taken it, float64."""
    return map_coordinates(
        picture.astype(np.float64), distorted(lens, picture.shape), order=1, mode="nearest"
    )


def inverse_depth(
    pictures: np.ndarray, ways_m: np.ndarray, reference: int, focal: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the inverse depth [1 / m] at each pixel of one of the pictures, and its confidence.

    Args:
        pictures: float64 (K, H, W), of a pinhole.
        ways_m: Position of the camera to the right at each picture [m], (K,).
        reference: Index of the picture.
        focal: Focal length [pixels].

    Returns:
        float64 (H, W) twice; the second is the mean error of all depths divided by the error of the best.
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
    """Subtract the local mean, divide by the local deviation plus two greys: flat parts stay flat."""
    mean = uniform_filter(picture, 2 * WINDOW + 1)
    spread = np.sqrt(np.maximum(uniform_filter(picture * picture, 2 * WINDOW + 1) - mean * mean, 0.0))
    return (picture - mean) / (spread + 2.0)


def _columns(picture: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Interpolate a picture at fractional columns, (W,)."""
    left = np.minimum(at.astype(np.int64), picture.shape[1] - 2)
    share = at - left
    return picture[:, left] * (1.0 - share) + picture[:, left + 1] * share
