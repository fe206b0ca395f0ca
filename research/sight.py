"""How far and how wide must one see to pass a world of spheres? python -m research.sight WORLD.csv.

The planner of the kinematic vehicle flies with less than it knows. A sphere counts from the moment at which a
part of it is near enough and within the field of view about straight ahead, and is never forgotten: a
camera of this view tells less.
"""

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from envs.config import EnvConfig
from envs.corridor import CorridorEnv
from envs.scene.planning import CostToGo, cost_to_go
from jobs.analysis.statistics import wilson_interval
from jobs.analysis.tables import show_table

SIGHTS_M = (2.5, 4.0, 8.0, math.inf)
VIEWS_DEG = (90.0, 130.0, 180.0)
HEIGHTS_M = (2.0, 4.0, 5.0, 6.0, 8.0)
HEAD = ("View [degrees]", "Sight [m]", "Success [%]")


def in_sight(
    obstacles: np.ndarray, at_m: tuple[float, float, float], sight_m: float, view_deg: float
) -> np.ndarray:
    """Whether a part of each sphere is within `sight_m` and within the field of view, bool (N,).

    Args:
        obstacles: (N,) OBSTACLE, spheres.
        at_m: Position of the camera, x, y and z [m]; it looks along +y.
        sight_m: Largest distance of the surface [m].
        view_deg: Horizontal field of view [degrees].
    """
    x, y, z = at_m
    right, ahead = obstacles["x"] - x, obstacles["y"] - y
    flat, reach = np.hypot(right, ahead), obstacles["rx"]
    away = np.sqrt(flat**2 + (obstacles["z"] - z) ** 2) - reach
    wide = np.arcsin(np.minimum(1.0, reach / np.maximum(flat, 1e-9)))
    bearing = np.abs(np.arctan2(right, ahead))
    near: np.ndarray = (away <= sight_m) & (bearing - wide <= math.radians(view_deg) / 2)
    return near


def fly(env: CorridorEnv, seed: int, sight_m: float, view_deg: float) -> bool:
    """Fly with a planner that knows only what it has seen; return whether it reaches the goal."""
    env.reset(seed=seed)
    config, whole = env.config, env.scene
    seen = np.zeros(len(whole.obstacles), bool)
    plan: CostToGo | None = None
    while True:
        x_m, y_m = env.camera_pose()[:2]
        now = seen | in_sight(whole.obstacles, (x_m, y_m, config.camera_height_m), sight_m, view_deg)
        if plan is None or (now & ~seen).any():
            seen = now
            known = replace(whole, obstacles=whole.obstacles[seen])
            plan = cost_to_go(known, config.vehicle_radius_m, config.camera_height_m)
        costs = plan.of_actions(*env.place_of_action())
        _, _, terminated, truncated, info = env.step(int(costs.argmin()))
        if terminated or truncated:
            return bool(info["success"])


def rows_of(world: Path, radius_m: float, starts: int) -> list[tuple[str, str, str]]:
    """Return a row under `HEAD` for each view and sight; five heights, `starts` starts at each."""
    rows = []
    for view_deg in VIEWS_DEG:
        for sight_m in SIGHTS_M:
            reached = 0
            for height_m in HEIGHTS_M:
                config = EnvConfig(
                    scene=str(world),
                    layout={"passable": False},
                    speed_mps=10.0,
                    control_hz=100.0,
                    camera_height_m=height_m,
                    vehicle_radius_m=radius_m,
                    observation="none",
                )
                env = CorridorEnv(config)
                reached += sum(fly(env, seed, sight_m, view_deg) for seed in range(starts))
            flights = starts * len(HEIGHTS_M)
            low, high = (round(100 * rate) for rate in wilson_interval(reached, flights))
            rows.append((f"{view_deg:g}", f"{sight_m:g}", f"{100 * reached / flights:.0f} [{low}, {high}]"))
    return rows


def main(words: Sequence[str]) -> None:
    """Print the table of a world."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("world", type=Path, help="a file as docs/worlds.md describes it")
    parser.add_argument(
        "--radius", type=float, default=0.0, help="of the vehicle [m]; the challenge's is a point"
    )
    parser.add_argument("--starts", type=int, default=20, help="at each of five heights")
    asked = parser.parse_args(words)
    rows = rows_of(asked.world, asked.radius, asked.starts)
    show_table(f"{asked.world.name}, radius {asked.radius:g} m", HEAD, rows, 2, None)


if __name__ == "__main__":
    main(sys.argv[1:])
