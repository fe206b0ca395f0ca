"""Check a file of spheres before anyone flies in it: what can be passed, and what the camera cannot draw.

Run: evade scene check FILE.csv
Expect: seconds; a line for each height, for a point, as the DodgeDrone challenge has it, and for our vehicle.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
import yaml
from pydantic import Field
from pydantic.dataclasses import dataclass

from envs.config import STRICT, Positive
from envs.scene import Scene, make_scene
from envs.scene.spheres import about
from jobs.analysis.tables import show_table
from jobs.config.config import Config, ConfigError
from jobs.config.schema import Name
from jobs.run.progress import console

HEAD = ("Height [m]", "Discs", "Passable, point", "Passable, 0.3 m", "Straight on free, point", "0.3 m")
RADII_M = (0.0, 0.3)  # the challenge's vehicle, and ours
STARTS = 21


@dataclass(frozen=True, config=STRICT)
class Settings:
    """Which file is checked, at which heights, and how far the goal is."""

    file: Name
    heights_m: Annotated[list[Positive], Field(min_length=1)]
    length_m: Positive


def run(config: Config) -> dict[str, float]:
    """Print the check; return how many heights our vehicle can pass.

    Raises:
        ConfigError: The file cannot be read, or a row cannot be drawn.
    """
    own = config.own
    try:
        scene = make_scene(own.file, np.random.default_rng(0), passable=False, length_m=own.length_m)
    except ValueError as error:
        raise ConfigError(f"scene_check.file: {error}") from None
    found = about(scene.obstacles)
    rows = [line(scene, height_m) for height_m in own.heights_m]
    show_table(Path(own.file).name, HEAD, rows, 1, None)
    console.print(
        f"{found.spheres} spheres stand. {found.overlaps} pairs overlap: the camera draws the nearer "
        f"one whole; {found.in_ground} reach into the ground, and are drawn whole.",
    )
    left_out = moving_beside(Path(own.file))
    if left_out:
        said = f"{left_out} spheres of dynamic_obstacles.yaml move; +env.layout.moving=true flies among them"
        console.print(said)
    return {"passable": float(sum(row[3] == "yes" for row in rows)), "overlaps": float(found.overlaps)}


def line(scene: Scene, height_m: float) -> tuple[str, ...]:
    """Return the texts of one height."""
    passable = ["yes" if scene.passable(radius_m, height_m) else "no" for radius_m in RADII_M]
    starts = np.linspace(*scene.spawn_range_m, STARTS)
    free = [
        np.mean([not scene.collides((x, 0.0), (x, scene.length_m), radius_m, height_m) for x in starts])
        for radius_m in RADII_M
    ]
    discs = len(scene.sections(height_m))
    return (f"{height_m:g}", str(discs), *passable, *(f"{100 * share:.0f} %" for share in free))


def moving_beside(file: Path) -> int:
    """Return the number of moving spheres that the file beside it names; 0 without one."""
    beside = file.with_name("dynamic_obstacles.yaml")
    if not beside.is_file():
        return 0
    values = yaml.safe_load(beside.read_text(encoding="utf-8"))
    return int(values.get("N", 0)) if isinstance(values, dict) else 0
