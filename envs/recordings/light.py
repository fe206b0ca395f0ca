"""From the values of pictures to linear light on the pixels of a camera."""

from collections.abc import Callable
from functools import cache
from typing import Literal

import numba
import numpy as np

from envs.config import LUMINANCE_FLOOR

Transfer = Literal["srgb", "linear"]
TRANSFERS = ("srgb", "linear")
LUMA = np.array([0.2126, 0.7152, 0.0722], np.float32)  # Rec. 709: luminance of linear R, G, B
FLOOR_LEVELS = 10  # grey levels below which a linear scale is too coarse for relative changes


def usual_transfer(dtype: np.dtype) -> Transfer:
    """Choose the transfer function where none is stated: whole numbers are sRGB, floating point is linear."""
    return "linear" if dtype.kind == "f" else "srgb"


def usual_floor(dtype: np.dtype, transfer: Transfer) -> float:
    """Return the luminance floor that is right for pictures of a dtype (docs/camera.md).

    A linear scale of whole numbers shows nothing of relative changes below some grey levels, so the floor
    is ten of them: 10/255 for 8 bits. All other pictures get `LUMINANCE_FLOOR`, and none gets less.
    """
    if dtype.kind == "f" or transfer == "srgb":
        return LUMINANCE_FLOOR
    return max(LUMINANCE_FLOOR, FLOOR_LEVELS / np.iinfo(dtype).max)


def luminance(values: np.ndarray, transfer: Transfer) -> np.ndarray:
    """Linear light of a picture; white, the largest whole number, or 1.0 of floating point, is 1.

    Args:
        values: (H, W, 3) of R, G and B, or (H, W) of grey; uint8, uint16 or float32.
        transfer: "srgb": IEC 61966-2-1; "linear": in proportion to the values.

    Returns:
        float32 (H, W), >= 0: what is negative is black. Not finite where a value is not.
    """
    if values.dtype.kind == "u":
        light = light_of_grey(transfer, values.dtype.itemsize * 8)[values]
    else:
        light = np.where(np.isneginf(values), np.float32(np.nan), np.maximum(values, np.float32(0.0)))
        light = light if transfer == "linear" else _undo_srgb(light).astype(np.float32)
    if values.ndim == 2:
        return light
    red, green, blue = (light[..., k] * LUMA[k] for k in range(3))  # a matrix product rounds by its threads
    summed: np.ndarray = red + green + blue
    return summed


@cache
def light_of_grey(transfer: Transfer, bits: int = 8) -> np.ndarray:
    """Linear light in [0, 1], float32 (2**bits,), of each value of so many bits."""
    value = np.arange(1 << bits) / ((1 << bits) - 1.0)
    light = (_undo_srgb(value) if transfer == "srgb" else value).astype(np.float32)
    light.setflags(write=False)
    return light


def _undo_srgb(value: np.ndarray) -> np.ndarray:
    """Linear light of sRGB values >= 0; above white the curve goes on."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def area_average(
    from_shape: tuple[int, int], to_shape: tuple[int, int]
) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that averages a picture onto larger (or finer) pixels by the area they share.

    Args:
        from_shape: Rows and columns of the picture.
        to_shape: Rows and columns of the result.

    Returns:
        A function from float32 `from_shape` to float32 `to_shape`. It keeps the mean, and a
        picture of `to_shape` as it is.
    """
    if from_shape == to_shape:
        return np.ascontiguousarray
    rows, columns = (_overlap(old, new) for old, new in zip(from_shape, to_shape, strict=True))
    starts = [weights.argmax(axis=1) for weights in (rows > 0.0, columns > 0.0)]
    counts = [np.count_nonzero(weights, axis=1) for weights in (rows, columns)]
    return lambda picture: _averaged(picture, rows, columns, *starts, *counts)


@numba.njit(cache=True, error_model="numpy")
def _averaged(picture, rows, columns, first_rows, first_columns, num_rows, num_columns):
    """Average a picture, float32 (H, W), in float64 and in one order, so that threads change no byte.

    Args:
        picture: The picture.
        rows: Weights of its rows in each new row, see `_overlap`.
        columns: The same of columns.
        first_rows: Of each new row, the first old row with a weight above 0.
        first_columns: The same of columns.
        num_rows: Of each new row, how many old rows have a weight above 0.
        num_columns: The same of columns.
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
    """Weights (new, old): the share of each old pixel in each new one; rows sum to 1."""
    edges = np.arange(new + 1)[:, None] * (old / new)
    filled = np.clip(edges - np.arange(old)[None, :], 0.0, 1.0)  # how much of each lies before an edge
    weights = np.diff(filled, axis=0)
    return weights / weights.sum(axis=1, keepdims=True)
