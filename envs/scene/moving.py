"""Bodies that move: straight from place to place, at constant speed between two places.

A path is a list of places with their times: two give a constant velocity over an interval, many a recorded
path. A body rests at its first place until the path begins. When the path is over, the body rests at the last
place, or starts the path again if it repeats. Bodies never turn.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from envs.scene.obstacles import OBSTACLE

THROWN_S = 30.0  # flight time of a thrown ball


@dataclass(frozen=True, eq=False)
class MovingBody:
    """A body on its path; ValueError names the broken rule.

    Attributes:
        body: OBSTACLE (), the moving body; the path replaces its x, y and z.
        t_s: float64 (K,), time at each place, ascending, >= 0 [s].
        places_m: float64 (K, 3), x, y, z of the body's centre [m].
        repeats: Whether the path starts again when it is over.
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

    def places(self, t_s: np.ndarray) -> np.ndarray:
        """Return the body's centre at times (T,) [s]: x, y, z [m], float64 (T, 3)."""
        first, last = self.t_s[0], self.t_s[-1]
        if self.repeats and last > first:
            t_s = np.where(t_s > last, first + (t_s - first) % (last - first), t_s)
        return np.stack([np.interp(t_s, self.t_s, axis) for axis in self.places_m.T], axis=-1)


class Throw(NamedTuple):
    """A ball that is thrown at the vehicle.

    Attributes:
        t_s: Time of the throw [s]; the ball starts with the first control step at or after it.
        bearing_rad: Bearing that it comes from, to the right of straight ahead [rad].
        speed_mps: Closing speed for a vehicle at constant velocity [m/s].
    """

    t_s: float
    bearing_rad: float
    speed_mps: float


class Throws(NamedTuple):
    """The throws of an episode, one after the other, all with the same ball.

    Attributes:
        ball: OBSTACLE (), an ellipsoid.
        distance_m: Distance from the vehicle at which each throw starts [m].
        throws: The throws in the order of time.
    """

    ball: np.void
    distance_m: float
    throws: tuple[Throw, ...]

    def waiting(self) -> MovingBody:
        """Return the ball before the first throw: behind the start, where no camera looks."""
        return MovingBody(self.ball, np.zeros(1), np.array([[0.0, -1e4, float(self.ball["z"])]]))

    def thrown(self, number: int, t_s: float, state: tuple[float, float, float, float]) -> MovingBody:
        """Return the ball thrown at time `t_s` [s] at a vehicle of `state` x, y [m], vx, vy [m/s].

        It hits the centre of a vehicle at constant velocity, and flies on.
        """
        _, bearing_rad, speed_mps = self.throws[number]
        x_m, y_m, vx_mps, vy_mps = state
        right, ahead = math.sin(bearing_rad), math.cos(bearing_rad)
        ball = self.ball.copy()
        ball["x"], ball["y"] = x_m + self.distance_m * right, y_m + self.distance_m * ahead
        velocity = vx_mps - speed_mps * right, vy_mps - speed_mps * ahead, 0.0
        return at_velocity(ball, velocity, t_s, t_s + THROWN_S)


def at_velocity(
    body: np.void, velocity_mps: Sequence[float], begin_s: float = 0.0, end_s: float = 1e4
) -> MovingBody:
    """Return a body that moves from its place at a velocity (x, y, z) [m/s] from `begin_s` to `end_s` [s].

    Raises:
        ValueError: The interval is empty, or a number is not finite.
    """
    start = np.array([body["x"], body["y"], body["z"]], np.float64)
    end = start + (end_s - begin_s) * np.asarray(velocity_mps, np.float64)
    return MovingBody(body, np.array([begin_s, end_s]), np.stack([start, end]))
