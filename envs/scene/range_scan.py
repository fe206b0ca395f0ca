"""Range scan: proximity of the first obstacle in each direction, the ground truth of probes.

A ray is the path of a point that ends at its first contact with a section (`envs.scene.collision`).
It is exact for every kind of body and for meshes.
"""

import math

import numba
import numpy as np

from envs.scene.collision import first_contact
from envs.scene.scene import Scene

MAX_RANGE_M = 100.0  # obstacles farther away count as none
RAYS = 8  # per sector: at 90 degrees and 24 sectors no pole of 0.2 m is missed at 20 m
NEAR_M = 10.0  # proximity falls by a factor e over this distance: half a second of flight at 20 m/s


def proximity(scene: Scene, pose: tuple[float, float, float, float], bearings_rad: np.ndarray) -> np.ndarray:
    """Return the proximity of the first obstacle in each bearing: exp(-distance / NEAR_M), 0 if none.

    The exponential is in [0, 1] and gives distant obstacles little weight: at 30 m it is 0.05, whereas
    1 / (1 + distance / 5 m) is still 0.14.

    Args:
        scene: The corridor; its walls do not count as obstacles here.
        pose: x, y, z [m] and yaw [rad], as `CorridorEnv.camera_pose` returns; rays are level, at height z.
        bearings_rad: (K,) bearings, to the right of straight ahead [rad].

    Returns:
        float64 (K,) in [0, 1]; 1 inside an obstacle.

    Raises:
        ValueError: A number of the pose or a bearing is not finite.
    """
    bearings = np.asarray(bearings_rad, np.float64)
    if not (np.isfinite(pose).all() and np.isfinite(bearings).all()):
        raise ValueError(f"pose and bearings must be finite, got {pose} and {bearings_rad}")
    x, y, z, yaw = pose
    return _proximity((float(x), float(y)), bearings - yaw, scene.sections(z))


def sector_proximity(
    scene: Scene, pose: tuple[float, float, float, float], fov_deg: float, sectors: int
) -> np.ndarray:
    """Return the proximity of the nearest obstacle in equal sectors of the field of view, from left to right.

    Args:
        scene: As for `proximity`.
        pose: As for `proximity`.
        fov_deg: Horizontal field of view [degrees].
        sectors: Number of sectors.

    Returns:
        float64 (sectors,) in [0, 1], from `RAYS` rays in each.
    """
    bearings = sector_bearings(fov_deg, sectors, RAYS)
    return proximity(scene, pose, bearings.ravel()).reshape(bearings.shape).max(axis=1)


def sector_bearings(fov_deg: float, sectors: int, rays: int = 1) -> np.ndarray:
    """Return the bearings of rays spread evenly over sectors of the field of view, from left to right.

    Args:
        fov_deg: Horizontal field of view [degrees].
        sectors: Number of equal parts of the field of view.
        rays: Number of rays in each sector, each in the middle of its share.

    Returns:
        float64 (sectors, rays) [rad].
    """
    count = sectors * rays
    share = (np.arange(count) + 0.5) / count - 0.5
    return np.radians(fov_deg * share).reshape(sectors, rays)


@numba.njit(cache=True, error_model="numpy")
def _proximity(eye: tuple, headings: np.ndarray, sections: np.ndarray) -> np.ndarray:
    near = np.zeros(len(headings))
    x, y = eye
    for k in range(len(headings)):
        end = x + MAX_RANGE_M * math.sin(headings[k]), y + MAX_RANGE_M * math.cos(headings[k])
        contact = first_contact((x, y, end[0], end[1]), 0.0, math.inf, sections)
        if contact <= 1.0:
            near[k] = math.exp(-contact * MAX_RANGE_M / NEAR_M)
    return near
