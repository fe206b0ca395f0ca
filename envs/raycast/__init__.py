"""The analytic renderer: exact coverage of every pixel, column by column, without a GPU."""

from envs.raycast.renderer import RaycastRenderer

__all__ = ["RaycastRenderer"]
