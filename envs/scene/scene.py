"""One corridor: obstacles, walls, ground and mesh as plain arrays, with their lighting and collisions.

x points right, y forward along the lane, z up; metres throughout. Luminance is linear, in
[0, 1], and Lambertian: albedo * (ambient + diffuse * max(0, normal . sun)). The ground is
an infinite plane at z = 0; the walls are two upright planes at x = +-width_m / 2, visible
from both sides.

A vehicle is a level disc at its flight height. It collides with the sections of bodies and
mesh surfaces at that height, and with the walls at any height.
"""

import dataclasses
import functools
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from envs.scene import obstacles as bodies
from envs.scene.collision import CELL_M, first_contact, ways_to_goal
from envs.scene.layouts import (
    LAYOUTS,
    PLAIN_SURFACE,
    SPAWN_RANGE_M,
    Layout,
    MeshLayout,
    SphereLayout,
    draw_moving,
    draw_obstacles,
    draw_throws,
    refuse_unless,
    with_overrides,
)
from envs.scene.mesh_file import is_mesh_path, read_mesh
from envs.scene.moving import MovingBody, Throws
from envs.scene.paths import bodies_at
from envs.scene.spheres import is_sphere_path, moving_spheres, sphere_obstacles
from envs.scene.textures import Texture

# The sun stands behind the start and to the right, so that the sides of a pole differ in brightness.
SUN = (0.4, -0.5, math.sqrt(0.59))
MAX_DRAWS = 20  # corridors drawn until one is passable
MAX_HEIGHTS = 8  # heights for which a scene caches its sections


@dataclass(frozen=True, eq=False)
class Scene:
    """One corridor, immutable: its bodies, their places and their brightness.

    Attributes:
        name: Name of its layout or file.
        obstacles: (N,) OBSTACLE, read-only.
        length_m: The goal line is at y = length_m [m].
        width_m: The walls are at x = +-width_m / 2 [m].
        wall_height_m: Top of the walls [m].
        walls_y_m: Range of y of the walls [m]; for collisions they are endless.
        spawn_range_m: Range of x at the start, y = 0 [m] (appendix D.1).
        ground_albedo, wall_albedo: In [0, 1].
        sky_luminance: Luminance above the horizon where nothing hides the sky.
        ambient, diffuse: Lambert weights.
        sun: Unit vector towards the sun.
        ground_texture, wall_texture, obstacle_texture: See `envs.scene.textures`.
        mesh: More surfaces, as vertices (V, 3) [m], faces (F, 3) counter-clockwise seen from
            outside, and baked luminance (V,); only pyrender draws them. None: no mesh.
        moving: Bodies that move; only the ray caster draws them.
        throws: Balls that are thrown at the vehicle; None: no balls.
    """

    name: str
    obstacles: np.ndarray
    length_m: float = 100.0
    width_m: float = 30.0
    wall_height_m: float = 6.0
    walls_y_m: tuple[float, float] = (-20.0, 150.0)
    spawn_range_m: tuple[float, float] = SPAWN_RANGE_M
    ground_albedo: float = 0.5
    wall_albedo: float = 0.8
    sky_luminance: float = 0.85
    ambient: float = 0.35
    diffuse: float = 0.65
    sun: tuple[float, float, float] = SUN
    ground_texture: Texture = PLAIN_SURFACE
    wall_texture: Texture = PLAIN_SURFACE
    obstacle_texture: Texture = PLAIN_SURFACE
    mesh: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
    moving: tuple[MovingBody, ...] = ()
    throws: Throws | None = None

    def __post_init__(self) -> None:
        """Store read-only copies of the arrays; ValueError names the wrong value and the rule."""
        _check_numbers(self)
        obstacles = bodies.checked_obstacles(self.obstacles, self.obstacle_texture.depth)
        object.__setattr__(self, "obstacles", obstacles)
        if self.mesh is not None:
            object.__setattr__(self, "mesh", bodies.checked_mesh(*self.mesh))
        if self.movers:
            if self.mesh is not None:
                raise ValueError("a scene with a mesh cannot have bodies that move: no renderer draws both")
            bodies.checked_obstacles(bodies_at(self.movers, 0.0), self.obstacle_texture.depth)

    @cached_property
    def kinds(self) -> frozenset[int]:
        """Kinds of the obstacles in the scene, standing or moving: POLE, CONE, ELLIPSOID, BOX."""
        moving = {int(one.body["kind"]) for one in self.movers}
        return frozenset(np.unique(self.obstacles["kind"]).tolist()) | moving

    @property
    def movers(self) -> tuple[MovingBody, ...]:
        """Bodies that move; if balls are thrown, the ball comes last."""
        return self.moving if self.throws is None else (*self.moving, self.throws.waiting())

    @cached_property
    def _sections(self) -> dict[float, np.ndarray]:
        return {}

    def sections(self, height_m: float = 2.0) -> np.ndarray:
        """Return the sections that a vehicle at `height_m` [m] can hit, without the walls; cached.

        Returns:
            (M, 7) float64, read-only; see `envs.scene.obstacles`.
        """
        sections = self._sections.get(height_m)
        if sections is None:
            found = [bodies.body_sections(self.obstacles, height_m)]
            if self.mesh is not None:
                found.append(bodies.mesh_sections(self.mesh[0], self.mesh[1], height_m))
            sections = np.concatenate(found)
            sections.flags.writeable = False
            if len(self._sections) == MAX_HEIGHTS:
                self._sections.clear()
            self._sections[height_m] = sections
        return sections

    def shade(self, albedo: Any, normals: Any) -> np.ndarray:
        """Return the Lambertian luminance of surfaces of `albedo` (...,) with `normals` (..., 3); float64.

        It does not use BLAS, whose rounding depends on the number of threads.
        """
        towards_sun = np.maximum(0.0, (np.asarray(normals, np.float64) * np.asarray(self.sun)).sum(axis=-1))
        return np.asarray(albedo, np.float64) * (self.ambient + self.diffuse * towards_sun)

    def first_contact(self, a_m: Any, b_m: Any, radius_m: float, height_m: float = 2.0) -> float:
        """Return the fraction of the way from `a_m` to `b_m` at which a level disc first has contact.

        Touching counts as contact; a start in contact gives 0. The result is exact for any length. Bodies
        are solid. A mesh is only its surfaces, so a disc inside a mesh has no contact until it reaches one.

        Args:
            a_m: Start of the way, x and y [m].
            b_m: End of the way, x and y [m].
            radius_m: Radius of the disc [m].
            height_m: Height of the disc [m].

        Returns:
            Fraction in [0, 1] of the segment, or inf if there is no contact.

        Raises:
            ValueError: A number is not finite, or the radius is negative.
        """
        ax, ay, bx, by = float(a_m[0]), float(a_m[1]), float(b_m[0]), float(b_m[1])
        if not (math.isfinite(ax + ay + bx + by + height_m) and 0.0 <= radius_m < math.inf):
            raise ValueError(
                "first_contact: points, radius and height must be finite, radius >= 0, "
                f"got {a_m}, {b_m}, {radius_m}, {height_m}"
            )
        return first_contact((ax, ay, bx, by), radius_m, 0.5 * self.width_m, self.sections(height_m))

    def collides(self, a_m: Any, b_m: Any, radius_m: float, height_m: float = 2.0) -> bool:
        """Whether a disc of `radius_m` touches anything on the way from `a_m` to `b_m` (x, y) [m]."""
        return self.first_contact(a_m, b_m, radius_m, height_m) <= 1.0

    def ways_to_goal(self, radius_m: float, height_m: float = 2.0) -> np.ndarray:
        """Find the cells of `collision.CELL_M` from which the vehicle can reach the goal line.

        True is a proof for a vehicle whose steps are short compared with a cell; see
        `envs.scene.collision.ways_to_goal`.

        Returns:
            bool (rows, 2 * n + 3); element [j, n + 1 + i] is at x = i cells, y = j cells.
        """
        far = max(map(abs, self.spawn_range_m)) + self.length_m
        columns = math.ceil(min(0.5 * self.width_m, far) / CELL_M) + 1
        return ways_to_goal(self.sections(height_m), radius_m, 0.5 * self.width_m, self.length_m, columns)

    def passable(self, radius_m: float, height_m: float = 2.0) -> bool:
        """Whether a path to the goal line exists from every start, by steps ahead or 45 degrees to a side.

        True only if there are such paths. Always True if some paths stay at least `radius_m` plus 1.5 cells
        (0.15 m) away from everything.
        """
        starts = self.ways_to_goal(radius_m, height_m)[0]
        middle = (len(starts) - 1) // 2
        first, last = (x_m / CELL_M for x_m in self.spawn_range_m)
        inside = starts[max(middle + math.floor(first), 0) : middle + math.ceil(last) + 1]
        return bool(inside.all())


def make_scene(
    name: str,
    rng: np.random.Generator,
    vehicle_radius_m: float = 0.3,
    height_m: float = 2.0,
    /,
    **overrides: Any,
) -> Scene:
    """Draw a scene; the same state of `rng` gives the same bytes.

    It draws up to `MAX_DRAWS` corridors and returns the first passable one. With a mesh file nothing is
    random.

    Args:
        name: A key of LAYOUTS, the path of a CSV file of spheres (`envs.scene.spheres`), or the path of a
            mesh file that `trimesh` can read. The mesh stands in an otherwise empty lane.
        rng: Source of all random draws.
        vehicle_radius_m: Radius of the vehicle that has to get through [m].
        height_m: Height at which the vehicle flies [m].
        **overrides: Values that replace fields of the layout, such as num_obstacles=60. The layout of a mesh
            file is a `MeshLayout`, the layout of a file of spheres a `SphereLayout`.

    Raises:
        ValueError: The name, an override or its value is not valid, the obstacles cannot be placed
            `min_gap_m` apart, or no corridor was passable.
    """
    if not (math.isfinite(height_m) and 0.0 <= vehicle_radius_m < math.inf):
        raise ValueError(
            "make_scene: vehicle radius must be >= 0, it and the height finite, "
            f"got {vehicle_radius_m}, {height_m}"
        )
    if name not in LAYOUTS and not is_mesh_path(name):
        known = ", ".join(sorted(LAYOUTS))
        raise ValueError(f"scene must be one of {known}, or the path of a mesh file, got {name!r}")
    of_file = SphereLayout(file=name) if is_sphere_path(name) else MeshLayout(file=name)
    layout = with_overrides(LAYOUTS.get(name) or of_file, overrides)
    if isinstance(layout, MeshLayout):
        scenes = iter([_mesh_corridor(name, layout)])
        remedy = "lower scale, widen the lane, fly at another height"
    elif isinstance(layout, SphereLayout):
        draws = 1 if layout.file else MAX_DRAWS
        scenes = (_spheres(name, layout, rng) for _ in range(draws))
        remedy = "lower spawn_half_m or density, fly at another height"
    else:
        scenes = (_corridor(name, layout, rng, height_m) for _ in range(MAX_DRAWS))
        remedy = "lower num_obstacles or the radii, raise min_gap_m, widen the lane"
    for scene in scenes:
        if not layout.passable or scene.passable(vehicle_radius_m, height_m):
            return scene
    raise ValueError(
        f"layout of scene {name!r} gave no corridor that a vehicle of radius {vehicle_radius_m} m can pass "
        f"from every start at a height of {height_m} m; {remedy}, or set passable to false"
    )


def _corridor(name: str, layout: Layout, rng: np.random.Generator, height_m: float) -> Scene:
    return Scene(
        name=name,
        obstacles=draw_obstacles(layout, rng),
        moving=draw_moving(layout, rng, height_m),
        throws=draw_throws(layout, rng, height_m),
        width_m=float(layout.width_m),
        wall_height_m=float(layout.wall_height_m),
        ground_albedo=layout.ground_albedo,
        wall_albedo=layout.wall_albedo,
        ground_texture=layout.ground_texture,
        wall_texture=layout.wall_texture,
        obstacle_texture=layout.obstacle_texture,
    )


def _spheres(name: str, layout: SphereLayout, rng: np.random.Generator) -> Scene:
    return Scene(
        name=name,
        obstacles=sphere_obstacles(layout, rng),
        length_m=float(layout.length_m),
        width_m=float(layout.width_m),
        wall_height_m=float(layout.wall_height_m),
        spawn_range_m=(-float(layout.spawn_half_m), float(layout.spawn_half_m)),
        moving=moving_spheres(layout),
    )


def _mesh_corridor(name: str, layout: MeshLayout) -> Scene:
    file = Path(layout.file)
    stamp = (file.stat().st_mtime_ns, file.stat().st_size) if file.is_file() else (0, 0)
    return _read_mesh_corridor(name, stamp, layout)


@functools.lru_cache(maxsize=2)
def _read_mesh_corridor(name: str, stamp: tuple[int, int], layout: MeshLayout) -> Scene:
    """Return the scene of a mesh file, cached for all episodes; `stamp` changes with the file."""
    corners, normals, albedo = read_mesh(layout.file)
    nothing = np.empty(0, bodies.OBSTACLE)
    bare = Scene(name, nothing, width_m=layout.width_m, wall_height_m=layout.wall_height_m)
    luminance = bare.shade(albedo, normals[:, None, :]).ravel()
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    return dataclasses.replace(bare, mesh=(layout.scale * corners.reshape(-1, 3), faces, luminance))


def _check_numbers(scene: Scene) -> None:
    brightest = 1.0 + bodies.ROUNDING
    near, far = scene.walls_y_m
    left, right = scene.spawn_range_m
    sizes = (scene.length_m, scene.width_m, scene.wall_height_m)
    surfaces = ((scene.ground_albedo, scene.ground_texture), (scene.wall_albedo, scene.wall_texture))
    lights = (scene.ambient, scene.diffuse, scene.sky_luminance)
    rules = {
        "length_m, width_m and wall_height_m must be > 0 and finite": all(0.0 < s < math.inf for s in sizes),
        "walls_y_m and spawn_range_m must be finite ranges": -math.inf < near < far < math.inf
        and -math.inf < left <= right < math.inf,
        "ambient, diffuse and sky_luminance must be >= 0, the first two together <= 1, the last too": all(
            light >= 0.0 for light in lights
        )
        and max(scene.ambient + scene.diffuse, scene.sky_luminance) <= 1.0 + 1e-9,
        "sun must be a unit vector": len(scene.sun) == 3 and abs(math.hypot(*scene.sun) - 1.0) <= 1e-6,
        "ground_albedo and wall_albedo must be >= 0 and, times 1 + contrast of ground_texture and "
        "wall_texture, <= 1": all(a >= 0.0 and a * (1.0 + t.depth) <= brightest for a, t in surfaces),
    }
    refuse_unless(rules, f"scene {scene.name!r}", scene)
