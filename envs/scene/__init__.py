"""The world: obstacles, textures and layouts, what the vehicle hits, and how far it sees.

`Scene` and `make_scene` are imported at their first use, because they need numba, which is slow to load.
The launcher checks a scene's name without it.
"""

from typing import TYPE_CHECKING

from envs.scene.layouts import LAYOUTS, Layout
from envs.scene.moving import MovingBody, at_velocity
from envs.scene.obstacles import BOX, CONE, ELLIPSOID, OBSTACLE, POLE
from envs.scene.textures import Texture

if TYPE_CHECKING:
    from envs.scene.scene import Scene, make_scene

__all__ = [
    "BOX",
    "CONE",
    "ELLIPSOID",
    "LAYOUTS",
    "OBSTACLE",
    "POLE",
    "Layout",
    "MovingBody",
    "Scene",
    "Texture",
    "at_velocity",
    "make_scene",
]


def __getattr__(name: str) -> object:
    """Import `Scene` or `make_scene` at its first use."""
    if name not in ("Scene", "make_scene"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from envs.scene import scene

    return getattr(scene, name)
