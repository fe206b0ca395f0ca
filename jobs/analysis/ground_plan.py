"""Obstacles seen from above, as circles and rectangles for drawings."""

import numpy as np

from envs.scene import Scene


def ground_plan(scene: Scene, height_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the obstacles that a vehicle at a height can hit, without the walls.

    Args:
        scene: The corridor.
        height_m: Height of the vehicle above the ground [m].

    Returns:
        Circles as rows x, y, radius (C, 3) [m]; corners x, y of rectangles (R, 4, 2) [m].
    """
    sections = scene.sections(height_m)
    round_ = (sections[:, 4] == 0.0) & (sections[:, 5] == 0.0)
    x, y, ux, uy, hx, hy = sections[~round_, :6].T
    corners = [
        np.stack((x + a * hx * ux - b * hy * uy, y + a * hx * uy + b * hy * ux), axis=1)
        for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    return sections[round_][:, [0, 1, 6]], np.stack(corners, axis=1)
