"""Gates: frames across the lane that stand on the ground and that the vehicle flies through."""

import numpy as np

from envs.scene.obstacles import BOX
from envs.scene.shapes.shape import Shape

BAR_M = 0.4  # thickness of a gate's posts, lintel and sill


def compose_gates(openings: np.ndarray) -> np.ndarray:
    """Return the left post, right post, lintel and sill of each opening of half-width rx, (4 N,) OBSTACLE."""
    bar = 0.5 * BAR_M
    parts = np.tile(openings, (4, 1))
    parts["ry"] = bar
    parts["x"][:2] += np.array([[-1.0], [1.0]]) * (openings["rx"] + bar)
    parts["rx"][:2] = bar
    parts["z"][2] = 2.0 * openings["rz"] - bar
    parts["z"][3] = parts["rz"][2:] = bar
    return parts.T.ravel()


GATES = Shape(BOX, compose_gates, BAR_M, lambda radius_m: 0.5 * BAR_M, 2.0 * BAR_M)
