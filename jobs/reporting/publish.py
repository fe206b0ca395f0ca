"""Put trained policies where a fresh clone finds them, and draw how they learnt.

Run: make train-all, which trains every policy and ends with this; or python -m platform.launch +exp=ship
Expect: seconds. In models/pretrained a folder <group>-s<seed> for the newest training of each
experiment, length and seed in `runs_dir` with the configured budget, a few hundred kilobytes each
(weights in float16, no decoder), `curves.csv` and, in docs/images, `learning.png`; what was shipped
before stays. A group is an experiment; trainings of another length than the one that all are
compared at have its thousands of steps behind their name: bytestream_1500k. Each becomes a
version in MLflow's model registry.
"""

import json
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from envs.config import settings_hash
from jobs.analysis.plots import Curve, learning_figure
from jobs.config.config import Config, ConfigError
from jobs.reporting.learning_curves import as_csv, read_curves
from jobs.rollout.policies import PRETRAINED
from jobs.run.files import write_atomic
from jobs.run.folder import group_name, open_run
from jobs.run.progress import console
from jobs.run.provenance import REPOSITORY
from jobs.tracking.model_registry import register_training
from jobs.tracking.tracker import open_tracker
from models.policy import load_policy
from models.policy.policy import save_lean_policy

FIGURE = REPOSITORY / "docs" / "images" / "learning.png"
POINTS = 50  # of a curve


@dataclass(frozen=True)
class Training:
    """A finished training: its run folder, configuration, and what its stage's marker says."""

    path: Path
    config: Mapping[str, Any]
    marker: Mapping[str, Any]

    @property
    def group(self) -> str:
        """What it is one training of."""
        return group_name(self.config["exp"], self.config["train"]["env_steps"])

    @property
    def seed(self) -> int:
        """Of corridors, networks and encoder."""
        return int(self.config["seed"])


def run(config: Config) -> dict[str, Any]:
    """Ship the finished trainings; return how many of each experiment.

    Raises:
        ConfigError: There is none, or they were to learn nothing.
    """
    if config.budget == "smoke":
        raise ConfigError("budget: smoke learns nothing, and would replace what is shipped; ship another")
    trainings = newest_trainings(Path(config.runs_dir).resolve(), config.budget)
    if not trainings:
        where = str(Path(config.runs_dir).resolve())
        raise ConfigError(f"runs_dir: no finished training with budget={config.budget} in {where!r}")
    for training in trainings:
        target = ship(training, PRETRAINED)
        size = sum(file.stat().st_size for file in target.iterdir())
        console.print(f"{target.relative_to(REPOSITORY)}: {size / 1024:,.0f} KiB", markup=False)
    shipped = read_curves(PRETRAINED)  # of trainings elsewhere, or whose run folders are gone
    curves = list((shipped | {(one.exp, one.seed): one for one in map(curve, trainings)}).values())
    curves.sort(key=lambda one: (one.exp, one.seed))
    write_atomic(PRETRAINED / "curves.csv", as_csv(curves))
    figure = learning_figure(curves)
    figure.savefig(FIGURE, dpi=120)
    folder = open_run(config)
    with open_tracker(folder.config, folder) as tracker:
        tracker.figure("train/learning.png", figure)
        tracker.text("train/curves.csv", as_csv(curves))
        for training in trainings:
            register_training(tracker.of(training.path), training.path)
    counts: dict[str, int] = defaultdict(int)
    for training in trainings:
        counts[training.group] += 1
    return dict(counts)


def newest_trainings(runs_dir: Path, budget: str) -> list[Training]:
    """The training of each group and seed that was finished last, by group and seed."""
    found: dict[tuple[str, int], tuple[int, Training]] = {}  # (group, seed): when, which
    for marker in runs_dir.glob("*/stages/train.json"):
        path = marker.parent.parent
        config = json.loads((path / "config.json").read_text())
        if config["budget"] != budget or not (path / "policy" / "policy.json").is_file():
            continue
        training, when = Training(path, config, json.loads(marker.read_text())), marker.stat().st_mtime_ns
        key = training.group, training.seed
        if key not in found or when > found[key][0]:
            found[key] = when, training
    return [found[key][1] for key in sorted(found)]


def ship(training: Training, folder: Path) -> Path:
    """Write the policy of a training into `folder`, and what made it into its manifest."""
    about = {
        "exp": training.group,
        "run": training.path.name,
        "commit": training.marker["commit"],
        "config_hash": settings_hash(dict(training.config)),
        "train": training.config["train"],
        "pretrain": training.config["pretrain"],
        "collect": training.config["collect"],
    }
    target = folder / f"{training.group}-s{training.seed}"
    save_lean_policy(training.path / "policy", target, about)
    load_policy(target)
    return target


def curve(training: Training) -> Curve:
    """How a training went, at about `POINTS` of its iterations."""
    lines = (training.path / "train" / "results.jsonl").read_text().splitlines()
    rows = [json.loads(line) for line in lines]
    rows = [row for row in rows if row["train/success_rate"] is not None]
    kept = np.unique(np.linspace(0, len(rows) - 1, min(POINTS, len(rows))).astype(int))
    values = [
        [row[name] for name in ("env_steps", "train/success_rate", "train/distance_m")]
        for row in (rows[k] for k in kept)
    ]
    env_steps, success, distance_m = np.array(values, float).reshape(-1, 3).T
    return Curve(training.group, training.seed, env_steps, success, distance_m)
