"""Trees: an ellipsoidal crown on a thin trunk."""

import numpy as np

from envs.scene.obstacles import ELLIPSOID, POLE
from envs.scene.shapes.shape import Shape

TRUNK_SHARE = 0.25  # trunk radius over crown radius, and trunk height over the tree's height


def compose_trees(places: np.ndarray) -> np.ndarray:
    """Return a trunk and a crown for each place, (2 N,) OBSTACLE; the crown has the layout's radius."""
    parts = np.tile(places, (2, 1))
    trunk, crown = parts
    trunk["kind"] = POLE
    for name in ("rx", "ry", "rz", "z"):
        trunk[name] *= TRUNK_SHARE
    crown["rz"] *= 1.0 - TRUNK_SHARE
    crown["z"] = 2.0 * places["rz"] - crown["rz"]
    return parts.T.ravel()


TREES = Shape(ELLIPSOID, compose_trees)
