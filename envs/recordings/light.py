"""Convert the values of pictures to linear light on the pixels of a camera."""

from collections.abc import Callable
from functools import cache
from typing import Literal

import numba
import numpy as np

from envs.config import LUMINANCE_FLOOR

Transfer = Literal["srgb", "linear"]
TRANSFERS = ("srgb", "linear")
LUMA = np.array([0.2126, 0.7152, 0.0722], np.float32)  # Rec. 709: luminance of linear R, G, B
FLOOR_LEVELS = 10  # grey levels; below, a linear scale is too coarse for relative changes


def usual_transfer(dtype: np.dtype) -> Transfer:
    """Return the default transfer function of a dtype: integers are sRGB, floating point is linear."""
    return "linear" if dtype.kind == "f" else "srgb"


def usual_floor(dtype: np.dtype, transfer: Transfer) -> float:
    """Return the default luminance floor for pictures of a dtype (docs/camera.md).

    A linear scale of integers does not resolve relative changes in the lowest grey levels, so the floor is
    ten levels: 10/255 for 8 bits. All other pictures get `LUMINANCE_FLOOR`, which is also the minimum.
    """
    if dtype.kind == "f" or transfer == "srgb":
        return LUMINANCE_FLOOR
    return max(LUMINANCE_FLOOR, FLOOR_LEVELS / np.iinfo(dtype).max)


def luminance(values: np.ndarray, transfer: Transfer) -> np.ndarray:
    """Return the linear light of a picture. White (the largest integer, or 1.0 in floating point) is 1.

    Args:
        values: (H, W, 3) of R, G and B, or (H, W) of grey; uint8, uint16 or float32.
        transfer: "srgb": IEC 61966-2-1; "linear": proportional to the values.

    Returns:
        float32 (H, W), >= 0; negative values become black. Not finite where a value is not finite.
    """
    if values.dtype.kind == "u":
        light = light_of_grey(transfer, values.dtype.itemsize * 8)[values]
    else:
        light = np.where(np.isneginf(values), np.float32(np.nan), np.maximum(values, np.float32(0.0)))
        light = light if transfer == "linear" else _undo_srgb(light).astype(np.float32)
    if values.ndim == 2:
        return light
    red, green, blue = (light[..., k] * LUMA[k] for k in range(3))  # matmul's rounding depends on threads
    summed: np.ndarray = red + green + blue
    return summed


@cache
def light_of_grey(transfer: Transfer, bits: int = 8) -> np.ndarray:
    """Return the linear light in [0, 1], float32 (2**bits,), of each value of `bits` bits."""
    value = np.arange(1 << bits) / ((1 << bits) - 1.0)
    light = (_undo_srgb(value) if transfer == "srgb" else value).astype(np.float32)
    light.setflags(write=False)
    return light


def _undo_srgb(value: np.ndarray) -> np.ndarray:
    """Return the linear light of sRGB values >= 0; the curve continues above white."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def area_average(
    from_shape: tuple[int, int], to_shape: tuple[int, int]
) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that resamples a picture to larger (or finer) pixels, weighted by shared area.

    Args:
        from_shape: Rows and columns of the picture.
        to_shape: Rows and columns of the result.

    Returns:
        A function from float32 `from_shape` to float32 `to_shape`. It preserves the mean, and does
        not change a picture of `to_shape`.
    """
    if from_shape == to_shape:
        return np.ascontiguousarray
    rows, columns = (_overlap(old, new) for old, new in zip(from_shape, to_shape, strict=True))
    starts = [weights.argmax(axis=1) for weights in (rows > 0.0, columns > 0.0)]
    counts = [np.count_nonzero(weights, axis=1) for weights in (rows, columns)]
    return lambda picture: _averaged(picture, rows, columns, *starts, *counts)


@numba.njit(cache=True, error_model="numpy")
def _averaged(picture, rows, columns, first_rows, first_columns, num_rows, num_columns):
    """Average a picture, float32 (H, W), in float64 and in a fixed order, independent of threads.

    Args:
        picture: The picture.
        rows: Weights of its rows in each new row, see `_overlap`.
        columns: Weights of its columns in each new column.
        first_rows: First old row with a weight above 0, for each new row.
        first_columns: First old column with a weight above 0, for each new column.
        num_rows: Number of old rows with a weight above 0, for each new row.
        num_columns: Number of old columns with a weight above 0, for each new column.
    """
    averaged, line = np.empty((len(rows), len(columns)), np.float32), np.empty(picture.shape[1])
    for y in range(len(rows)):
        line[:] = 0.0
        for old in range(first_rows[y], first_rows[y] + num_rows[y]):
            for x in range(line.size):
                line[x] += rows[y, old] * picture[old, x]
        for x in range(len(columns)):
            total = 0.0
            for old in range(first_columns[x], first_columns[x] + num_columns[x]):
                total += columns[x, old] * line[old]
            averaged[y, x] = max(total, 0.0)
    return averaged


def _overlap(old: int, new: int) -> np.ndarray:
    """Return weights (new, old), the share of each old pixel in each new one; rows sum to 1."""
    edges = np.arange(new + 1)[:, None] * (old / new)
    filled = np.clip(edges - np.arange(old)[None, :], 0.0, 1.0)  # part of each old pixel before an edge
    weights = np.diff(filled, axis=0)
    return weights / weights.sum(axis=1, keepdims=True)
