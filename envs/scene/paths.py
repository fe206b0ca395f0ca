"""Places of moving bodies at a time, and their sections at a height.

This is separate from `envs.scene.moving` because numba is slow to load, and checking a layout does not need
it.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numba
import numpy as np

from envs.scene.moving import MovingBody
from envs.scene.obstacles import OBSTACLE, body_sections

NOWHERE = (1e9, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # a moving section that nothing touches


def bodies_at(moving: Sequence[MovingBody], t_s: float) -> np.ndarray:
    """Return the bodies (M,) OBSTACLE at their places at a time [s]."""
    if not moving:
        return np.empty(0, OBSTACLE)
    standing, paths = _paths(tuple(moving))
    bodies, places = standing.copy(), np.empty((len(standing), 3))
    _find_places(paths, float(t_s), places)
    bodies["x"], bodies["y"], bodies["z"] = places.T
    return bodies


class Paths(NamedTuple):
    """The paths of M bodies, one after the other.

    Attributes:
        t_s: Times, float64 (P,).
        places_m: x, y, z at these times, float64 (P, 3).
        begins: int64 (M + 1,), index at which each path begins, and the end of the last path.
        repeats: Whether each path repeats, bool (M,).
    """

    t_s: np.ndarray
    places_m: np.ndarray
    begins: np.ndarray
    repeats: np.ndarray


@lru_cache(maxsize=64)
def _paths(moving: tuple[MovingBody, ...]) -> tuple[np.ndarray, Paths]:
    """Return bodies (M,) OBSTACLE and their paths; both are cached, so do not change them."""
    times, places = [one.t_s for one in moving], [one.places_m for one in moving]
    begins = np.cumsum([0, *map(len, times)])
    repeats = np.array([one.repeats for one in moving])
    bodies = np.array([one.body for one in moving], OBSTACLE)
    return bodies, Paths(np.concatenate(times), np.concatenate(places), begins, repeats)


@numba.njit(cache=True, error_model="numpy")
def _find_places(paths: Paths, t_s: float, places: np.ndarray) -> None:
    """Write the place of each body at a time, (M, 3), the same bytes as `MovingBody.places` returns."""
    for k in range(len(places)):
        times, own = paths.t_s[paths.begins[k] : paths.begins[k + 1]], paths.places_m[paths.begins[k] :]
        first, last, now = times[0], times[-1], t_s
        if paths.repeats[k] and last > first and now > last:
            now = first + (now - first) % (last - first)
        j = int(np.searchsorted(times, now, side="right")) - 1
        for axis in range(3):
            if j < 0 or j == len(times) - 1 or times[j] == now:
                places[k, axis] = own[max(j, 0), axis]
            else:
                slope = (own[j + 1, axis] - own[j, axis]) / (times[j + 1] - times[j])
                places[k, axis] = slope * (now - times[j]) + own[j, axis]


def moving_sections(
    moving: Sequence[MovingBody], start_s: float, end_s: float, height_m: float, found: np.ndarray
) -> None:
    """Write the sections of moving bodies at a height, and their displacements between two times.

    If a body climbs or sinks, its section is taken half-way in time.

    Args:
        moving: M bodies.
        start_s: Time of the sections' positions [s].
        end_s: Time at the end of the displacement [s].
        height_m: Height of the vehicle [m].
        found: float64 (M, 9), filled with sections as in `envs.scene.obstacles` and displacements x, y [m].
    """
    before, after = bodies_at(moving, start_s), bodies_at(moving, end_s)
    level = before.copy()
    level["z"] = 0.5 * (before["z"] + after["z"])
    there = (height_m - (level["z"] - level["rz"]) >= 0.0) & ((level["z"] + level["rz"]) - height_m >= 0.0)
    found[:] = NOWHERE
    found[there, :7] = body_sections(level[there], height_m)
    found[there, 7], found[there, 8] = (after[axis][there] - before[axis][there] for axis in "xy")
