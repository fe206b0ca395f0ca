"""From the values of pictures to linear light on the pixels of a camera."""

from collections.abc import Callable
from functools import cache
from typing import Literal

import numpy as np

from envs.config import LUMINANCE_FLOOR

Transfer = Literal["srgb", "linear"]
TRANSFERS = ("srgb", "linear")
LUMA = np.array([0.2126, 0.7152, 0.0722], np.float32)  # Rec. 709: luminance of linear R, G, B
FLOOR_LEVELS = 10  # grey levels below which a linear scale is too coarse for relative changes


def usual_transfer(dtype: np.dtype) -> Transfer:
    """How values become light where nobody says: whole numbers are sRGB, floating point is linear."""
    return "linear" if dtype.kind == "f" else "srgb"


def usual_floor(dtype: np.dtype, transfer: Transfer) -> float:
    """The luminance floor that is right for pictures of a dtype (docs/camera.md).

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
    return light @ LUMA if values.ndim == 3 else light


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
    """A function that averages a picture onto larger (or finer) pixels by the area they share.

    Args:
        from_shape: Rows and columns of the picture.
        to_shape: Rows and columns of the result.

    Returns:
        A function from float32 `from_shape` to float32 `to_shape`. It keeps the mean, and a
        picture of `to_shape` as it is.
    """
    if from_shape == to_shape:
        return np.ascontiguousarray
    rows, columns = (
        _overlap(old, new).astype(np.float32) for old, new in zip(from_shape, to_shape, strict=True)
    )
    return lambda picture: np.clip(rows @ picture @ columns.T, 0.0, None)


def _overlap(old: int, new: int) -> np.ndarray:
    """Weights (new, old): the share of each old pixel in each new one; rows sum to 1."""
    edges = np.arange(new + 1)[:, None] * (old / new)
    filled = np.clip(edges - np.arange(old)[None, :], 0.0, 1.0)  # how much of each lies before an edge
    weights = np.diff(filled, axis=0)
    return weights / weights.sum(axis=1, keepdims=True)
