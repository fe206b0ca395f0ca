"""Shapes of one body: the four kinds that renderers draw exactly."""

from envs.scene.obstacles import BOX, CONE, ELLIPSOID, POLE
from envs.scene.shapes.shape import Shape

POLES = Shape(POLE)
CONES = Shape(CONE)
ELLIPSOIDS = Shape(ELLIPSOID)
BOXES = Shape(BOX, half_y_m=lambda radius_m: radius_m)
