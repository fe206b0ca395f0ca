"""pyrender's OpenGL renderer as the simulator needs it: headless, linear, in float32, with its own shaders.

Importing this loads OpenGL; only `envs.rasterize` does, when a renderer is made.
"""

import contextlib
import ctypes
import os
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from OpenGL import GL
from OpenGL.error import Error
from pyrender.camera import PerspectiveCamera
from pyrender.platforms import egl
from pyrender.renderer import Renderer
from pyrender.shader_program import ShaderProgram

from envs.shaders import FRAGMENT, VERTEX, source

EGL = egl.egl  # imported before pyrender, OpenGL.EGL breaks the import of OpenGL.GL.shaders
MULTISAMPLES = 4
Uniforms = Mapping[str, np.ndarray]


def start(width: int, height: int, antialias: bool) -> tuple["Platform", "LuminanceRenderer"]:
    """A context of its own and a renderer in it, for images of `width` x `height` pixels."""
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
    """pyrender's EGL platform, in which several contexts can live side by side."""

    _egl_display: Any
    _egl_context: Any

    def make_uncurrent(self) -> None:
        """Let another thread have the context."""
        if self._egl_display is not None:
            EGL.eglMakeCurrent(self._egl_display, EGL.EGL_NO_SURFACE, EGL.EGL_NO_SURFACE, EGL.EGL_NO_CONTEXT)

    def delete_context(self) -> None:
        """As pyrender's, without eglTerminate: the display is shared, every other renderer would die."""
        if self._egl_context is not None:
            self.make_uncurrent()
            EGL.eglDestroyContext(self._egl_display, self._egl_context)
            self._egl_context = self._egl_display = None

    @contextlib.contextmanager
    def current(self) -> Iterator[None]:
        """Hold the context only while drawing, so that another thread may; RuntimeError if OpenGL fails.

        OpenGL's own errors cannot be pickled, so that a worker could not report them.
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
    """pyrender's shader program, from the text of its stages; it looks up each uniform once."""

    def __init__(self, textured: bool) -> None:
        """Compile and link in the current context."""
        super().__init__(source(VERTEX, textured), source(FRAGMENT, textured))
        self._locations: dict[str, int] = {}
        self._add_to_context()

    def _load(self, shader_filename: str) -> str:
        return shader_filename

    def set_uniform(self, name: str, value: Any, unsigned: bool = False) -> None:
        """Set what the shaders call `name`; what they do not use is left out.

        `value` of shape (n,) is a number or a vector, of shape (m, n) an array of m of them, of
        shape (4, 4) a matrix.
        """
        if name not in self._locations:
            self._locations[name] = GL.glGetUniformLocation(self._program_id, name)
        location = self._locations[name]
        if location < 0:
            return
        value = np.asarray(value)
        whole = np.issubdtype(value.dtype, np.integer)
        value = np.ascontiguousarray(value, np.int32 if whole else np.float32)
        if value.shape == (4, 4):
            GL.glUniformMatrix4fv(location, 1, GL.GL_TRUE, value)
        else:
            _SET[value.shape[-1], whole](location, value.size // value.shape[-1], value)


_SET = {
    (1, False): GL.glUniform1fv,
    (2, False): GL.glUniform2fv,
    (3, False): GL.glUniform3fv,
    (1, True): GL.glUniform1iv,
}


class Camera(PerspectiveCamera):
    """pyrender's pinhole camera without a far plane, half a step of the rasteriser's grid to the right.

    A rasteriser rounds corners to a grid of 2^-bits pixels, and counts a sample that lies on an
    edge to its right. So an edge less than half a step to the right of a sample would be drawn
    on its left; with this, the rounding and the rule agree.
    """

    _matrix: np.ndarray | None = None

    def get_projection_matrix(self, width: int | None = None, height: int | None = None) -> np.ndarray:
        """(4, 4) from the camera's frame to the clip space, for an image of `width` pixels."""
        if self._matrix is None:
            self._matrix = super().get_projection_matrix(width, height)
            self._matrix[0, 2] -= 2.0 ** -GL.glGetIntegerv(GL.GL_SUBPIXEL_BITS) / width
        return self._matrix


class LuminanceRenderer(Renderer):
    """pyrender's renderer with one float channel, multisampled or not, and the shaders of this package."""

    def __init__(self, width: int, height: int, antialias: bool) -> None:
        """Make the framebuffers, of `width` x `height` pixels, in the current context."""
        super().__init__(width, height)
        size = (width, height)
        self._main_fb_ms, self._main_cb_ms, self._main_db_ms = _framebuffer(size, MULTISAMPLES * antialias)
        self._main_fb, self._main_cb, self._main_db = _framebuffer(size, 0)
        self._main_fb_dims = size
        self._programs: dict[bool, Program] = {}
        self._tiles: int | None = None
        self.textured = False
        # Of the next frame: uniforms, and (R, 2) first and last + 1 of the faces to draw.
        self.uniforms: Uniforms = {}
        self.runs = np.zeros((0, 2), np.int64)

    def use(self, textured: bool, uniforms: Uniforms, tiles: np.ndarray | None) -> None:
        """Prepare the program for a scene: its constants, and (T, N) float32 `tiles` if it has noise."""
        self.textured = textured
        if textured not in self._programs:
            self._programs[textured] = Program(textured)
        program = self._programs[textured]
        program._bind()
        for name, value in uniforms.items():
            program.set_uniform(name, value)
        program._unbind()
        self._drop_tiles()
        if tiles is not None:
            self._tiles = _float_texture(tiles)

    def delete(self) -> None:
        """Free all objects of OpenGL."""
        for program in self._programs.values():
            program.delete()
        self._programs.clear()
        self._drop_tiles()
        super().delete()

    def __del__(self) -> None:
        """Nothing: pyrender would free its objects in whatever context is current then."""

    def _drop_tiles(self) -> None:
        if self._tiles is not None:
            GL.glDeleteTextures([self._tiles])
            self._tiles = None

    def _get_primitive_program(self, _primitive: Any, _flags: int, _program_flags: int) -> Program:
        return self._programs[self.textured]

    def _bind_and_draw_primitive(self, primitive: Any, pose: Any, program: Program, flags: int) -> None:
        """Without pyrender's materials."""
        for name, value in self.uniforms.items():
            program.set_uniform(name, value)
        GL.glDisable(GL.GL_BLEND)
        GL.glEnable(GL.GL_CULL_FACE)
        GL.glEnable(GL.GL_DEPTH_CLAMP)  # nothing is too near to be seen
        primitive._bind()
        for first, end in self.runs.tolist():
            start = ctypes.c_void_p(12 * first)
            GL.glDrawElements(primitive.mode, 3 * (end - first), GL.GL_UNSIGNED_INT, start)
        primitive._unbind()

    def _configure_main_framebuffer(self) -> None:
        """The framebuffers are there already."""

    def _read_main_framebuffer(self, _scene: Any, _flags: int) -> np.ndarray:
        """(H, W) float32, row 0 at the bottom; resolves the multisamples first."""
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
    """Framebuffer, float colour buffer and depth buffer of `size` (width, height)."""
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
    """A texture of one float channel, bound to unit 0."""
    texture = GL.glGenTextures(1)
    GL.glBindTexture(GL.GL_TEXTURE_2D, texture)
    GL.glTexParameteri(GL.GL_TEXTURE_2D, GL.GL_TEXTURE_MIN_FILTER, GL.GL_NEAREST)
    GL.glTexParameteri(GL.GL_TEXTURE_2D, GL.GL_TEXTURE_MAG_FILTER, GL.GL_NEAREST)
    height, width = texels.shape
    kinds = (GL.GL_RED, GL.GL_FLOAT)
    GL.glTexImage2D(GL.GL_TEXTURE_2D, 0, GL.GL_R32F, width, height, 0, *kinds, np.ascontiguousarray(texels))
    return int(texture)
