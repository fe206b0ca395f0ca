"""Shapes of obstacles: one row each in `SHAPES`, and a file if it is composed of several bodies.

To add a shape, write a file with a function that composes it from poles, cones, ellipsoids and boxes
(`tree.py` is the shortest), a row below, and a test. Renderers, collisions, passability and the planner
handle these four kinds of body, so nothing else changes: a gate is four boxes, a tree is an ellipsoid on a
pole. Bodies may touch but not overlap; one may float above another. A shape that cannot be composed of
these four kinds is a mesh (`envs.scene.layouts.MeshLayout`), which pyrender draws.

A plug-in adds a row: `SHAPES["arch"] = Shape(BOX, compose_arches)`.
"""

from envs.scene.obstacles import BOX, CONE, ELLIPSOID, POLE
from envs.scene.shapes.gate import GATES
from envs.scene.shapes.shape import Shape
from envs.scene.shapes.tree import TREES

SHAPES: dict[str, Shape] = {
    "pole": Shape(POLE),
    "box": Shape(BOX, half_y_m=lambda radius_m: radius_m),
    "cone": Shape(CONE),
    "ellipsoid": Shape(ELLIPSOID),
    "gate": GATES,
    "tree": TREES,
}

__all__ = ["SHAPES", "Shape"]
