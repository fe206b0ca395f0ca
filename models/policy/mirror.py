"""Exchange left and right in a policy's observations, for a second training sample of each step.

The sun of the world is always on the right, so a mirrored sample shows it on the left, where it never is.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from models.kinds import PolicySpec


def mirror(observations: Any, spec: PolicySpec) -> Any:
    """Return observations with left and right exchanged.

    Args:
        observations: B packed windows, of equal or different lengths, or pictures (B, H, W) or (B, H, W, 1).
        spec: The policy; its kind determines the type of observation.

    Returns:
        Copies in the same container and types.

    Raises:
        ValueError: There is no function in `MIRRORS` for the kind's observation.
    """
    name = spec.kind.observation
    if name not in MIRRORS:
        rule = f"must be one of {', '.join(MIRRORS)} to be mirrored"
        raise ValueError(f"{spec.model.name}: its observation {rule}, got {name!r}")
    return MIRRORS[name](observations, spec.width)


def _mirror_windows(windows: Any, width: int) -> Any:
    mirrored = tuple([window.copy() for window in windows])
    for window in mirrored:
        events = window[1 : 1 + int(window[0, 0])]
        events[:, 1] = width - 1 - events[:, 1]
    return np.stack(mirrored) if isinstance(windows, np.ndarray) else mirrored


def _mirror_pictures(pictures: np.ndarray, width: int) -> np.ndarray:
    return np.ascontiguousarray(pictures[:, :, ::-1])


MIRRORS: dict[str, Callable[[Any, int], Any]] = {
    "window": _mirror_windows,
    "event_image": _mirror_pictures,
    "luminance": _mirror_pictures,
}
