"""Gates: a frame across the lane, from the ground up, that the vehicle flies through."""

import numpy as np

from envs.scene.obstacles import BOX
from envs.scene.shapes.shape import Shape

BAR_M = 0.4  # thickness of a gate's posts, lintel and sill


def compose_gates(openings: np.ndarray) -> np.ndarray:
    """Return left posts, right posts, lintels and sills, (4 N,) OBSTACLE, of openings of half-width rx."""
    bar = 0.5 * BAR_M
    parts = np.tile(openings, (4, 1))
    parts["ry"] = bar
    parts["x"][:2] += np.array([[-1.0], [1.0]]) * (openings["rx"] + bar)
    parts["rx"][:2] = bar
    parts["z"][2] = 2.0 * openings["rz"] - bar
    parts["z"][3] = parts["rz"][2:] = bar
    return parts.T.ravel()


GATES = Shape(BOX, compose_gates, BAR_M, lambda radius_m: 0.5 * BAR_M, 2.0 * BAR_M)
