"""pyrender renderer for any scene that is a mesh: same interface and luminance as the ray caster.

Headless EGL, one merged primitive, unlit (FLAT) with baked luminance, read back from a
32-bit float framebuffer: linear, without gamma, not rounded to 8 bits. Nothing of OpenGL
is imported before a renderer is made. A renderer belongs to the process that made it; it
may be used from any thread, one at a time.
"""

import contextlib
import math
import os
import types
from collections.abc import Iterator
from typing import Any

import numpy as np

from envs.raycast import check_image, check_pose
from envs.scene import Scene

NEAR_M = 0.02  # nothing nearer is drawn
MULTISAMPLES = 4
PACKAGES = "apt-get install --no-install-recommends libegl1 libgl1 libgl1-mesa-dri"


class PyrenderRenderer:
    """Renders one scene after the other; owns an OpenGL context until `close`."""

    def __init__(
        self,
        scene: Scene,
        width: int,
        height: int,
        fov_deg: float = 90.0,
        samples: int = 2,
        sections: int = 32,
    ) -> None:
        """Renderer of `width` x `height` pixels and `fov_deg` across.

        Args:
            scene: What to draw.
            width: Columns of the image.
            height: Rows of the image.
            fov_deg: Horizontal field of view [degrees]; pixels are square.
            samples: 1: one sample at each pixel centre, no anti-aliasing. n > 1: n x n
                sub-pixels of 4 multisamples each, averaged; 2 gives 16 samples a pixel.
            sections: Sides of the prism that stands for a round pole; its silhouette is off
                by up to 0.3 % of the radius at 32, and by a sixteenth of that at 128.

        Raises:
            ValueError: If a size is not at least 1, or fov_deg not in [1, 170].
            RuntimeError: If EGL or a system library it needs is missing; names the packages.
        """
        check_image(width, height, fov_deg, samples)
        self.width, self.height, self.samples, self.sections = width, height, samples, sections
        self._platform, self._renderer = _start(width * samples, height * samples, samples > 1)
        yfov = 2.0 * math.atan(math.tan(0.5 * math.radians(fov_deg)) * height / width)
        import pyrender

        self._camera = pyrender.PerspectiveCamera(yfov, znear=NEAR_M, aspectRatio=width / height)
        self.set_scene(scene)

    def set_scene(self, scene: Scene) -> None:
        """Draw `scene` from now on."""
        import pyrender

        world = pyrender.Scene(bg_color=[scene.sky_luminance] * 3 + [1.0])
        world.add(pyrender.Mesh([_primitive(mesh) for mesh in scene.to_trimesh(self.sections).dump()]))
        self._node = world.add(self._camera, pose=np.eye(4))
        self._world = world

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
            RuntimeError: If OpenGL fails, or the renderer was closed.
        """
        check_pose((x_m, y_m, z_m, yaw_rad))
        if self._renderer is None:
            raise RuntimeError("the renderer is closed; make a new PyrenderRenderer")
        import pyrender

        self._world.set_pose(self._node, _camera_pose(x_m, y_m, z_m, yaw_rad))
        flags = pyrender.RenderFlags.FLAT | pyrender.RenderFlags.OFFSCREEN
        with _current(self._platform):
            fine = self._renderer.render(self._world, flags)
        s = self.samples
        if s == 1:
            return fine
        return fine.reshape(self.height, s, self.width, s).mean(axis=(1, 3), dtype=np.float32)

    def close(self) -> None:
        """Free the OpenGL context; other renderers are not affected. Closing twice is allowed."""
        if getattr(self, "_renderer", None) is None:
            return
        with _current(self._platform):
            self._renderer.delete()
        self._platform.delete_context()
        self._renderer = None

    def __del__(self) -> None:
        """Close."""
        # Without this, pyrender frees its objects in whatever context is current then.
        with contextlib.suppress(Exception):
            self.close()


@contextlib.contextmanager
def _current(platform: Any) -> Iterator[None]:
    """Hold the context only while drawing, so that another thread may; OpenGL's errors cannot be pickled."""
    from OpenGL.error import Error

    try:
        platform.make_current()
        try:
            yield
        finally:
            platform.make_uncurrent()
    except Error as error:
        raise RuntimeError(f"OpenGL failed: {' '.join(str(error).split())}") from None


def _start(width: int, height: int, antialias: bool) -> tuple[Any, Any]:
    """The EGL platform and pyrender's renderer, with a float framebuffer, or RuntimeError in one line."""
    os.environ["PYOPENGL_PLATFORM"] = "egl"
    os.environ.setdefault("PYGLET_HEADLESS", "1")
    # llvmpipe's own threads hang a forked child.
    os.environ.setdefault("LP_NUM_THREADS", "0")
    # pyrender still uses the name that numpy 2 removed.
    if not hasattr(np, "infty"):
        np.infty = np.inf  # type: ignore[attr-defined]  # noqa: NPY201
    try:
        from pyrender.platforms import egl
        from pyrender.renderer import Renderer

        egl.EGLPlatform.make_uncurrent = _make_uncurrent
        egl.EGLPlatform.delete_context = _delete_context
        device = egl.get_device_by_index(int(os.environ.get("EGL_DEVICE_ID", "0")))
        platform = egl.EGLPlatform(width, height, device=device)
        platform.init_context()
        renderer = Renderer(width, height)
        with _current(platform):
            _use_float_framebuffer(renderer, antialias)
    except Exception as error:  # every missing library fails in its own way: ImportError, AttributeError, ...
        reason = " ".join(str(error).split())[:200]
        cause = f"{type(error).__name__}: {reason}"
        raise RuntimeError(f"pyrender cannot use EGL ({cause}); try: {PACKAGES}") from None
    return platform, renderer


def _make_uncurrent(platform: Any) -> None:
    from OpenGL import EGL

    if platform._egl_display is not None:
        EGL.eglMakeCurrent(platform._egl_display, EGL.EGL_NO_SURFACE, EGL.EGL_NO_SURFACE, EGL.EGL_NO_CONTEXT)


def _delete_context(platform: Any) -> None:
    """As pyrender's, without eglTerminate: the display is shared, every other renderer would die."""
    from OpenGL import EGL

    if platform._egl_context is not None:
        _make_uncurrent(platform)
        EGL.eglDestroyContext(platform._egl_display, platform._egl_context)
        platform._egl_context = platform._egl_display = None


def _use_float_framebuffer(renderer: Any, antialias: bool) -> None:
    """Give `renderer` framebuffers of one float channel and its own way of reading them."""
    size = (renderer.viewport_width, renderer.viewport_height)
    renderer._main_fb_ms, renderer._main_cb_ms, renderer._main_db_ms = _framebuffer(
        size, MULTISAMPLES if antialias else 0
    )
    renderer._main_fb, renderer._main_cb, renderer._main_db = _framebuffer(size, 0)
    renderer._main_fb_dims = size
    renderer._configure_main_framebuffer = lambda: None
    renderer._read_main_framebuffer = types.MethodType(_read_luminance, renderer)


def _framebuffer(size: tuple[int, int], multisamples: int) -> tuple[int, int, int]:
    """Framebuffer, float colour buffer and depth buffer of `size` (width, height)."""
    from OpenGL import GL

    color, depth = GL.glGenRenderbuffers(2)
    frame = GL.glGenFramebuffers(1)
    GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, frame)
    for buffer, kind, point in (
        (color, GL.GL_R32F, GL.GL_COLOR_ATTACHMENT0),
        (depth, GL.GL_DEPTH_COMPONENT24, GL.GL_DEPTH_ATTACHMENT),
    ):
        GL.glBindRenderbuffer(GL.GL_RENDERBUFFER, buffer)
        GL.glRenderbufferStorageMultisample(GL.GL_RENDERBUFFER, multisamples, kind, *size)
        GL.glFramebufferRenderbuffer(GL.GL_FRAMEBUFFER, point, GL.GL_RENDERBUFFER, buffer)
    if GL.glCheckFramebufferStatus(GL.GL_FRAMEBUFFER) != GL.GL_FRAMEBUFFER_COMPLETE:
        raise RuntimeError(f"no float framebuffer of {size} pixels with {multisamples} multisamples")
    return frame, color, depth


def _read_luminance(renderer: Any, _scene: Any, _flags: int) -> np.ndarray:
    """(H, W) float32, row 0 on top; resolves the multisamples first."""
    from OpenGL import GL

    width, height = renderer._main_fb_dims
    box = (0, 0, width, height)
    GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, renderer._main_fb_ms)
    GL.glBindFramebuffer(GL.GL_DRAW_FRAMEBUFFER, renderer._main_fb)
    GL.glBlitFramebuffer(*box, *box, GL.GL_COLOR_BUFFER_BIT, GL.GL_NEAREST)
    GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, renderer._main_fb)
    image = np.empty((height, width), np.float32)
    GL.glReadPixels(*box, GL.GL_RED, GL.GL_FLOAT, image)
    return image[::-1].copy()


def _primitive(mesh: Any) -> Any:
    """A trimesh as pyrender's primitive: grey of its `luminance`, or else its own colours."""
    from pyrender import MetallicRoughnessMaterial, Primitive

    if "luminance" in mesh.vertex_attributes:
        luminance = np.asarray(mesh.vertex_attributes["luminance"], np.float32)[:, None]
        colors = np.concatenate([np.repeat(luminance, 3, axis=1), np.ones_like(luminance)], axis=1)
    else:
        colors = np.asarray(mesh.visual.to_color().vertex_colors, np.float32) / np.float32(255.0)
    material = MetallicRoughnessMaterial(baseColorFactor=[1.0] * 4, alphaMode="OPAQUE")
    return Primitive(positions=mesh.vertices, indices=mesh.faces, color_0=colors, material=material, mode=4)


def _camera_pose(x_m: float, y_m: float, z_m: float, yaw_rad: float) -> np.ndarray:
    """(4, 4) camera to world: its columns are right, up and back, as OpenGL has them."""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[cos, 0.0, sin, x_m], [sin, 0.0, -cos, y_m], [0.0, 1.0, 0.0, z_m], [0.0, 0.0, 0.0, 1.0]])
