"""Ray caster for bodies, walls and ground: exact anti-aliasing, float32 linear luminance.

The camera only yaws, so one image column is one horizontal direction and every body covers
an interval of its rows, known in closed form. A column is therefore composed exactly, from
near to far. Pixel columns are cut at each silhouette. A pixel is the mean over its area (a
box filter), exact in v, and in u exact for straight edges and for the arcs of round outlines up
to their curvature within a strip. Textures are averaged over the visible part of a surface in a row: per
strip for a body, per cell for the ground or a wall, per whole column for noise on the ground.

Surfaces are invisible from behind: a body from its inside, a wall from within its plane. Bodies
do not overlap, though one may float over another.
"""

import math
from collections.abc import Sequence

import numpy as np

from envs.checks import check_image, check_pose
from envs.raycast.columns import make_workspace, render_way
from envs.raycast.noise import NO_NOISE, tabulate_ground, waves_of
from envs.raycast.records import BODY, FRAME, Noise
from envs.scene import CONE, ELLIPSOID, MovingBody, Scene, Texture
from envs.scene.paths import bodies_at
from envs.scene.textures import PATTERNS, around


def _make_bodies(scene: Scene) -> np.ndarray:
    """Return the parts of obstacles above the ground, (M,) BODY; moving bodies come last."""
    o = scene.obstacles[scene.obstacles["z"] + scene.obstacles["rz"] > 0.0]
    o = np.concatenate([o, bodies_at(scene.movers, 0.0)]) if scene.movers else o
    bottom, top = o["z"] - o["rz"], o["z"] + o["rz"]
    sunk = (bottom < 0.0) & (o["kind"] != ELLIPSOID)
    cut = sunk & (o["kind"] == CONE)
    bodies = np.zeros(len(o), BODY)
    for name in ("kind", "x", "y", "rx", "ry", "albedo"):
        bodies[name] = o[name]
    bodies["rx"][cut] *= (top / (top - bottom))[cut]
    bodies["bottom"], bodies["top"] = np.where(sunk, 0.0, bottom), top
    bodies["turn"] = [around(scene.obstacle_texture, radius) for radius in o["rx"].tolist()]
    bodies["moves"][len(o) - len(scene.movers) :] = 1
    return bodies


def _make_frame(scene: Scene, height: int, focal: float, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a FRAME (1,) without the fields that depend on the pose, and the waves of the scene's noise."""
    frame = np.zeros(1, FRAME)
    faces = np.array([(0, 0, 1), (0, 0, -1), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)], np.float64)
    lit = scene.shade(np.ones(6), faces).tolist()
    frame["horizon"], frame["focal"], frame["samples"] = 0.5 * height, focal, samples
    frame["sky"], frame["floor"] = scene.sky_luminance, scene.shade(scene.ground_albedo, faces[0])
    tops = (scene.obstacles["z"] + scene.obstacles["rz"]).tolist()
    tops += [float(one.places_m[:, 2].max() + one.body["rz"]) for one in scene.movers]
    frame["tallest"] = max([scene.wall_height_m, *tops])
    frame["wall_half"], frame["wall_top"] = 0.5 * scene.width_m, scene.wall_height_m
    frame["wall_near"], frame["wall_far"] = scene.walls_y_m
    frame["wall_albedo"], frame["ambient"], frame["diffuse"] = scene.wall_albedo, scene.ambient, scene.diffuse
    frame["sun_x"], frame["sun_y"], frame["sun_z"] = scene.sun
    for side, light in zip(("up", "down", "east", "west", "north", "south"), lit, strict=True):
        frame[f"lit_{side}"] = light
    waves: list[np.ndarray] = []
    textures = {"ground": scene.ground_texture, "wall": scene.wall_texture, "body": scene.obstacle_texture}
    for name, texture in textures.items():
        frame[f"{name}_texture"] = _texture_record(texture, len(waves))
        if texture.pattern == "noise" and not texture.plain:
            waves.append(waves_of(texture.seed))
    return frame, np.stack(waves) if waves else NO_NOISE.waves


def _texture_record(texture: Texture, noise: int) -> tuple[float, ...]:
    """Return the values of a TEXTURE record; `noise` is the index of its waves, if it is noise."""
    kind = PATTERNS.index(texture.pattern)
    return (kind, 1.0 / texture.period_m, texture.depth, *texture.velocity_mps, noise)


def focal_length(width: int, fov_deg: float) -> float:
    """Return the focal length [pixels] of `width` square pixels that span `fov_deg`."""
    return 0.5 * width / math.tan(0.5 * math.radians(fov_deg))


class RaycastRenderer:
    """Renderer of one scene at a time; its only state is the scene and the shape of the image.

    Attributes:
        bodies: (N,) BODY, the obstacles, see `envs.raycast.records`.
        frame: (1,) FRAME without the fields that depend on the pose.
        noise: Noise textures of the scene.
        room: `envs.raycast.columns.Workspace` of this scene.
    """

    def __init__(
        self,
        scene: Scene,
        width: int,
        height: int,
        fov_deg: float = 90.0,
        samples: int = 1,
        cull_m: float = math.inf,
        discs: bool = False,
    ) -> None:
        """Make a renderer of `width` x `height` square pixels with a horizontal field of view of `fov_deg`.

        Args:
            scene: The scene to draw.
            width: Columns of the image.
            height: Rows of the image.
            fov_deg: Horizontal field of view [degrees].
            samples: Number of strips into which each column of pixels is cut, in addition to the
                cuts at silhouettes.
            cull_m: Bodies whose nearest point is farther than this are not drawn [m].
            discs: Whether `envs.raycast.discs` draws spheres pixel by pixel, in samples^2 parts of
                each pixel.

        Raises:
            ValueError: A size is not at least 1, fov_deg not in [1, 170], cull_m not
                positive, or the scene has something that this renderer cannot draw.
        """
        check_image(width, height, fov_deg, samples, cull_m)
        self.width, self.height, self.fov_deg, self.samples = width, height, fov_deg, samples
        self.cull_m, self.discs = float(cull_m), discs
        self.set_scene(scene)

    def set_scene(self, scene: Scene) -> None:
        """Draw `scene` from now on. Raises ValueError if it has something that this renderer cannot draw."""
        if scene.mesh is not None:
            raise ValueError("raycast draws no meshes, and the scene has one; use pyrender")
        self.bodies = _make_bodies(scene)
        focal = focal_length(self.width, self.fov_deg)
        self.frame, waves = _make_frame(scene, self.height, focal, self.samples)
        self.frame["discs"] = self.discs
        self.noise, self._ground_texture = Noise(waves, NO_NOISE.ground, 0.0), scene.ground_texture
        self.room = make_workspace(len(self.bodies), self.height)
        self._moving = scene.movers

    def move_bodies(self, moving: Sequence[MovingBody], start_s: float, end_s: float) -> None:
        """Move the moving bodies straight from their places at `start_s` to their places at `end_s`.

        Args:
            moving: The bodies with their paths, as many as the scene has.
            start_s: Time of their first places [s].
            end_s: Time of their last places [s]; equal to `start_s`: the bodies rest.
        """
        own = self.bodies[len(self.bodies) - len(moving) :]
        before, after = bodies_at(moving, start_s), bodies_at(moving, end_s)
        span_s = end_s - start_s
        for axis in "xyz":
            own[f"v{axis}"] = (after[axis] - before[axis]) / span_s if span_s > 0.0 else 0.0
        own["x"], own["y"], own["since"] = before["x"], before["y"], start_s
        own["bottom"], own["top"] = before["z"] - before["rz"], before["z"] + before["rz"]
        own["bottom"][own["kind"] != ELLIPSOID] = own["bottom"][own["kind"] != ELLIPSOID].clip(0.0)

    def expect_height(self, eye_m: float) -> None:
        """Prepare for a camera at height `eye_m` [m] that looks along +y: noise on the ground is then cheap.

        Other poses are rendered as without this call. In both cases the noise of the ground is accurate to a
        fiftieth of its amplitude (tests/envs/raycast/test_noise.py).

        Raises:
            ValueError: The height is not finite or negative.
        """
        if not 0.0 <= eye_m < math.inf:
            raise ValueError(f"eye_m must be finite and >= 0; got {eye_m!r}.")
        eye_m, texture = float(eye_m), self._ground_texture  # another type would recompile the kernels
        if texture.pattern == "noise" and not texture.plain:
            table = tabulate_ground(
                self.width, self.height, focal_length(self.width, self.fov_deg), eye_m, texture.period_m
            )
            self.noise = self.noise._replace(ground=table, height=eye_m)

    def render(
        self, x_m: float, y_m: float, z_m: float, yaw_rad: float = 0.0, t_s: float = 0.0
    ) -> np.ndarray:
        """Render the image seen from a pose, as a fresh array.

        Args:
            x_m: Position of the camera to the right [m].
            y_m: Position forward [m].
            z_m: Height above the ground [m], >= 0.
            yaw_rad: Heading, 0 along +y, counter-clockwise seen from above [rad].
            t_s: Time [s], which decides where textures and bodies are; finite.

        Returns:
            (height, width) float32 linear luminance, row 0 on top.

        Raises:
            ValueError: The pose or time is not finite, or the pose is below the ground or farther
                than 1000 km.
        """
        if self._moving and math.isfinite(t_s):
            self.move_bodies(self._moving, t_s, t_s)
        return self.render_way(np.array([[x_m, y_m, z_m, yaw_rad, t_s]], np.float64))[0]

    def render_way(self, poses: np.ndarray) -> np.ndarray:
        """Render the images along a way in one call; bodies move as in the last call of `move_bodies`.

        Args:
            poses: float64 (K, 5), the arguments of `render` for each image: x, y, z [m], yaw
                [rad] and time [s].

        Returns:
            (K, height, width) float32 linear luminance.

        Raises:
            ValueError: As for `render`, for the first invalid pose.
        """
        columns = np.empty((len(poses), self.width, self.height), np.float32)
        bad = render_way(self.bodies, self.noise, self.frame, poses, columns, self.cull_m, self.room)
        if bad >= 0:
            x_m, y_m, z_m, yaw_rad, t_s = poses[bad].tolist()
            check_pose((x_m, y_m, z_m, yaw_rad), t_s)
        return np.ascontiguousarray(columns.swapaxes(1, 2))
