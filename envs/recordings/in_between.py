"""Interpolate frames between two frames by optical flow, which OpenCV computes (the extra `flow`).

The flow is dense inverse search (Kroeger et al. 2016, arXiv:1603.03590), from each frame to the other. For a
time between them, both frames are warped to that time and blended, by equations 1 and 4 of Super SloMo (Jiang
et al. 2018, arXiv:1712.00080), in log luminance, as the event camera sees it.
"""

from collections.abc import Iterator
from types import ModuleType

import numpy as np

SMALLEST = 32  # minimum rows and columns to compute the flow
MOST_PARTS = 16  # maximum number of intervals between two frames


def open_cv() -> ModuleType:
    """Import and return OpenCV, which no other module imports.

    Raises:
        ValueError: OpenCV is not installed.
    """
    try:
        import cv2
    except ImportError:
        raise ValueError("interpolate='flow' needs OpenCV; pip install opencv-python-headless") from None
    module: ModuleType = cv2
    return module


def frames_between(
    first: np.ndarray, second: np.ndarray, floor: float, most_parts: int = MOST_PARTS
) -> Iterator[tuple[float, np.ndarray]]:
    """Yield pictures between two frames, so many that few pixels move by more than a pixel per step.

    Args:
        first: float32 (H, W), linear luminance, 32 x 32 pixels or more.
        second: The next frame, in the same form.
        floor: Added to luminance before the logarithm.
        most_parts: Maximum number of intervals between the frames, at most 16.

    Yields:
        Fraction of the time between the frames, in (0, 1) and increasing, and the picture float32 (H, W) at
        that time; nothing if nothing moves.

    Raises:
        ValueError: OpenCV is not installed, or the pictures are too small.
    """
    cv = open_cv()
    if min(first.shape) < SMALLEST:
        raise ValueError(f"interpolate='flow' needs {SMALLEST} x {SMALLEST} pixels, got {first.shape[::-1]}")
    logs = np.log(np.stack((first, second)) + np.float32(floor))
    span = max(float(logs.max() - logs.min()), 1e-6)
    grey = np.rint(255.0 * (logs - logs.min()) / span).astype(np.uint8)
    search = cv.DISOpticalFlow_create(cv.DISOPTICAL_FLOW_PRESET_MEDIUM)
    there, back = search.calc(grey[0], grey[1], None), search.calc(grey[1], grey[0], None)
    moved = np.percentile(np.hypot(there[..., 0], there[..., 1]), 99)
    parts = int(np.clip(np.ceil(moved), 1, min(most_parts, MOST_PARTS)))
    places = np.stack(
        np.meshgrid(*(np.arange(size, dtype=np.float32) for size in first.shape[::-1])), axis=-1
    )
    for part in range(1, parts):
        share = np.float32(part / parts)
        to_first = (share - 1) * share * there + share * share * back
        to_second = (1 - share) * (1 - share) * there - share * (1 - share) * back
        early, late = (
            cv.remap(log, places + way, None, cv.INTER_LINEAR, borderMode=cv.BORDER_REPLICATE)
            for log, way in zip(logs, (to_first, to_second), strict=True)
        )
        light = np.exp((1 - share) * early + share * late) - np.float32(floor)
        yield part / parts, np.maximum(light, np.float32(0.0))
