"""Worlds of spheres: the obstacle files of the ICRA 2022 DodgeDrone challenge, and its generator.

A row of such a file is `prefab, x, y, z, qw, qx, qy, qz, sx, sy, sz`: the centre [m], x forward, y to the
left and z up; the rotation, which does not matter for a sphere; and the scale, equal in all directions and
twice the radius. A sphere at 1000, 1000, 1000 has been removed, because it was in an exclusion zone. Here y
is forward and x to the right.

Spheres may overlap each other and the ground. The ray caster assumes that bodies do not: of two overlapping
spheres it draws the nearer one whole, and of a sphere in the ground also the lower part. `about` counts both.
"""

import csv
import functools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from envs.scene.layouts import SphereLayout
from envs.scene.moving import MovingBody
from envs.scene.obstacles import ELLIPSOID, OBSTACLE

REMOVED_M = 1000.0
COLUMNS = ("prefab", "x", "y", "z", "qw", "qx", "qy", "qz", "sx", "sy", "sz")
ALBEDO = 0.25  # the same as poles
STRAIGHT_M = 1e-9  # largest deviation of a place from the line between its neighbours
MAX_SPHERES = 100_000
# Regions of the challenge's final generator, 20 m wide: spheres per square metre, first and last x [m].
REGIONS = ((0.11, 0.0, 60.0), (0.21, 0.0, 60.0), (0.21, 40.0, 60.0))
RADII_M = (0.05, 1.5)
HALF_WIDTH_M, TOP_M = 10.0, 10.0
ZONES = ((-3.0, 3.0), (57.0, 61.0))  # at takeoff and goal: no sphere within 3 m of the middle, below 5 m
ZONE_HALF_M, ZONE_TOP_M = 3.0, 5.0


class About(NamedTuple):
    """Number of spheres, and number of spheres that the ray caster does not draw correctly.

    Attributes:
        spheres: Number of spheres.
        overlaps: Number of pairs of spheres that overlap.
        in_ground: Number of spheres that the ground cuts.
    """

    spheres: int
    overlaps: int
    in_ground: int


def is_sphere_path(name: str) -> bool:
    """Whether the name of a scene is the path of a file of spheres."""
    return Path(name).suffix.lower() == ".csv"


def sphere_obstacles(layout: SphereLayout, rng: np.random.Generator) -> np.ndarray:
    """Return the spheres of a layout's file, or draw spheres if it has none.

    Raises:
        ValueError: The file cannot be read, or breaks a rule; the message names the line.
    """
    if not layout.file:
        return drawn_spheres(layout, rng)
    file = Path(layout.file)
    if not file.is_file():
        raise ValueError(f"scene {layout.file!r} must be the path of a CSV file, and there is no such file")
    return read_spheres(layout.file, (file.stat().st_mtime_ns, file.stat().st_size))


@functools.lru_cache(maxsize=8)
def read_spheres(path: str, stamp: tuple[int, int]) -> np.ndarray:
    """Return the spheres of a file, (N,) OBSTACLE; `stamp` changes with the file.

    Raises:
        ValueError: A row breaks a rule.
    """
    with Path(path).open(encoding="utf-8", newline="") as file:
        rows = [(number, row) for number, row in enumerate(csv.reader(file, skipinitialspace=True), 1) if row]
    if len(rows) > MAX_SPHERES:
        raise ValueError(f"scene {path!r} must have at most {MAX_SPHERES} spheres, got {len(rows)}")
    if rows and rows[0][1][: len(COLUMNS)] == list(COLUMNS):
        rows = rows[1:]
    found = [_sphere(path, number, row) for number, row in rows]
    spheres = np.array([sphere for sphere in found if sphere is not None], OBSTACLE)
    spheres.flags.writeable = False
    return spheres


def _sphere(path: str, number: int, row: Sequence[str]) -> tuple[float, ...] | None:
    """Return one row as the values of an OBSTACLE; None if the sphere was removed."""
    where = f"scene {path!r}, line {number}"
    if len(row) != len(COLUMNS):
        raise ValueError(f"{where}: must have the {len(COLUMNS)} values {', '.join(COLUMNS)}, got {len(row)}")
    try:
        values = [float(text) for text in row[1:]]
    except ValueError:
        raise ValueError(f"{where}: must have numbers behind the prefab, got {row[1:]}") from None
    if not all(math.isfinite(value) and abs(value) <= 1e5 for value in values):
        raise ValueError(f"{where}: numbers must be finite and within 100000, got {values}")
    (x, y, z), scales = values[:3], values[7:]
    if (x, y, z) == (REMOVED_M,) * 3:
        return None
    if not min(scales) > 0.0 or max(scales) - min(scales) > 1e-6 * max(scales):
        rule = "sx, sy and sz must be equal and above 0: the camera draws spheres, and no turned ellipsoids"
        raise ValueError(f"{where}: {rule}; got {scales}")
    radius = 0.5 * scales[0]
    return (ELLIPSOID, -y, x, z, radius, radius, radius, ALBEDO)


def moving_spheres(layout: SphereLayout) -> tuple[MovingBody, ...]:
    """Return the moving spheres of `dynamic_obstacles.yaml` in the folder of the layout's file.

    Each sphere has a scale and the name of a file in `csvtrajs`. Below a heading, the rows of that file are
    t, x, y, z and the rotation, every 20 ms. When the file ends, the sphere rests, unless it loops.

    Raises:
        ValueError: A file is missing, or breaks a rule.
    """
    if not layout.moving:
        return ()
    beside = Path(layout.file or "world").with_name("dynamic_obstacles.yaml")
    if not layout.file or not beside.is_file():
        raise ValueError(f"layout moving: must be false without {beside.name} beside the file of a scene")
    return read_moving(str(beside), (beside.stat().st_mtime_ns, beside.stat().st_size))


@functools.lru_cache(maxsize=4)
def read_moving(path: str, stamp: tuple[int, int]) -> tuple[MovingBody, ...]:
    """Return the moving spheres of a file; `stamp` changes with the file.

    Raises:
        ValueError: A file is missing, or breaks a rule.
    """
    import yaml

    try:
        values = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
        return tuple(
            _moving(path, str(name), said)
            for name, said in values.items()
            if isinstance(said, dict) and "csvtraj" in said
        )
    except (yaml.YAMLError, AttributeError, KeyError, TypeError, OSError) as error:
        text = " ".join(f"{type(error).__name__}: {error}".split())
        raise ValueError(f"scene {path!r} cannot be read: {text}") from None


def _moving(path: str, name: str, said: dict[str, Any]) -> MovingBody:
    """Return one moving sphere."""
    file = Path(path).with_name("csvtrajs") / f"{Path(str(said['csvtraj'])).name}.csv"
    rows = np.loadtxt(file, delimiter=",", ndmin=2, comments="#", usecols=(0, 1, 2, 3))
    scales = [float(scale) for scale in said["scale"]]
    if not min(scales) > 0.0 or max(scales) - min(scales) > 1e-6 * max(scales):
        raise ValueError(f"scene {path!r}, {name}: scale must be equal in all directions and above 0")
    radius, places = 0.5 * scales[0], np.stack([-rows[:, 2], rows[:, 1], rows[:, 3]], axis=1)
    bends = np.ones(len(rows), bool)  # a stretch at constant velocity needs only its two ends
    bends[1:-1] = np.abs(np.diff(places, 2, axis=0)).max(axis=1, initial=0.0) > STRAIGHT_M
    x, y, z = places[0]
    body = np.array([(ELLIPSOID, x, y, z, radius, radius, radius, ALBEDO)], OBSTACLE)
    return MovingBody(body[0], rows[bends, 0], places[bends], bool(said.get("loop", False)))


def drawn_spheres(layout: SphereLayout, rng: np.random.Generator) -> np.ndarray:
    """Draw `layout.density` times as many standing spheres as the challenge's generator."""
    parts = []
    for density, first_m, last_m in REGIONS:
        area = (last_m - first_m) * 2.0 * HALF_WIDTH_M
        places = rng.uniform(
            (-HALF_WIDTH_M, first_m, 0.0),
            (HALF_WIDTH_M, last_m, TOP_M),
            (round(layout.density * density * area), 3),
        )
        parts.append(np.column_stack((places, rng.uniform(*RADII_M, len(places)))))
    x, y, z, radius = np.concatenate(parts).T
    low = (np.abs(x) < ZONE_HALF_M) & (z < ZONE_TOP_M)
    kept = ~np.any([low & (y > first) & (y < last) for first, last in ZONES], axis=0)
    spheres = np.zeros(int(kept.sum()), OBSTACLE)
    spheres["kind"], spheres["albedo"] = ELLIPSOID, ALBEDO
    for name, values in zip("xyz", (x, y, z), strict=True):
        spheres[name] = values[kept]
    for name in ("rx", "ry", "rz"):
        spheres[name] = radius[kept]
    return spheres


def about(spheres: np.ndarray) -> About:
    """Count the spheres, (N,) OBSTACLE, and the spheres that the ray caster does not draw correctly."""
    from scipy.spatial import cKDTree

    places = np.stack([spheres[name] for name in "xyz"], axis=1)
    overlaps = 0
    if len(spheres) > 1:
        pairs = cKDTree(places).query_pairs(2.0 * float(spheres["rx"].max()), output_type="ndarray")
        apart = np.linalg.norm(places[pairs[:, 0]] - places[pairs[:, 1]], axis=1)
        overlaps = int((apart < spheres["rx"][pairs[:, 0]] + spheres["rx"][pairs[:, 1]]).sum())
    return About(len(spheres), overlaps, int((spheres["z"] < spheres["rz"]).sum()))
