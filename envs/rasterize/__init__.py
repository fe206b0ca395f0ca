"""The OpenGL renderer: draws anything that trimesh can hold, and checks the analytic one."""

from envs.rasterize.renderer import PyrenderRenderer

__all__ = ["PyrenderRenderer"]
