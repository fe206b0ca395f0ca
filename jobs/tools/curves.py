"""Learning curves of the published policies: as a table, and as one number for each training."""

import csv
import io
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jobs.analysis.plots import Curve
from jobs.run.files import read_json
from jobs.run.folder import COMPARED_STEPS
from models.policy.policy import ENCODER, MANIFEST

COLUMNS = ("exp", "seed", "env_steps", "success_rate", "distance_m")


def read_curves(folder: Path) -> dict[tuple[str, int], Curve]:
    """Read `curves.csv` in `folder`: group and seed -> curve, for policies that are also in the folder."""
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


def by_reward(folder: Path, curves: Sequence[Curve]) -> list[Curve]:
    """Return the curves of policies in `folder` trained on rewards, not by imitation."""
    manifests = [read_json(folder / f"{one.exp}-s{one.seed}" / MANIFEST) for one in curves]
    return [
        one
        for one, about in zip(curves, manifests, strict=True)
        if not about.get("algo", {}).get("imitation")
    ]


def as_csv(curves: Sequence[Curve]) -> str:
    """Return the curves as one CSV table, a row per point."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for one in curves:
        for point in zip(one.env_steps, one.success_rate, one.distance_m, strict=True):
            writer.writerow([one.exp, one.seed, int(point[0]), f"{point[1]:.3f}", f"{point[2]:.2f}"])
    return text.getvalue()


class PublishedTraining(NamedTuple):
    """Learning speed of a published training, and the cost of its encoder. Manifests lack the training time.

    Attributes:
        group, seed: Group and seed of the training.
        env_steps: Environment steps of the policy's training, without the encoder's.
        encoder_env_steps: Steps recorded for its encoder; 0 without an encoder.
        encoder_iterations: Iterations of the encoder's pretraining.
        mean_success: Mean over the policy's first `COMPARED_STEPS`, see `mean_success`; None: the training
            was shorter.
        mean_success_with_encoder: The same mean, if the encoder's steps count first.
    """

    group: str
    seed: int
    env_steps: int
    encoder_env_steps: int
    encoder_iterations: int
    mean_success: float | None
    mean_success_with_encoder: float | None


def published_trainings(folder: Path) -> list[PublishedTraining]:
    """Read the manifests and learning curves of the published policies, by group and seed."""
    return [_published(folder, curve) for _, curve in sorted(read_curves(folder).items())]


def _published(folder: Path, curve: Curve) -> PublishedTraining:
    place = folder / f"{curve.exp}-s{curve.seed}"
    manifest = read_json(place / MANIFEST)
    steps, iterations = 0, 0
    if (place / ENCODER).is_file():
        steps = manifest["collect"]["num_steps"] + manifest["collect"]["num_validation_steps"]
        iterations = manifest["pretrain"]["iterations"]
    last = int(curve.env_steps[-1])
    long = last >= COMPARED_STEPS
    return PublishedTraining(
        curve.exp, curve.seed, last, steps, iterations,
        mean_success(curve, COMPARED_STEPS) if long else None,
        mean_success(curve, COMPARED_STEPS, steps) if long else None,
    )  # fmt: skip


def mean_success(curve: Curve, env_steps: int, before: int = 0) -> float:
    """Return the success rate, 0..1, averaged over a training's first steps: high for fast, good learning.

    The curve is interpolated linearly between its points, and 0 until the training begins.

    Args:
        curve: A learning curve with a point at `env_steps` or later.
        env_steps: Number of first steps to average over [-].
        before: Steps among these that precede the training, for the encoder [-].

    Raises:
        ValueError: The curve ends before `env_steps`.
    """
    steps = np.concatenate([[0.0, before], curve.env_steps + before])
    success = np.concatenate([[0.0, 0.0], curve.success_rate])
    if steps[-1] < env_steps:
        rule = f"a curve must reach {env_steps} environment steps"
        raise ValueError(f"{rule}, got {steps[-1]:.0f} for {curve.exp} with seed {curve.seed}; train on")
    at = np.append(steps[steps < env_steps], env_steps)
    return float(np.trapezoid(np.interp(at, steps, success), at) / env_steps)
