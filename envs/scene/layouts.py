"""Layouts of corridors as data: what stands in them, how much of it, how it looks.

To add a corridor, add a `Layout` to `LAYOUTS`, or use a `MeshLayout` with the path of its file. The sources
are the paper's appendices B.1 (poles, cones and gates for the event data), D.1 (the training lane), D.2 (the
evaluation scenes) and F.1 (moving textures). The paper gives few numbers, so most numbers are our choices,
for a camera 2 m above the ground and a vehicle of radius 0.3 m.
"""

import dataclasses
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from envs.scene.moving import MovingBody, Throw, Throws
from envs.scene.obstacles import ELLIPSOID, OBSTACLE
from envs.scene.shapes import SHAPES
from envs.scene.textures import Texture

SPAWN_RANGE_M = (-10.0, 10.0)  # appendix D.1
TRIES_PER_OBSTACLE = 200
MAX_THROWS = 100  # per episode
THROWN_FROM_RAD = math.radians(30.0)  # largest bearing, left or right of straight ahead, of a thrown ball
MAX_COVERED = math.pi / math.sqrt(12.0)  # largest share of an area that equal discs can cover
PLAIN_SURFACE = Texture()


def refuse_unless(rules: dict[str, bool], what: str, record: Any) -> None:
    """Raise ValueError for the first rule that does not hold, with the values of the fields in the rule."""
    for rule, holds in rules.items():
        if not holds:
            names = [field.name for field in dataclasses.fields(record)]
            got = [f"{name}={getattr(record, name)!r}" for name in names if re.search(rf"\b{name}\b", rule)]
            raise ValueError(f"{what}: {rule}, got {', '.join(got)}")


def check_types(layout: Any) -> None:
    """Check that each field has the type of its default; a number must be in [0, 100000].

    Raises:
        ValueError: A field is wrong; the message names the field and the value.
    """
    for field in dataclasses.fields(layout):
        value = getattr(layout, field.name)
        if isinstance(field.default, bool):
            if not isinstance(value, bool):
                raise ValueError(f"layout {field.name} must be true or false, got {value!r}")
        elif isinstance(field.default, int | float):
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 <= value <= 1e5:
                raise ValueError(f"layout {field.name} must be a number in [0, 100000], got {value!r}")
        elif not isinstance(value, type(field.default)):
            kind = type(field.default).__name__
            raise ValueError(f"layout {field.name} must be a {kind}, got {value!r}")


@dataclass(frozen=True)
class Layout:
    """Obstacles of one shape at random places of a lane between two walls.

    Attributes:
        shape: A row of `envs.scene.shapes`: "pole", "cone", "ellipsoid" (round seen from above), "box"
            (square seen from above), "gate" (a frame across the lane) or "tree" (a crown on a trunk).
            All stand on the ground.
        num_obstacles: Number of obstacles.
        radius_min_m, radius_max_m: Range of the uniform radii [m]: radius of poles and of the base of cones,
            level half-axis of ellipsoids and crowns, half the side of boxes, half the inside width of gates.
        height_m: Height of every obstacle [m].
        min_gap_m: Smallest distance between two axes [m].
        first_y_m, last_y_m: Range of the uniform y of the axes [m].
        width_m, wall_height_m: Width of the lane and height of its walls [m].
        albedo_min, albedo_max: Range of the uniform albedos of obstacles.
        ground_albedo, wall_albedo: Albedos of the ground and the walls.
        ground_texture, wall_texture, obstacle_texture: See `envs.scene.textures`.
        passable: Whether a path to the goal line must exist from every start; moving bodies do not count.
        num_moving: Number of spheres that fly to and fro across the lane at the vehicle's height.
        moving_radius_m: Radius of the moving spheres [m].
        moving_min_mps, moving_max_mps: Range of the uniform speeds of the moving spheres [m/s].
        throw_every_s: Mean time between two balls thrown at the vehicle [s]; 0: no balls.
        throw_distance_m: Distance from the vehicle at which a ball starts [m].
        throw_min_mps, throw_max_mps: Range of the uniform closing speed of a ball [m/s].
        throw_radius_m: Radius of a ball [m].
    """

    shape: str = "pole"
    num_obstacles: int = 40
    radius_min_m: float = 0.5
    radius_max_m: float = 0.5
    height_m: float = 8.0
    min_gap_m: float = 2.0
    first_y_m: float = 10.0
    last_y_m: float = 100.0
    width_m: float = 30.0
    wall_height_m: float = 6.0
    albedo_min: float = 0.25
    albedo_max: float = 0.25
    ground_albedo: float = 0.5
    wall_albedo: float = 0.8
    ground_texture: Texture = PLAIN_SURFACE
    wall_texture: Texture = PLAIN_SURFACE
    obstacle_texture: Texture = PLAIN_SURFACE
    passable: bool = True
    num_moving: int = 0
    moving_radius_m: float = 0.5
    moving_min_mps: float = 1.0
    moving_max_mps: float = 3.0
    throw_every_s: float = 0.0
    throw_distance_m: float = 5.0
    throw_min_mps: float = 1.5
    throw_max_mps: float = 10.0
    throw_radius_m: float = 0.1

    def __post_init__(self) -> None:
        """Check the values; ValueError names the rule and what was given."""
        check_types(self)
        refuse_unless({f"shape must be one of {sorted(SHAPES)}": self.shape in SHAPES}, "layout", self)
        shape = SHAPES[self.shape]
        half_x = self.radius_max_m + shape.bar_m
        size = math.hypot(half_x, shape.half_y_m(self.radius_max_m))
        rules = {
            "num_obstacles must be a whole number": float(self.num_obstacles).is_integer(),
            "num_moving must be a whole number up to 1000": float(self.num_moving).is_integer()
            and self.num_moving <= 1000,
            "moving_radius_m must be > 0": self.moving_radius_m > 0,
            "moving_min_mps must be > 0 and <= moving_max_mps": 0
            < self.moving_min_mps
            <= self.moving_max_mps,
            "throw_every_s must be 0 or >= 0.1": self.throw_every_s == 0 or self.throw_every_s >= 0.1,
            "throw_min_mps must be > 0 and <= throw_max_mps": 0 < self.throw_min_mps <= self.throw_max_mps,
            "throw_radius_m must be > 0 and < throw_distance_m": 0
            < self.throw_radius_m
            < self.throw_distance_m,
            "radius_min_m must be > 0 and <= radius_max_m": 0 < self.radius_min_m <= self.radius_max_m,
            f"min_gap_m must be >= {2 * size:.6g}, or obstacles overlap": self.min_gap_m >= 2 * size,
            f"width_m must be > 20 (the spawn range) and > {2 * half_x:.6g}": self.width_m
            > max(SPAWN_RANGE_M[1] - SPAWN_RANGE_M[0], 2 * half_x),
            "first_y_m must be <= last_y_m": self.first_y_m <= self.last_y_m,
            "height_m and wall_height_m must be > 0": self.height_m > 0 and self.wall_height_m > 0,
            f"height_m of a {self.shape} must be > {shape.min_height_m}": self.height_m > shape.min_height_m,
            "albedo_min must be <= albedo_max <= 1": self.albedo_min <= self.albedo_max <= 1,
        }
        refuse_unless(rules, "layout", self)


@dataclass(frozen=True)
class MeshLayout:
    """A lane whose obstacles are the surfaces of a mesh file; every field can be overridden.

    Attributes:
        scale: Metres per unit of the file.
        width_m, wall_height_m: Width of the lane and height of its walls [m].
        passable: Whether a path to the goal line must exist from every start.
        file: Path of the mesh file, read by `envs.scene.mesh_file`.
    """

    scale: float = 1.0
    width_m: float = 30.0
    wall_height_m: float = 6.0
    passable: bool = True
    file: str = ""

    def __post_init__(self) -> None:
        """Check the values; ValueError names the rule and what was given."""
        check_types(self)
        rules = {
            "scale and wall_height_m must be > 0": self.scale > 0 and self.wall_height_m > 0,
            "width_m must be > 20 (the spawn range)": self.width_m > SPAWN_RANGE_M[1] - SPAWN_RANGE_M[0],
        }
        refuse_unless(rules, "layout", self)


@dataclass(frozen=True)
class SphereLayout:
    """A world of spheres, read from a file or drawn as in the DodgeDrone challenge (`envs.scene.spheres`).

    Attributes:
        file: Path of a CSV file; "": drawn again for each episode.
        density: Number of spheres as a multiple of what the challenge's generator draws; unused with a file.
        length_m: y of the goal line [m].
        width_m, wall_height_m: Width of the lane and height of its walls, which end a flight [m]. The
            challenge's box has no visible walls, so these walls are low.
        spawn_half_m: Half of the range of the uniform x at the start [m].
        moving: Whether to add the moving spheres of `dynamic_obstacles.yaml` in the file's folder.
        passable: Whether a path to the goal line must exist from every start.
    """

    file: str = ""
    density: float = 1.0
    length_m: float = 60.0
    width_m: float = 20.0
    wall_height_m: float = 0.1
    spawn_half_m: float = 1.0
    moving: bool = False
    passable: bool = True

    def __post_init__(self) -> None:
        """Check the values; ValueError names the rule and what was given."""
        check_types(self)
        rules = {
            "length_m, width_m and wall_height_m must be > 0": min(
                self.length_m, self.width_m, self.wall_height_m
            )
            > 0,
            "spawn_half_m must be < half of width_m": 2 * self.spawn_half_m < self.width_m,
        }
        refuse_unless(rules, "layout", self)


AnyLayout = TypeVar("AnyLayout", bound=Layout | MeshLayout | SphereLayout)
POLES_EVAL = Layout(num_obstacles=80, width_m=50.0)

# At the camera's height, 2 m, cones are as wide as poles, and so are ellipsoids, whose centre is there. A
# vehicle therefore fits through the same places, and a difference in success between these layouts and
# `poles_eval` comes from appearance alone.
LAYOUTS: dict[str, Layout | MeshLayout | SphereLayout] = {
    "poles": Layout(),
    "cones": Layout("cone", radius_min_m=0.75, radius_max_m=0.75, height_m=6.0),
    "gates": Layout("gate", 20, radius_min_m=1.2, radius_max_m=1.6, height_m=4.0, min_gap_m=4.5),
    "poles_dense": Layout(num_obstacles=80),
    "poles_eval": POLES_EVAL,
    "shape_change": dataclasses.replace(POLES_EVAL, shape="ellipsoid", height_m=4.0),
    "texture_change": dataclasses.replace(
        POLES_EVAL,
        wall_albedo=0.6,
        ground_texture=Texture("noise", period_m=1.0, contrast=0.5, seed=1),
        wall_texture=Texture("checker", period_m=4.0, contrast=0.4),
        obstacle_texture=Texture("rings", period_m=1.0, contrast=0.5),
    ),
    "dynamic": dataclasses.replace(
        POLES_EVAL,
        shape="cone",
        radius_min_m=0.75,
        radius_max_m=0.75,
        height_m=6.0,
        obstacle_texture=Texture("noise", period_m=1.0, contrast=0.8, velocity_mps=(3.0, 2.0), seed=2),
    ),
    "spheres": SphereLayout(),
}


def with_overrides(layout: AnyLayout, overrides: Mapping[str, object]) -> AnyLayout:
    """Return the layout with some of its fields replaced.

    Raises:
        ValueError: A key is not a field of the layout, or its value is invalid.
    """
    known = [field.name for field in dataclasses.fields(layout)]
    values = dict(overrides)
    for key, value in overrides.items():
        if key not in known:
            raise ValueError(f"layout has no {key!r}; it has {', '.join(known)}")
        if isinstance(value, Mapping):
            values[key] = _with_texture(key, getattr(layout, key), value)
    return dataclasses.replace(layout, **values)  # type: ignore[arg-type]  # __post_init__ checks them


def _with_texture(key: str, texture: object, changes: Mapping[str, Any]) -> Texture:
    """Return a texture with some fields replaced; integers may be given as floats and pairs as lists."""
    known = [field.name for field in dataclasses.fields(Texture)]
    wrong = [name for name in changes if name not in known]
    if not isinstance(texture, Texture) or wrong:
        rule = f"has no {wrong[0]!r}; it has {', '.join(known)}" if wrong else "is not a texture"
        raise ValueError(f"layout {key} {rule}")
    exact = {"seed": int, "velocity_mps": tuple}
    values = {name: exact[name](value) if name in exact else value for name, value in changes.items()}
    return dataclasses.replace(texture, **values)


def draw_obstacles(layout: Layout, rng: np.random.Generator) -> np.ndarray:
    """Draw obstacles in the lane, axes `min_gap_m` apart, by rejection with a bounded number of tries.

    Returns:
        (M,) OBSTACLE, place by place; a gate is four records.

    Raises:
        ValueError: The obstacles do not fit.
    """
    count = int(layout.num_obstacles)
    shape = SHAPES[layout.shape]
    half = 0.5 * layout.width_m - layout.radius_max_m - shape.bar_m
    rule = f"layout num_obstacles={count} cannot be placed {layout.min_gap_m} m apart"
    remedy = "lower num_obstacles or min_gap_m, or widen the lane"
    if _share_covered(layout, half) > MAX_COVERED:  # checked first, because the tries would take minutes
        raise ValueError(f"{rule}; {remedy}")
    tries = rng.uniform((-half, layout.first_y_m), (half, layout.last_y_m), (TRIES_PER_OBSTACLE * count, 2))
    from envs.scene.collision import keep_apart  # loads numba, which a check of names does not need

    kept = keep_apart(tries, layout.min_gap_m, count)
    if len(kept) < count:
        raise ValueError(f"{rule} ({len(kept)} fit); {remedy}")
    bodies = np.zeros(count, OBSTACLE)
    bodies["kind"] = shape.kind
    bodies["x"], bodies["y"] = kept.T
    bodies["rx"] = bodies["ry"] = rng.uniform(layout.radius_min_m, layout.radius_max_m, count)
    bodies["z"] = bodies["rz"] = 0.5 * layout.height_m
    bodies["albedo"] = rng.uniform(layout.albedo_min, layout.albedo_max, count)
    return shape.compose(bodies)


def draw_moving(layout: Layout, rng: np.random.Generator, height_m: float) -> tuple[MovingBody, ...]:
    """Draw the spheres that fly across the lane and back at `height_m` [m], each from wall to wall."""
    if not layout.num_moving:
        return ()
    count, half = int(layout.num_moving), 0.5 * layout.width_m - layout.moving_radius_m
    start, y = rng.uniform((-half, layout.first_y_m), (half, layout.last_y_m), (count, 2)).T
    speeds = rng.uniform(layout.moving_min_mps, layout.moving_max_mps, count)
    sides = rng.choice([-1.0, 1.0], count)
    albedo = rng.uniform(layout.albedo_min, layout.albedo_max, count)
    found = []
    for k in range(count):
        x = np.array([start[k], sides[k] * half, -sides[k] * half, start[k]])
        t_s = np.concatenate([[0.0], np.cumsum(np.maximum(np.abs(np.diff(x)), 1e-6)) / speeds[k]])
        places = np.stack([x, np.full(4, y[k]), np.full(4, height_m)], axis=1)
        found.append(
            MovingBody(_sphere(layout.moving_radius_m, height_m, albedo[k]), t_s, places, repeats=True)
        )
    return tuple(found)


def draw_throws(layout: Layout, rng: np.random.Generator, height_m: float) -> Throws | None:
    """Draw times, bearings and speeds of the balls thrown at the vehicle; None if there are none."""
    if not layout.throw_every_s:
        return None
    times = np.cumsum(layout.throw_every_s * rng.uniform(0.5, 1.5, MAX_THROWS))
    bearings = rng.uniform(-THROWN_FROM_RAD, THROWN_FROM_RAD, MAX_THROWS)
    speeds = rng.uniform(layout.throw_min_mps, layout.throw_max_mps, MAX_THROWS)
    ball = _sphere(layout.throw_radius_m, height_m, rng.uniform(layout.albedo_min, layout.albedo_max))
    throws = (Throw(*values) for values in np.stack([times, bearings, speeds], axis=1).tolist())
    return Throws(ball, float(layout.throw_distance_m), tuple(throws))


def _sphere(radius_m: float, height_m: float, albedo: float) -> np.void:
    sphere: np.void = np.array([(ELLIPSOID, 0.0, 0.0, height_m, *[radius_m] * 3, albedo)], OBSTACLE)[0]
    return sphere


def _share_covered(layout: Layout, half: float) -> float:
    """Return the share of the area that discs of diameter `min_gap_m` around all axes would cover."""
    gap = layout.min_gap_m
    width, length = 2 * half + gap, layout.last_y_m - layout.first_y_m + gap
    return layout.num_obstacles * 0.25 * math.pi * gap * gap / (width * length)
