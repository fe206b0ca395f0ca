"""The world: obstacles, textures and layouts, collisions, and range scans."""

from envs.scene.layouts import LAYOUTS, Layout
from envs.scene.obstacles import BOX, CONE, ELLIPSOID, OBSTACLE, POLE
from envs.scene.scene import Scene, make_scene
from envs.scene.textures import Texture

__all__ = [
    "BOX",
    "CONE",
    "ELLIPSOID",
    "LAYOUTS",
    "OBSTACLE",
    "POLE",
    "Layout",
    "Scene",
    "Texture",
    "make_scene",
]
