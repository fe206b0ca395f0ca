"""Ray caster for bodies, walls and ground: exact anti-aliasing, float32 linear luminance.

The camera only yaws, so one image column is one horizontal direction and every body covers
an interval of its rows, known in closed form. A column is therefore composed exactly, from
near to far. Pixel columns are cut at each silhouette; the pixel is the mean over its area (a
box filter), exact in v, and in u for straight edges and for the arcs of round outlines up to
their curvature within a strip. Textures are averaged over the footprint of each row of a strip.

Rules where geometry leaves a choice: what is seen from behind is invisible (a body from its
inside, a wall from within its plane); bodies do not overlap, though one may float over
another.
"""

import math

import numba
import numpy as np

from envs.checks import LIMIT_M, LIMIT_S, check_image, check_pose
from envs.raycast import coverage as spans
from envs.raycast.columns import render_area
from envs.raycast.point_samples import shade_hits, trace_scene
from envs.scene import CONE, ELLIPSOID, Scene
from envs.scene.textures import NOISE, PATTERNS, around, noise_stack

NO_STACKS = np.zeros(1, np.float32)


def check_scene(scene: Scene) -> None:
    """ValueError if the scene holds a mesh, which only pyrender draws."""
    if scene.mesh is not None:
        raise ValueError("raycast draws no meshes, and the scene has one; use pyrender")


def make_bodies(scene: Scene) -> np.ndarray:
    """(M, 9) float64 what stands above the ground of the obstacles, as `envs.raycast.bodies` reads them."""
    o = scene.obstacles[scene.obstacles["z"] + scene.obstacles["rz"] > 0.0]
    turns = [around(scene.obstacle_texture, radius) for radius in o["rx"].tolist()]
    bottom, top, radius = o["z"] - o["rz"], o["z"] + o["rz"], o["rx"].copy()
    sunk = (bottom < 0.0) & (o["kind"] != ELLIPSOID)
    cut = sunk & (o["kind"] == CONE)
    radius[cut] *= (top / (top - bottom))[cut]
    bottom[sunk] = 0.0
    columns = (o["kind"], o["x"], o["y"], bottom, top, radius, o["ry"], o["albedo"], turns)
    return np.ascontiguousarray(np.stack(columns, axis=1), np.float64)


def make_textures(scene: Scene) -> tuple[list[float], np.ndarray]:
    """The textures of ground, walls and obstacles, six numbers each, and the stacks of the noisy ones."""
    numbers: list[float] = []
    stacks: list[np.ndarray] = []
    for texture in (scene.ground_texture, scene.wall_texture, scene.obstacle_texture):
        contrast = 0.0 if texture.plain else texture.contrast
        kind = PATTERNS.index(texture.pattern)
        numbers += [kind, 1.0 / texture.period_m, contrast, *texture.velocity_mps, len(stacks)]
        if kind == NOISE and not texture.plain:
            stacks.append(noise_stack(texture.seed).ravel())
    return numbers, np.concatenate(stacks) if stacks else NO_STACKS


def make_view(scene: Scene, textures: list[float]) -> np.ndarray:
    """(VIEW,) float64 what the kernels need of the scene; a frame fills in the rest."""
    view = np.zeros(spans.VIEW)
    faces = ((0, 0, 1), (0, 0, -1), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0))
    tops = (scene.obstacles["z"] + scene.obstacles["rz"]).tolist()
    view[spans.SKY : spans.SUN_Z + 1] = (
        scene.sky_luminance,
        float(scene.shade(scene.ground_albedo, faces[0])),
        max([scene.wall_height_m, *tops]),
        0.5 * scene.width_m,
        scene.wall_height_m,
        *scene.walls_y_m,
        scene.wall_albedo,
        scene.ambient,
        scene.diffuse,
        *scene.sun,
    )
    view[spans.LIT_UP : spans.GROUND] = scene.shade(np.ones(6), np.array(faces, np.float64))
    view[spans.GROUND :] = textures
    return view


def focal_length(width: int, fov_deg: float) -> float:
    """Focal length [pixels] of `width` square pixels that `fov_deg` spans."""
    return 0.5 * width / math.tan(0.5 * math.radians(fov_deg))


class RaycastRenderer:
    """Renders one scene after the other; holds no state but the scene and the image's geometry."""

    def __init__(
        self,
        scene: Scene,
        width: int,
        height: int,
        fov_deg: float = 90.0,
        samples: int = 1,
        cull_m: float = math.inf,
    ) -> None:
        """Renderer of `width` x `height` square pixels with a horizontal field of view of `fov_deg`.

        Args:
            scene: What to draw.
            width: Columns of the image.
            height: Rows of the image.
            fov_deg: Horizontal field of view [degrees].
            samples: Strips into which each column of pixels is cut, besides the cuts at
                silhouettes.
            cull_m: Bodies whose nearest point is farther than this are not drawn [m].

        Raises:
            ValueError: If a size is not at least 1, fov_deg not in [1, 170], cull_m not
                positive, or the scene holds what this renderer cannot draw.
        """
        check_image(width, height, fov_deg, samples)
        if not cull_m > 0.0:
            raise ValueError(f"cull_m must be > 0 m (inf: draw all); got {cull_m!r}.")
        self.width, self.height, self.fov_deg, self.samples = width, height, fov_deg, samples
        self.cull_m = float(cull_m)
        self.set_scene(scene)

    def set_scene(self, scene: Scene) -> None:
        """Draw `scene` from now on. Raises ValueError if it holds what this renderer cannot draw."""
        check_scene(scene)
        textures, stacks = make_textures(scene)
        self._scene, self._view = (make_bodies(scene), stacks), make_view(scene, textures)
        self._focal = focal_length(self.width, self.fov_deg)

    def render(
        self, x_m: float, y_m: float, z_m: float, yaw_rad: float = 0.0, t_s: float = 0.0
    ) -> np.ndarray:
        """The image seen from a pose, as a fresh array.

        Args:
            x_m: Position of the camera to the right [m].
            y_m: Position forward [m].
            z_m: Height above the ground [m], >= 0.
            yaw_rad: Heading, 0 along +y, counter-clockwise seen from above [rad].
            t_s: Time [s], which moves the textures; finite.

        Returns:
            (height, width) float32 linear luminance, row 0 on top.

        Raises:
            ValueError: If the pose or time is not finite, or the pose below the ground or
                farther than 1000 km.
        """
        return self.render_way(np.array([[x_m, y_m, z_m, yaw_rad, t_s]], np.float64))[0]

    def render_way(self, poses: np.ndarray) -> np.ndarray:
        """The images seen one after the other along a way, in one call.

        Args:
            poses: float64 (K, 5), of each image what `render` takes: x, y, z [m], yaw [rad]
                and time [s].

        Returns:
            (K, height, width) float32 linear luminance.

        Raises:
            ValueError: As `render`, for the first pose that is refused.
        """
        images = np.empty((len(poses), self.height, self.width), np.float32)
        bad = _render_way(self._scene, self._view, poses, self._focal, images, self.samples, self.cull_m)
        if bad >= 0:
            x_m, y_m, z_m, yaw_rad, t_s = poses[bad].tolist()
            check_pose((x_m, y_m, z_m, yaw_rad), t_s)
        return images


@numba.njit(cache=True, error_model="numpy")
def _render_way(
    scene: tuple,
    view: np.ndarray,
    poses: np.ndarray,
    focal: float,
    images: np.ndarray,
    samples: int,
    cull: float,
) -> int:
    """Fill `images` (K, H, W); the index of the first pose that `check_pose` would refuse, or -1."""
    for k in range(len(poses)):
        x, y, z, yaw, t = poses[k]
        near = abs(x) <= LIMIT_M and abs(y) <= LIMIT_M and 0.0 <= z <= LIMIT_M
        if not (near and abs(yaw) < np.inf and abs(t) <= LIMIT_S):
            return k
        render_area(scene, view, (x, y, z, yaw, t), focal, images[k], samples, cull)
    return -1


def sample_luminance(
    scene: Scene,
    pose: tuple[float, float, float, float],
    width: int,
    height: int,
    fov_deg: float = 90.0,
    samples: int = 1,
    t_s: float = 0.0,
) -> np.ndarray:
    """Mean of samples x samples point samples per pixel, without anti-aliasing; 1: pixel centres.

    Args and result as for `RaycastRenderer.render`, with `pose` = (x, y, z [m], yaw [rad]).
    What any rasteriser computes at the same points, and the limit the exact image must agree
    with; each ray is intersected with each body, by code that shares nothing with it.
    """
    check_image(width, height, fov_deg, samples)
    check_pose(pose, t_s)
    check_scene(scene)
    focal = focal_length(width * samples, fov_deg)
    points = shade_hits(scene, trace_scene(scene, pose, width * samples, height * samples, focal), t_s)
    return points.reshape(height, samples, width, samples).mean(axis=(1, 3)).astype(np.float32)
