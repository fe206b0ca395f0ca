"""Trees: an ellipsoidal crown on a thin trunk."""

import numpy as np

from envs.scene.obstacles import ELLIPSOID, POLE
from envs.scene.shapes.shape import Shape

TRUNK_SHARE = 0.25  # of the crown's radius, and of the tree's height below the crown


def compose_trees(places: np.ndarray) -> np.ndarray:
    """Return trunks and crowns, (2 N,) OBSTACLE; the crown has the layout's radius and rests on the trunk."""
    parts = np.tile(places, (2, 1))
    trunk, crown = parts
    trunk["kind"] = POLE
    for name in ("rx", "ry", "rz", "z"):
        trunk[name] *= TRUNK_SHARE
    crown["rz"] *= 1.0 - TRUNK_SHARE
    crown["z"] = 2.0 * places["rz"] - crown["rz"]
    return parts.T.ravel()


TREES = Shape(ELLIPSOID, compose_trees)
