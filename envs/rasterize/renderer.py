"""OpenGL renderer for every scene without moving bodies: same interface and luminance as the ray caster.

It uses headless EGL and one draw call per kind of surface with the shaders of `envs.rasterize.shaders`.
The image is read back from a 32-bit float framebuffer: linear, without gamma, not rounded to 8 bits.
pyrender only provides the OpenGL context; `envs.rasterize.context` replaces the rest of it. OpenGL is
imported when the first renderer is created. A renderer belongs to the process that created it; it may be
used from any thread, one at a time.

At the same sample points the picture equals `tests.support.point_samples`, except at edges, which a
rasteriser rounds to 1/256 pixel, and at the polygons that replace the rims of poles and the outlines of
ellipsoids. `envs.raycast.renderer` states which sides of a surface are visible.
"""

import contextlib
import math
import os
import sys
from typing import Any

import numpy as np

from envs.checks import check_image, check_pose
from envs.rasterize.primitives import Batch, Drawing, draw, repeat_m
from envs.rasterize.shaders import TEXTURE_OF
from envs.scene import BOX, Scene, Texture
from envs.scene.textures import PATTERNS

MIN_DEPTH_M = 0.02  # near plane; by GL_DEPTH_CLAMP nearer surfaces are drawn too
# The uniforms of a frame, as the shaders expect them in memory.
FRAME = np.dtype(
    [
        ("clip", "f4", (4, 4)),
        ("view", "f4", (4, 4)),
        ("camera", "f4", 4),
        ("lens", "f4", 4),
        ("sun", "f4", 4),
        ("lambert", "f4", 4),
        ("around", "f4", (3, 4)),
        ("moved", "f4", (3, 4)),
        ("looks", "f4", (3, 4)),
    ]
)
PACKAGES = "apt-get install --no-install-recommends libegl1 libgl1 libgl1-mesa-dri"


class PyrenderRenderer:
    """Renderer of one scene at a time; owns an OpenGL context until `close`."""

    def __init__(
        self,
        scene: Scene,
        width: int,
        height: int,
        fov_deg: float = 90.0,
        samples: int = 2,
        cull_m: float = math.inf,
    ) -> None:
        """Create a renderer of `width` x `height` pixels with a horizontal field of view of `fov_deg`.

        Args:
            scene: The scene to draw.
            width: Columns of the image.
            height: Rows of the image.
            fov_deg: Horizontal field of view [degrees]; pixels are square.
            samples: 1: one sample at each pixel centre, no anti-aliasing. n > 1: n x n
                sub-pixels of 4 multisamples each, averaged; 2 gives 16 samples per pixel at
                edges, and 4 inside surfaces, which matters for textures.
            cull_m: Obstacles are not drawn if their upright cylinder or box is farther away [m].

        Raises:
            ValueError: A size is not at least 1, fov_deg not in [1, 170], or cull_m not > 0.
            RuntimeError: EGL or a system library that it needs is missing; names the packages.
        """
        check_image(width, height, fov_deg, samples, cull_m)
        self.width, self.height, self.samples, self.cull_m = width, height, samples, cull_m
        self._platform, self._renderer = _start(width * samples, height * samples, samples > 1)
        self._slope = math.tan(0.5 * math.radians(fov_deg))
        from envs.rasterize.context import Camera

        self._camera = Camera(
            2.0 * math.atan(self._slope * height / width), MIN_DEPTH_M, aspectRatio=width / height
        )
        with self._platform.current():
            self._projection = self._camera.get_projection_matrix(width * samples, height * samples)
        self.set_scene(scene)

    def set_scene(self, scene: Scene) -> None:
        """Draw `scene` from now on."""
        import pyrender

        drawing = draw(scene)
        self._world = pyrender.Scene()
        self._world.add(pyrender.Mesh([_primitive(drawing)]))
        self._node = self._world.add(self._camera, pose=np.eye(4))
        self._bodies, self._batches = scene.obstacles, drawing.batches
        self._textures = (scene.ground_texture, scene.wall_texture, scene.obstacle_texture)
        fine = 0.5 * self.samples * np.array([self.width, self.height])
        frame = np.zeros((), FRAME)
        frame["lens"][:3] = *fine, self._slope / fine[0]
        frame["sun"][:3] = scene.sun
        frame["lambert"][:2] = scene.ambient, scene.diffuse
        frame["looks"][:, :2] = [(1.0 / texture.period_m, texture.contrast) for texture in self._textures]
        self._renderer.frame = frame
        draws = [_draw(batch, self._textures) for batch in drawing.batches]
        with self._platform.current():
            self._renderer.use(draws, scene.sky_luminance)

    def render(
        self, x_m: float, y_m: float, z_m: float, yaw_rad: float = 0.0, t_s: float = 0.0
    ) -> np.ndarray:
        """Render the image seen from a pose, as a fresh array.

        Args:
            x_m: Position of the camera to the right [m].
            y_m: Position forward [m].
            z_m: Height above the ground [m], >= 0.
            yaw_rad: Heading, 0 along +y, counter-clockwise seen from above [rad].
            t_s: Time [s]; a still scene does not depend on it.

        Returns:
            (height, width) float32 linear luminance, row 0 on top.

        Raises:
            ValueError: The pose or the time is not finite or too large, or the pose is below the ground.
            RuntimeError: OpenGL fails, or the renderer was closed.
        """
        check_pose((x_m, y_m, z_m, yaw_rad), t_s)
        if self._renderer is None:
            raise RuntimeError("the renderer is closed; make a new PyrenderRenderer")
        import pyrender

        pose = _camera_pose(x_m, y_m, z_m, yaw_rad)
        self._world.set_pose(self._node, pose)
        self._set_frame(pose, t_s)
        if self.cull_m < math.inf:
            self._cull(pose[:3, 3])
        flags = pyrender.RenderFlags.FLAT | pyrender.RenderFlags.OFFSCREEN
        with self._platform.current():
            fine = self._renderer.render(self._world, flags)
        return _mean_of_blocks(fine, self.samples)[::-1].copy()

    def _set_frame(self, pose: np.ndarray, t_s: float) -> None:
        """Set the uniforms of a pose; subtract whole repeats of textures, so that float32 is enough."""
        frame = self._renderer.frame
        view = np.eye(4)
        view[:3, :3] = pose[:3, :3].T
        frame["view"], frame["clip"], frame["camera"][:3] = view, self._projection @ view, pose[:3, 3]
        for i, texture in enumerate(self._textures):
            if not texture.plain:
                repeat = repeat_m(texture)
                frame["around"][i, :3] = np.mod(pose[:3, 3], repeat)
                frame["moved"][i, :2] = [v * t_s % repeat for v in texture.velocity_mps]

    def _cull(self, eye_m: np.ndarray) -> None:
        """Draw only the obstacles within `cull_m`, and everything that is not an obstacle."""
        near = np.append(_distances(self._bodies, eye_m) <= self.cull_m, True)  # index -1: no obstacle
        for i, batch in enumerate(self._batches):
            self._renderer.draws[i] = self._renderer.draws[i]._replace(runs=_runs(batch, near))

    def render_way(self, poses: np.ndarray) -> np.ndarray:
        """Render images along a way, (K, height, width), like `RaycastRenderer.render_way`."""
        return np.stack([self.render(*pose) for pose in poses.tolist()])

    def close(self) -> None:
        """Free the OpenGL context, without effect on other renderers. Closing twice is allowed."""
        if getattr(self, "_renderer", None) is None:
            return
        with self._platform.current():
            self._renderer.delete()
        self._platform.delete_context()
        self._renderer = None

    def __del__(self) -> None:
        """Free the OpenGL context, ignoring errors."""
        with contextlib.suppress(Exception):
            self.close()


def _start(width: int, height: int, antialias: bool) -> tuple[Any, Any]:
    """Start the EGL platform and a renderer with a float framebuffer, or raise RuntimeError in one line."""
    os.environ["PYOPENGL_PLATFORM"] = "egl"
    os.environ.setdefault("PYGLET_HEADLESS", "1")
    # llvmpipe's own threads would make a forked child hang.
    os.environ.setdefault("LP_NUM_THREADS", "0")
    # pyrender still uses this name, which numpy 2 removed.
    if not hasattr(np, "infty"):
        np.infty = np.inf  # type: ignore[attr-defined]  # noqa: NPY201
    try:
        from envs.rasterize.context import start

        return start(width, height, antialias)
    except Exception as error:  # every missing library fails in its own way: ImportError, AttributeError, ...
        reason = " ".join(str(error).split())[:200]
        cause = f"{type(error).__name__}: {reason}"
        remedy = f"try: {PACKAGES}" if sys.platform == "linux" else "EGL is for Linux; use renderer=raycast"
        raise RuntimeError(f"pyrender cannot use EGL ({cause}); {remedy}") from None


def _distances(bodies: np.ndarray, eye_m: np.ndarray) -> np.ndarray:
    """Return the distance from `eye_m` to each obstacle's upright cylinder or box, (N,) [m]."""
    aside = np.stack([bodies["x"], bodies["y"], bodies["z"]], axis=1) - eye_m
    x, y, z = (np.abs(aside) - np.stack([bodies["rx"], bodies["ry"], bodies["rz"]], axis=1)).T
    square = np.hypot(np.maximum(x, 0.0), np.maximum(y, 0.0))
    circle = np.maximum(np.hypot(aside[:, 0], aside[:, 1]) - bodies["rx"], 0.0)
    return np.hypot(np.where(bodies["kind"] == BOX, square, circle), np.maximum(z, 0.0))


def _primitive(drawing: Drawing) -> Any:
    """Return a scene as one primitive of pyrender with the attributes of `shaders.VERTEX`."""
    from pyrender import MetallicRoughnessMaterial, Primitive

    vertices = drawing.vertices
    return Primitive(
        positions=vertices["position"],
        normals=vertices["ring"],
        tangents=vertices["quadric"],
        texcoord_0=vertices["origin"],
        color_0=vertices["body"],
        indices=drawing.faces,
        material=MetallicRoughnessMaterial(alphaMode="OPAQUE"),
        mode=4,
    )


def _draw(batch: Batch, textures: tuple[Texture, ...]) -> Any:
    """Return the draw call of `batch`."""
    from envs.rasterize.context import Draw

    place = TEXTURE_OF[batch.surface]
    texture = Texture() if place is None or textures[place].plain else textures[place]
    noise = texture.seed if texture.pattern == "noise" else None
    return Draw((batch.surface, PATTERNS.index(texture.pattern)), batch.first[[0, -1]][None], noise)


def _runs(batch: Batch, near: np.ndarray) -> np.ndarray:
    """Return (R, 2), first and last + 1 face of each run of bodies that are `near`."""
    drawn = np.concatenate([[False], near[batch.bodies], [False]])
    return batch.first[np.flatnonzero(drawn[1:] != drawn[:-1]).reshape(-1, 2)]


def _mean_of_blocks(fine: np.ndarray, size: int) -> np.ndarray:
    """Return the (H, W) float32 mean over squares of `size` pixels of (H size, W size)."""
    if size == 1:
        return fine
    rows = fine[::size].copy()
    for i in range(1, size):
        rows += fine[i::size]
    total = rows[:, ::size].copy()
    for j in range(1, size):
        total += rows[:, j::size]
    total *= np.float32(1.0 / size**2)
    return total


def _camera_pose(x_m: float, y_m: float, z_m: float, yaw_rad: float) -> np.ndarray:
    """Return the camera-to-world matrix (4, 4): columns right, up and back, as in OpenGL."""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[cos, 0.0, sin, x_m], [sin, 0.0, -cos, y_m], [0.0, 1.0, 0.0, z_m], [0.0, 0.0, 0.0, 1.0]])
