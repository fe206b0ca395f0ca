"""Ray caster for poles, walls and ground: exact anti-aliasing, float32 linear luminance.

The camera only yaws, so one image column is one horizontal direction, and all that stands
on the ground covers an interval of its rows. A column is therefore composed exactly, from
near to far, in one sweep from its bottom to the horizon. Pixel columns are cut at each
silhouette; the pixel is the mean over its area (a box filter), exact in v and across
silhouettes, by the midpoint rule between them.

Rules where geometry leaves a choice: what is seen from behind is invisible (a pole from
its inside, a wall from within its plane); from above, a pole shows its cap.
"""

import math

import numpy as np

from envs.columns import Camera, World, render_area, render_points
from envs.scene import POLE, Scene

KINDS = (POLE,)  # what this renderer can draw
LIMIT_M = 1e6


def make_world(scene: Scene) -> tuple[np.ndarray, World]:
    """The poles, (N, 6) float64 as `columns.see_poles` reads them, and the numbers of `scene`.

    Raises:
        ValueError: If an obstacle is of a kind that only a mesh can represent.
    """
    obstacles = scene.obstacles
    if not np.isin(obstacles["kind"], KINDS).all():
        raise ValueError(f"raycast draws kinds {KINDS}, got {set(obstacles['kind'].tolist())}; use pyrender")
    cap = scene.shade(obstacles["albedo"], (0.0, 0.0, 1.0))
    top = obstacles["z"] + obstacles["rz"]
    columns = (obstacles["x"], obstacles["y"], obstacles["rx"], top, obstacles["albedo"], cap)
    return np.ascontiguousarray(np.stack(columns, axis=1), np.float64), World(
        half_width=0.5 * scene.width_m,
        wall_height=float(scene.wall_height_m),
        walls_near=float(scene.walls_y_m[0]),
        walls_far=float(scene.walls_y_m[1]),
        wall_facing_right=float(scene.shade(scene.wall_albedo, (1.0, 0.0, 0.0))),
        wall_facing_left=float(scene.shade(scene.wall_albedo, (-1.0, 0.0, 0.0))),
        ground=float(scene.shade(scene.ground_albedo, (0.0, 0.0, 1.0))),
        sky=float(scene.sky_luminance),
        ambient=float(scene.ambient),
        diffuse=float(scene.diffuse),
        sun_x=float(scene.sun[0]),
        sun_y=float(scene.sun[1]),
    )


def make_camera(pose: tuple[float, float, float, float], width: int, height: int, fov_deg: float) -> Camera:
    """Camera at `pose` (x, y, z [m], yaw [rad]) with `fov_deg` across `width` square pixels."""
    check_pose(pose)
    x, y, z, yaw = pose
    focal = 0.5 * width / math.tan(0.5 * math.radians(fov_deg))
    return Camera(float(x), float(y), float(z), math.cos(yaw), math.sin(yaw), width, height, focal)


def check_image(width: int, height: int, fov_deg: float, samples: int) -> None:
    """ValueError unless width, height and samples are at least 1 and fov_deg is in [1, 170]."""
    if not (min(width, height, samples) >= 1 and 1.0 <= fov_deg <= 170.0):
        raise ValueError(
            "width, height and samples must be >= 1 and fov_deg in [1, 170], "
            f"got {width}, {height}, {samples}, {fov_deg}"
        )


def check_pose(pose: tuple[float, float, float, float]) -> None:
    """ValueError unless `pose` (x, y, z [m], yaw [rad]) is finite, above ground and within 1000 km."""
    x, y, z, yaw = pose
    if not (max(abs(x), abs(y), abs(z)) <= LIMIT_M and z >= 0.0 and math.isfinite(yaw)):
        raise ValueError(f"pose (x, y, z, yaw) must be finite, z >= 0 and within {LIMIT_M:g} m, got {pose}")


class RaycastRenderer:
    """Renders one scene after the other; holds no state but the scene and the image's geometry."""

    def __init__(
        self, scene: Scene, width: int, height: int, fov_deg: float = 90.0, samples: int = 2
    ) -> None:
        """Renderer of `width` x `height` square pixels with a horizontal field of view of `fov_deg`.

        Pixel columns are cut into `samples` sub-columns, besides the cuts at silhouettes.

        Raises:
            ValueError: If a size is not at least 1, fov_deg not in [1, 170], or the scene
                holds a kind this renderer cannot draw.
        """
        check_image(width, height, fov_deg, samples)
        self.width, self.height, self.fov_deg, self.samples = width, height, fov_deg, samples
        self.set_scene(scene)

    def set_scene(self, scene: Scene) -> None:
        """Draw `scene` from now on. Raises ValueError if it holds a kind this renderer cannot draw."""
        self._poles, self._world = make_world(scene)

    def render(
        self, x_m: float, y_m: float, z_m: float, yaw_rad: float = 0.0, t_s: float = 0.0
    ) -> np.ndarray:
        """The image seen from a pose, as a fresh array.

        Args:
            x_m: Position of the camera to the right [m].
            y_m: Position forward [m].
            z_m: Height above the ground [m], >= 0.
            yaw_rad: Heading, 0 along +y, counter-clockwise seen from above [rad].
            t_s: Time [s]; a still scene does not depend on it.

        Returns:
            (height, width) float32 linear luminance, row 0 on top.

        Raises:
            ValueError: If the pose is not finite, below the ground, or farther than 1000 km.
        """
        camera = make_camera((x_m, y_m, z_m, yaw_rad), self.width, self.height, self.fov_deg)
        return render_area(self._poles, self._world, camera, self.samples)


def sample_luminance(
    scene: Scene,
    pose: tuple[float, float, float, float],
    width: int,
    height: int,
    fov_deg: float = 90.0,
    samples: int = 1,
) -> np.ndarray:
    """Mean of samples x samples point samples per pixel, without anti-aliasing; 1: pixel centres.

    Args and result as for `RaycastRenderer.render`, with `pose` = (x, y, z [m], yaw [rad]).
    What any rasteriser computes at the same points, and the limit the exact image must agree with.
    """
    camera = make_camera(pose, width * samples, height * samples, fov_deg)
    points = render_points(*make_world(scene), camera).astype(np.float64)
    return points.reshape(height, samples, width, samples).mean(axis=(1, 3)).astype(np.float32)
