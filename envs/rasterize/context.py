"""The OpenGL context and the drawing of the rasteriser: headless, linear, in float32.

pyrender provides only the context: it opens EGL, uploads vertices, links shader programs and stores
the camera. Subclasses here replace its shaders, framebuffers, materials, lights and draw loop. They
override private methods, so pyrender is pinned to one version.

Importing this module loads OpenGL. Only `envs.rasterize.renderer` imports it, when a renderer is created.
"""

import contextlib
import ctypes
import importlib
import importlib.util
import os
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from OpenGL import GL
from OpenGL.error import Error
from OpenGL.plugins import FormatHandler
from pyrender.camera import PerspectiveCamera
from pyrender.platforms import egl
from pyrender.renderer import Renderer
from pyrender.shader_program import ShaderProgram

from envs.rasterize.shaders import FRAGMENT, VERTEX, source
from envs.scene.textures import noise_tile

# PyPI's torch with CUDA includes triton, whose import crashes after Mesa has loaded its own LLVM.
if importlib.util.find_spec("triton"):
    importlib.import_module("triton")
# Since Python 3.12 the type of ctypes.byref has a name that PyOpenGL 3.1.0 (pinned by pyrender) lacks.
FormatHandler("byref", "OpenGL.arrays.ctypesparameters.CtypesParameterHandler", ["_ctypes.CArgObject"])
EGL = egl.egl  # importing OpenGL.EGL before pyrender would break the import of OpenGL.GL.shaders
MULTISAMPLES = 4


def start(width: int, height: int, antialias: bool) -> tuple["Platform", "LuminanceRenderer"]:
    """Open a new context and a renderer in it, for images of `width` x `height` pixels.

    Raises:
        Exception: Any error of EGL, OpenGL or a missing library; the renderer names the packages.
    """
    device = egl.get_device_by_index(int(os.environ.get("EGL_DEVICE_ID", "0")))
    platform = Platform(width, height, device=device)
    platform.init_context()
    try:
        with platform.current():
            return platform, LuminanceRenderer(width, height, antialias)
    except BaseException:
        platform.delete_context()
        raise


class Platform(egl.EGLPlatform):
    """pyrender's EGL platform, extended to several contexts at once."""

    _egl_display: Any
    _egl_context: Any

    def make_uncurrent(self) -> None:
        """Release the context, so that another thread can use it."""
        if self._egl_display is not None:
            EGL.eglMakeCurrent(self._egl_display, EGL.EGL_NO_SURFACE, EGL.EGL_NO_SURFACE, EGL.EGL_NO_CONTEXT)

    def delete_context(self) -> None:
        """Delete the context without eglTerminate, which would stop all other renderers of the display."""
        if self._egl_context is not None:
            self.make_uncurrent()
            EGL.eglDestroyContext(self._egl_display, self._egl_context)
            self._egl_context = self._egl_display = None

    @contextlib.contextmanager
    def current(self) -> Iterator[None]:
        """Make the context current only while drawing, so that other threads can use it.

        Raises RuntimeError if OpenGL fails, because OpenGL's own errors cannot be pickled, so a worker could
        not report them.
        """
        try:
            self.make_current()
            try:
                yield
            finally:
                self.make_uncurrent()
        except Error as error:
            raise RuntimeError(f"OpenGL failed: {' '.join(str(error).split())}") from None


class Program(ShaderProgram):
    """pyrender's shader program, built from source text instead of files; its uniforms are in block 0."""

    def __init__(self, surface: int, pattern: int) -> None:
        """Compile and link in the current context."""
        super().__init__(source(VERTEX, surface, pattern), source(FRAGMENT, surface, pattern))
        self._add_to_context()
        GL.glUniformBlockBinding(self._program_id, GL.glGetUniformBlockIndex(self._program_id, "Frame"), 0)

    def _load(self, shader_filename: str) -> str:
        return shader_filename


class Camera(PerspectiveCamera):
    """pyrender's pinhole camera without a far plane, half a step of the rasteriser's grid to the right.

    A rasteriser rounds corners to a grid of 2^-bits pixels, and a sample exactly on an edge counts as
    right of the edge. So an edge less than half a step to the right of a sample would be drawn on the
    sample's left. The shift by half a step makes the rounding agree with this rule.
    """

    _matrix: np.ndarray | None = None

    def get_projection_matrix(self, width: int | None = None, height: int | None = None) -> np.ndarray:
        """Return the matrix (4, 4) from the camera's frame to clip space, for an image of `width` pixels."""
        if self._matrix is None:
            self._matrix = super().get_projection_matrix(width, height)
            self._matrix[0, 2] -= 2.0 ** -GL.glGetIntegerv(GL.GL_SUBPIXEL_BITS) / width
        return self._matrix


class Draw(NamedTuple):
    """One draw call: a program and the faces that it draws.

    Attributes:
        program: Surface and pattern, as in `shaders.source`.
        runs: (R, 2), first and last + 1 face of each run.
        noise: Seed of the noise; None: no noise.
    """

    program: tuple[int, int]
    runs: np.ndarray
    noise: int | None = None


class LuminanceRenderer(Renderer):
    """Renderer into one float channel, multisampled or not, with the shaders of this package.

    It uses only the vertex upload of pyrender's renderer. The context is not shared, so state
    that never changes is set once.
    """

    def __init__(self, width: int, height: int, antialias: bool) -> None:
        """Create the framebuffers, of `width` x `height` pixels, in the current context."""
        super().__init__(width, height)
        size = (width, height)
        self._main_fb_ms, self._main_cb_ms, self._main_db_ms = _framebuffer(size, MULTISAMPLES * antialias)
        self._main_fb, self._main_cb, self._main_db = _framebuffer(size, 0)
        self._main_fb_dims = size
        self._programs: dict[tuple[int, int], Program] = {}
        self._tiles: dict[int, int] = {}  # seed of the noise -> texture
        self._block = GL.glGenBuffers(1)
        GL.glBindBufferBase(GL.GL_UNIFORM_BUFFER, 0, self._block)
        # The depth clamp draws surfaces nearer than the near plane, too.
        for state in (GL.GL_DEPTH_TEST, GL.GL_CULL_FACE, GL.GL_DEPTH_CLAMP, GL.GL_MULTISAMPLE):
            GL.glEnable(state)
        GL.glViewport(0, 0, width, height)
        # For the next frame: the draw calls in order, and the uniforms, one record.
        self.draws: list[Draw] = []
        self.frame = np.zeros(0)

    def use(self, draws: list[Draw], sky: float) -> None:
        """Prepare for a scene: compile missing programs and upload the scene's noise."""
        GL.glClearColor(sky, sky, sky, 1.0)
        self._drop_tiles()
        for draw in draws:
            if draw.program not in self._programs:
                self._programs[draw.program] = Program(*draw.program)
            if draw.noise is not None and draw.noise not in self._tiles:
                self._tiles[draw.noise] = _float_texture(noise_tile(draw.noise))
        self.draws = draws

    def delete(self) -> None:
        """Free all OpenGL objects."""
        for program in self._programs.values():
            program.delete()
        self._programs.clear()
        self._drop_tiles()
        GL.glDeleteBuffers(1, [self._block])
        super().delete()

    def __del__(self) -> None:
        """Do nothing; pyrender would free its objects in whatever context is current."""

    def _drop_tiles(self) -> None:
        for texture in self._tiles.values():
            GL.glDeleteTextures([texture])
        self._tiles.clear()

    def _forward_pass(self, scene: Any, flags: int, seg_node_map: Any = None) -> np.ndarray:
        """Draw the frame; this replaces pyrender's loop over nodes, materials and lights."""
        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, self._main_fb_ms)
        GL.glClear(GL.GL_COLOR_BUFFER_BIT | GL.GL_DEPTH_BUFFER_BIT)
        GL.glBufferData(GL.GL_UNIFORM_BUFFER, self.frame.nbytes, self.frame, GL.GL_STREAM_DRAW)
        (mesh,) = scene.meshes
        mesh.primitives[0]._bind()
        for draw in self.draws:
            self._programs[draw.program]._bind()
            if draw.noise is not None:
                GL.glBindTexture(GL.GL_TEXTURE_2D, self._tiles[draw.noise])
            for first, end in draw.runs.tolist():
                start = ctypes.c_void_p(12 * first)
                GL.glDrawElements(GL.GL_TRIANGLES, 3 * (end - first), GL.GL_UNSIGNED_INT, start)
        mesh.primitives[0]._unbind()
        return self._read_main_framebuffer(scene, flags)

    def _read_main_framebuffer(self, _scene: Any, _flags: int) -> np.ndarray:
        """Resolve the multisamples and return the image, (H, W) float32, row 0 at the bottom."""
        width, height = self._main_fb_dims
        box = (0, 0, width, height)
        GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, self._main_fb_ms)
        GL.glBindFramebuffer(GL.GL_DRAW_FRAMEBUFFER, self._main_fb)
        GL.glBlitFramebuffer(*box, *box, GL.GL_COLOR_BUFFER_BIT, GL.GL_NEAREST)
        GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, self._main_fb)
        image = np.empty((height, width), np.float32)
        GL.glReadPixels(*box, GL.GL_RED, GL.GL_FLOAT, image)
        return image


def _framebuffer(size: tuple[int, int], multisamples: int) -> tuple[int, int, int]:
    """Create a framebuffer with a float colour buffer and a depth buffer of `size` (width, height)."""
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


def _float_texture(texels: np.ndarray) -> int:
    """Create a repeating texture of one float channel, bilinear between texels."""
    texture = GL.glGenTextures(1)
    GL.glBindTexture(GL.GL_TEXTURE_2D, texture)
    GL.glTexParameteri(GL.GL_TEXTURE_2D, GL.GL_TEXTURE_MIN_FILTER, GL.GL_LINEAR)
    GL.glTexParameteri(GL.GL_TEXTURE_2D, GL.GL_TEXTURE_MAG_FILTER, GL.GL_LINEAR)
    height, width = texels.shape
    kinds = (GL.GL_RED, GL.GL_FLOAT)
    GL.glTexImage2D(GL.GL_TEXTURE_2D, 0, GL.GL_R32F, width, height, 0, *kinds, np.ascontiguousarray(texels))
    return int(texture)
