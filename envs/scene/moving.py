"""Bodies that move: straight from place to place, at constant speed between two places.

Two places and their times are a velocity and an interval; a list of them is a recorded path. A body rests at
its first place before the path begins, and at its last place when the path is over; a path that repeats
begins again there. Bodies never turn.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from envs.scene.obstacles import OBSTACLE


@dataclass(frozen=True, eq=False)
class MovingBody:
    """A body on its path; ValueError names the rule that it breaks.

    Attributes:
        body: OBSTACLE (), what moves; the path stands for its x, y and z.
        t_s: float64 (K,), when it is at each place, ascending from 0 or later [s].
        places_m: float64 (K, 3), x, y, z of its centre [m].
        repeats: Whether the path begins again when it is over.
    """

    body: np.void
    t_s: np.ndarray
    places_m: np.ndarray
    repeats: bool = False

    def __post_init__(self) -> None:
        """Store read-only copies of the arrays."""
        times, places = np.array(self.t_s, np.float64), np.array(self.places_m, np.float64)
        if getattr(self.body, "dtype", None) != OBSTACLE or np.shape(self.body) != ():
            raise ValueError(f"body of a moving body must be one scene.OBSTACLE, got {self.body!r:.80}")
        if times.ndim != 1 or not times.size or places.shape != (times.size, 3):
            shapes = f"{times.shape} and {places.shape}"
            raise ValueError(f"t_s and places_m of a moving body must be (K,) and (K, 3), got {shapes}")
        if not (np.isfinite(times).all() and times[0] >= 0.0 and (np.diff(times) > 0.0).all()):
            raise ValueError(f"t_s of a moving body must be >= 0 and ascend, got {times}")
        if not np.isfinite(places).all():
            raise ValueError("places_m of a moving body must be finite, got NaN or infinity")
        for name, array in (("t_s", times), ("places_m", places)):
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    def place(self, t_s: float) -> np.ndarray:
        """Return where its centre is at a time [s]: x, y, z [m], float64 (3,)."""
        first, last = self.t_s[0], self.t_s[-1]
        if self.repeats and t_s > last > first:
            t_s = first + (t_s - first) % (last - first)
        return np.array([np.interp(t_s, self.t_s, axis) for axis in self.places_m.T])


def at_velocity(
    body: np.void, velocity_mps: Sequence[float], begin_s: float = 0.0, end_s: float = 1e4
) -> MovingBody:
    """Return a body that moves from its own place at a velocity (x, y, z) from `begin_s` to `end_s`.

    Raises:
        ValueError: The interval is empty, or a number is not finite.
    """
    start = np.array([body["x"], body["y"], body["z"]], np.float64)
    end = start + (end_s - begin_s) * np.asarray(velocity_mps, np.float64)
    return MovingBody(body, np.array([begin_s, end_s]), np.stack([start, end]))


def bodies_at(moving: Sequence[MovingBody], t_s: float) -> np.ndarray:
    """Return the bodies (M,) OBSTACLE at their places at a time [s]."""
    bodies = np.array([one.body for one in moving], OBSTACLE)
    for k, one in enumerate(moving):
        bodies["x"][k], bodies["y"][k], bodies["z"][k] = one.place(t_s)
    return bodies
