"""The type of an obstacle's shape: the bodies that stand at one place of a layout."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np


def one_body(places: np.ndarray) -> np.ndarray:
    """Return the drawn places unchanged: a single body of the shape's kind at each place."""
    return places


class Shape(NamedTuple):
    """A shape of obstacle, composed of bodies that both renderers draw and that collisions handle.

    Attributes:
        kind: The kind of body that stands at each place before `compose`: POLE, CONE, ELLIPSOID or BOX.
        compose: Returns the (M,) OBSTACLE that stand at (N,) places, place by place. A place is a drawn
            OBSTACLE on the ground: rx = ry is the layout's radius, 2 * rz its height.
        bar_m: Width along x of the parts outside the radius [m].
        half_y_m: Returns the half-size along y [m] of a shape of radius `radius_m`; 0 if round.
        min_height_m: The layout's height must exceed this [m].
    """

    kind: int
    compose: Callable[[np.ndarray], np.ndarray] = one_body
    bar_m: float = 0.0
    half_y_m: Callable[[float], float] = lambda radius_m: 0.0
    min_height_m: float = 0.0
