"""The world: obstacles, walls and ground as plain arrays, its layouts, its mesh, its collisions.

x points right, y forward along the lane, z up; metres throughout. Luminance is linear, in
[0, 1], and Lambertian: albedo * (ambient + diffuse * max(0, normal . sun)). The ground is
an infinite plane at z = 0; the walls are two upright planes at x = +-width_m / 2, both
sides of which can be seen.
"""

import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from envs.collision import first_contact, keep_apart

if TYPE_CHECKING:
    import trimesh

# x, y, z is the centre of an obstacle and rx, ry, rz are its half-axes; a pole stands on
# the ground, so z = rz = height / 2, and rx = ry is its radius.
OBSTACLE = np.dtype(
    [
        ("kind", "u1"),
        ("x", "f8"),
        ("y", "f8"),
        ("z", "f8"),
        ("rx", "f8"),
        ("ry", "f8"),
        ("rz", "f8"),
        ("albedo", "f4"),
    ]
)
POLE = 0

# The sun stands behind the start and to the right, so that the sides of a pole differ.
SUN = (0.4, -0.5, math.sqrt(0.59))
TRIES_PER_POLE = 200
DENSEST = math.pi / math.sqrt(12.0)  # largest share of an area that equal discs can cover


@dataclass(frozen=True, eq=False)
class Scene:
    """One corridor, immutable: what stands where and how bright it is.

    Attributes:
        name: Layout it was made from.
        obstacles: (N,) OBSTACLE, read-only.
        length_m: The goal line is at y = length_m [m].
        width_m: The walls are at x = +-width_m / 2 [m].
        wall_height_m: Top of the walls [m].
        walls_y_m: Where the walls begin and end in y [m]; collisions take them as endless.
        spawn_range_m: Range of x at the start, y = 0 [m] (appendix D.1).
        ground_albedo, wall_albedo: In [0, 1].
        sky_luminance: Everything above the horizon that nothing hides.
        ambient, diffuse: Lambert weights.
        sun: Unit vector towards the sun.
    """

    name: str
    obstacles: np.ndarray
    length_m: float = 100.0
    width_m: float = 30.0
    wall_height_m: float = 6.0
    walls_y_m: tuple[float, float] = (-20.0, 150.0)
    spawn_range_m: tuple[float, float] = (-10.0, 10.0)
    ground_albedo: float = 0.5
    wall_albedo: float = 0.8
    sky_luminance: float = 0.85
    ambient: float = 0.35
    diffuse: float = 0.65
    sun: tuple[float, float, float] = SUN

    def __post_init__(self) -> None:
        """Keep a read-only copy of the obstacles; ValueError if they are not OBSTACLE records."""
        if getattr(self.obstacles, "dtype", None) != OBSTACLE or self.obstacles.ndim != 1:
            raise ValueError(f"obstacles must be a 1-D array of scene.OBSTACLE, got {self.obstacles!r:.80}")
        obstacles = self.obstacles.copy()
        obstacles.flags.writeable = False
        object.__setattr__(self, "obstacles", obstacles)

    @cached_property
    def _discs(self) -> np.ndarray:
        """(N, 3) float64 x, y, radius of what a flight at any height can hit [m]."""
        return np.stack([self.obstacles[key] for key in ("x", "y", "rx")], axis=1).astype(np.float64)

    def shade(self, albedo: Any, normals: Any) -> np.ndarray:
        """Lambertian luminance of surfaces of `albedo` (...,) with unit `normals` (..., 3); float64."""
        towards_sun = np.maximum(0.0, np.asarray(normals, np.float64) @ np.asarray(self.sun))
        return np.asarray(albedo, np.float64) * (self.ambient + self.diffuse * towards_sun)

    def first_contact(self, a_m: Any, b_m: Any, radius_m: float) -> float:
        """Where a disc of `radius_m` moving from `a_m` to `b_m` (x, y) [m] first touches something.

        Touching counts as contact; a start in contact gives 0. Exact for any length.

        Returns:
            Fraction in [0, 1] of the segment, or inf if there is no contact.

        Raises:
            ValueError: If a coordinate or the radius is not finite, or the radius is negative.
        """
        ax, ay, bx, by = float(a_m[0]), float(a_m[1]), float(b_m[0]), float(b_m[1])
        if not (math.isfinite(ax + ay + bx + by) and 0.0 <= radius_m < math.inf):
            raise ValueError(
                f"first_contact: points and radius must be finite, radius >= 0, got {a_m}, {b_m}, {radius_m}"
            )
        return first_contact((ax, ay, bx, by), radius_m, 0.5 * self.width_m, self._discs)

    def collides(self, a_m: Any, b_m: Any, radius_m: float) -> bool:
        """Whether a disc of `radius_m` touches anything on its way from `a_m` to `b_m` (x, y) [m]."""
        return self.first_contact(a_m, b_m, radius_m) <= 1.0

    def to_trimesh(self, sections: int = 32) -> "trimesh.Scene":
        """The scene as one merged mesh, poles as prisms of `sections` sides with a cap.

        Vertices carry their baked luminance twice: as grey `vertex_colors` (8 bits) and
        exactly, as float32, in `vertex_attributes["luminance"]`. The ground ends 100 km away.
        """
        # Imported here because the ray caster's workers never need it.
        import trimesh

        from envs.meshes import flat_meshes, pole_mesh

        parts = [pole_mesh(self, pole, sections) for pole in self.obstacles] + flat_meshes(self)
        offsets = np.cumsum([0] + [len(part[0]) for part in parts[:-1]])
        vertices = np.concatenate([part[0] for part in parts])
        faces = np.concatenate([part[1] + offset for part, offset in zip(parts, offsets, strict=True)])
        luminance = np.concatenate([part[2] for part in parts])
        grey = np.clip(np.rint(luminance * 255.0), 0, 255).astype(np.uint8)
        colors = np.stack([grey, grey, grey, np.full_like(grey, 255)], axis=1)
        mesh = trimesh.Trimesh(vertices, faces, vertex_colors=colors, process=False)
        mesh.vertex_attributes["luminance"] = luminance.astype(np.float32)
        return trimesh.Scene([mesh])


@dataclass(frozen=True)
class PolesLayout:
    """Upright poles at random places of a lane between two walls; every field can be overridden.

    Attributes:
        num_poles: How many.
        radius_min_m, radius_max_m: Radii are uniform between these [m].
        height_m: Height of every pole [m].
        min_gap_m: Smallest distance between two axes [m].
        first_y_m, last_y_m: The axes stand at y uniform between these [m].
        width_m, wall_height_m: The lane and its walls [m].
        albedo_min, albedo_max: Albedos of poles are uniform between these.
    """

    num_poles: int = 40
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


# Appendix D.1 and D.2. A straight flight meets a pole with probability of about
# 1 - exp(-num_poles * 2 * (pole + vehicle radius) / width_m): 0.88 and 0.92 here.
LAYOUTS: dict[str, PolesLayout] = {
    "poles": PolesLayout(),
    "poles_eval": PolesLayout(num_poles=80, width_m=50.0),
}


def make_scene(name: str, rng: np.random.Generator, /, **overrides: float) -> Scene:
    """Draw a scene of the layout `name`; the same state of `rng` gives the same bytes.

    Args:
        name: A key of LAYOUTS.
        rng: Source of all that is random.
        **overrides: Values that replace fields of the layout, such as num_poles=60.

    Raises:
        ValueError: If the name, an override or its value is not valid, or if the poles
            cannot be placed `min_gap_m` apart.
    """
    if name not in LAYOUTS:
        raise ValueError(f"scene must be one of {sorted(LAYOUTS)}, got {name!r}")
    layout = LAYOUTS[name]
    known = [field.name for field in dataclasses.fields(layout)]
    for key, value in overrides.items():
        if key not in known:
            raise ValueError(f"layout of scene {name!r} has no {key!r}; it has {known}")
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 <= value <= 1e5:
            raise ValueError(f"layout {key} must be a number in [0, 100000], got {value!r}")
    layout = dataclasses.replace(layout, **overrides)  # type: ignore[arg-type]
    _check_layout(layout)
    return Scene(
        name=name,
        obstacles=_place_poles(layout, rng),
        width_m=float(layout.width_m),
        wall_height_m=float(layout.wall_height_m),
    )


def _check_layout(layout: PolesLayout) -> None:
    rules = {
        "num_poles must be a whole number": float(layout.num_poles).is_integer(),
        "radius_min_m must be > 0 and <= radius_max_m": 0 < layout.radius_min_m <= layout.radius_max_m,
        "min_gap_m must be >= 2 * radius_max_m": layout.min_gap_m >= 2 * layout.radius_max_m,
        "width_m must be > 20 (the spawn range) and > 2 * radius_max_m": layout.width_m
        > max(20.0, 2 * layout.radius_max_m),
        "first_y_m must be <= last_y_m": layout.first_y_m <= layout.last_y_m,
        "height_m and wall_height_m must be > 0": layout.height_m > 0 and layout.wall_height_m > 0,
        "albedo_min must be <= albedo_max <= 1": layout.albedo_min <= layout.albedo_max <= 1,
    }
    for rule, holds in rules.items():
        if not holds:
            raise ValueError(f"layout: {rule}, got {layout}")


def _share_covered(layout: PolesLayout) -> float:
    """Share of the area that discs of diameter `min_gap_m` around all axes would cover."""
    gap = layout.min_gap_m
    width, length = layout.width_m - 2 * layout.radius_max_m + gap, layout.last_y_m - layout.first_y_m + gap
    return layout.num_poles * 0.25 * math.pi * gap * gap / (width * length)


def _place_poles(layout: PolesLayout, rng: np.random.Generator) -> np.ndarray:
    """Poles inside the lane and `min_gap_m` apart, by rejection with a bounded number of tries."""
    count = int(layout.num_poles)
    half = 0.5 * layout.width_m - layout.radius_max_m
    if _share_covered(layout) > DENSEST:  # asked first: the tries would take minutes
        raise ValueError(
            f"layout num_poles={count} cannot be placed {layout.min_gap_m} m apart; "
            "lower num_poles or min_gap_m, or widen the lane"
        )
    tries = rng.uniform((-half, layout.first_y_m), (half, layout.last_y_m), (TRIES_PER_POLE * count, 2))
    kept = keep_apart(tries, layout.min_gap_m, count)
    if len(kept) < count:
        raise ValueError(
            f"layout num_poles={count} cannot be placed {layout.min_gap_m} m apart ({len(kept)} fit); "
            "lower num_poles or min_gap_m, or widen the lane"
        )
    poles = np.zeros(count, OBSTACLE)
    poles["kind"] = POLE
    poles["x"], poles["y"] = kept.T
    poles["rx"] = poles["ry"] = rng.uniform(layout.radius_min_m, layout.radius_max_m, count)
    poles["z"] = poles["rz"] = 0.5 * layout.height_m
    poles["albedo"] = rng.uniform(layout.albedo_min, layout.albedo_max, count)
    return poles
