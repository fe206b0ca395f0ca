"""Learning curves of the published policies: as a table, and as one number for each training."""

import csv
import io
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jobs.analysis.plots import Curve
from models.policy.policy import MANIFEST

COLUMNS = ("exp", "seed", "env_steps", "success_rate", "distance_m")


def read_curves(folder: Path) -> dict[tuple[str, int], Curve]:
    """Read `curves.csv` in `folder`: group and seed -> curve, for policies that are in the folder too."""
    file = folder / "curves.csv"
    rows = csv.DictReader(file.read_text().splitlines() if file.is_file() else [])
    found: dict[tuple[str, int], list[list[float]]] = defaultdict(list)
    for row in rows:
        found[row["exp"], int(row["seed"])].append([float(row[name]) for name in COLUMNS[2:]])
    return {
        key: Curve(*key, *np.array(points).T)
        for key, points in found.items()
        if (folder / f"{key[0]}-s{key[1]}" / MANIFEST).is_file()
    }


def as_csv(curves: Sequence[Curve]) -> str:
    """The curves as one table, a row per point."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for one in curves:
        for point in zip(one.env_steps, one.success_rate, one.distance_m, strict=True):
            writer.writerow([one.exp, one.seed, int(point[0]), f"{point[1]:.3f}", f"{point[2]:.2f}"])
    return text.getvalue()


def mean_success(curve: Curve, env_steps: int) -> float:
    """Success rate, 0..1, averaged over a training's first steps: high if it learns early and well.

    A curve is linear between its points, and 0 at step 0.

    Args:
        curve: With a point at `env_steps` or later.
        env_steps: How many first steps [-].

    Raises:
        ValueError: The curve ends before.
    """
    steps, success = (np.concatenate([[0.0], part]) for part in (curve.env_steps, curve.success_rate))
    if steps[-1] < env_steps:
        rule = f"a curve must reach {env_steps} environment steps"
        raise ValueError(f"{rule}, got {steps[-1]:.0f} for {curve.exp} with seed {curve.seed}; train on")
    at = np.append(steps[steps < env_steps], env_steps)
    return float(np.trapezoid(np.interp(at, steps, success), at) / env_steps)
