"""Check a file of spheres before a flight: whether it is passable, and what the camera cannot draw.

Run: evade scene check FILE.csv
Expect: seconds; a line for each height, for a point vehicle as in the DodgeDrone challenge, and for ours.
"""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from envs.config import STRICT, Positive
from envs.scene import Scene, make_scene
from envs.scene.layouts import SphereLayout
from envs.scene.planning import passable_among
from envs.scene.spheres import about, moving_spheres
from jobs.analysis.tables import show_table
from jobs.config.config import Config, ConfigError
from jobs.config.schema import Name
from jobs.run.progress import console

HEAD = ("Height [m]", "Discs", "Passable, point", "Passable, 0.3 m", "Straight on free, point", "0.3 m")
AMONG, MOVING = ("Planned among what moves, point", "0.3 m"), "dynamic_obstacles.yaml"
RADII_M = (0.0, 0.3)  # of the challenge's vehicle, and of ours
STARTS = 21


@dataclass(frozen=True, config=STRICT)
class Settings:
    """The file to check, the heights and the speed of flight, and the distance of the goal."""

    file: Name
    heights_m: Annotated[list[Positive], Field(min_length=1)]
    speed_mps: Positive
    length_m: Positive


def run(config: Config) -> dict[str, float]:
    """Print the check; return the number of heights that our vehicle can pass, and of overlaps.

    Raises:
        ConfigError: The file cannot be read, or a row cannot be drawn.
    """
    own = config.own
    try:
        scene = make_scene(own.file, np.random.default_rng(0), passable=False, length_m=own.length_m)
    except ValueError as error:
        raise ConfigError(f"scene_check.file: {error}") from None
    if Path(own.file).with_name(MOVING).is_file():
        scene = with_moving(scene)
    found = about(scene.obstacles)
    rows = [line(scene, height_m, own.speed_mps) for height_m in own.heights_m]
    show_table(Path(own.file).name, HEAD + AMONG * bool(scene.moving), rows, 1, None)
    console.print(
        f"{found.spheres} spheres stand. {found.overlaps} pairs overlap: the camera draws the nearer "
        f"one whole; {found.in_ground} reach into the ground, and are drawn whole.",
    )
    if scene.moving:
        said = f"{len(scene.moving)} spheres of {MOVING} move, and are passed at {own.speed_mps:g} m/s"
        console.print(f"{said}; +env.layout.moving=true flies among them")
    return {"passable": float(sum(row[3] == "yes" for row in rows)), "overlaps": float(found.overlaps)}


def with_moving(scene: Scene) -> Scene:
    """Add the moving spheres from the file next to a scene's file, if they can be read."""
    try:
        return replace(scene, moving=moving_spheres(SphereLayout(file=scene.name, moving=True)))
    except ValueError as error:
        console.print(f"What moves is left out: {error}")
        return scene


def line(scene: Scene, height_m: float, speed_mps: float) -> tuple[str, ...]:
    """Return the texts of the line for one height."""
    passable = ["yes" if scene.passable(radius_m, height_m) else "no" for radius_m in RADII_M]
    starts = np.linspace(*scene.spawn_range_m, STARTS)
    free = [
        np.mean([not scene.collides((x, 0.0), (x, scene.length_m), radius_m, height_m) for x in starts])
        for radius_m in RADII_M
    ]
    discs = len(scene.sections(height_m))
    radii_m = RADII_M * bool(scene.moving)
    among = ["yes" if passable_among(scene, own, height_m, speed_mps) else "no" for own in radii_m]
    return (f"{height_m:g}", str(discs), *passable, *(f"{100 * share:.0f} %" for share in free), *among)
