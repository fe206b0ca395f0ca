"""Copy trained policies into models/pretrained, and draw their learning curves.

Run: make train-all, which trains every policy and ends with this; or python -m platform.launch +exp=publish
Expect: seconds. In models/pretrained a folder <group>-s<seed> for the newest training of each experiment,
length and seed in `runs_dir` with the configured budget, 0.1 to 2 megabytes each (weights in float16, no
decoder), and `curves.csv`; in docs/images `learning.png`. Policies published earlier stay. A group is named
after its experiment; if its training does not have the usual length for comparisons, thousands of steps are
appended: bytestream_1500k. Each policy becomes a version in MLflow's model registry.
"""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from envs.config import settings_hash
from jobs.analysis.plots import Curve, plot_learning_curves
from jobs.analysis.tables import save_plot
from jobs.config.config import Config, ConfigError
from jobs.rollout.policies import PRETRAINED
from jobs.run.files import read_json, read_json_lines, write_atomic
from jobs.run.folder import group_name, open_run
from jobs.run.progress import console
from jobs.run.provenance import REPOSITORY
from jobs.tools.curves import as_csv, by_reward, read_curves
from jobs.tracking.model_registry import register_training
from jobs.tracking.tracker import open_tracker
from models.policy import load_policy
from models.policy.policy import save_lean_policy

PLOT = REPOSITORY / "docs" / "images" / "learning.png"
MAX_POINTS = 50  # of a curve
STAGES = ("collect", "pretrain", "train")


@dataclass(frozen=True)
class Training:
    """A finished training: its run folder, group, seed, and provenance."""

    path: Path
    group: str
    seed: int
    about: dict[str, object]

    @property
    def name(self) -> str:
        """Return the folder name of the published policy."""
        return f"{self.group}-s{self.seed}"


def run(config: Config) -> dict[str, int]:
    """Publish the finished trainings; return group -> their number.

    Raises:
        ConfigError: There is no finished training, or the budget is too small to learn anything.
    """
    if config.budget == "smoke":
        raise ConfigError("budget: smoke learns nothing, and would replace what is published; choose another")
    runs_dir = Path(config.runs_dir).resolve()
    trainings = newest_trainings(runs_dir, config.budget)
    if not trainings:
        raise ConfigError(f"runs_dir: no finished training with budget={config.budget} in {str(runs_dir)!r}")
    for training in trainings:
        target = publish(training, PRETRAINED)
        size = sum(file.stat().st_size for file in target.iterdir())
        console.print(f"{target.relative_to(REPOSITORY)}: {size / 1024:,.0f} KiB")
    published = read_curves(PRETRAINED)  # includes trainings without a run folder on this machine
    published |= {(training.group, training.seed): learning_curve(training) for training in trainings}
    curves = [published[key] for key in sorted(published)]
    write_atomic(PRETRAINED / "curves.csv", as_csv(curves))
    plot = plot_learning_curves(by_reward(PRETRAINED, curves))
    save_plot(PLOT, plot)
    folder = open_run(config)
    with open_tracker(folder.config, folder) as tracker:
        tracker.figure("train/learning.png", plot)
        tracker.text("train/curves.csv", as_csv(curves))
        for training in trainings:
            register_training(tracker.of(training.path), training.path)
    return dict(Counter(training.group for training in trainings))


def newest_trainings(runs_dir: Path, budget: str) -> list[Training]:
    """Return the latest finished training of each group and seed, sorted by these."""
    found: dict[tuple[str, int], Training] = {}
    markers = sorted(runs_dir.glob("*/stages/train.json"), key=lambda marker: marker.stat().st_mtime_ns)
    for marker in markers:
        path = marker.parent.parent
        config = read_json(path / "config.json")
        if config["budget"] != budget or not (path / "policy" / "policy.json").is_file():
            continue
        group, seed = group_name(config), int(config["seed"])
        about = {
            "exp": group,
            "run": path.name,
            "commit": read_json(marker)["commit"],
            "made_by": made_by(path),
            "config_hash": settings_hash(config),
            **{name: config[name] for name in ("train", "pretrain", "collect")},
        }
        found[group, seed] = Training(path, group, seed, about)
    return [found[key] for key in sorted(found)]


def made_by(run: Path) -> dict[str, dict[str, object]]:
    """Return stage -> commit and device of a run; they differ if the encoder is older than the policy."""
    markers = {stage: run / "stages" / f"{stage}.json" for stage in STAGES}
    found = {stage: read_json(marker) for stage, marker in markers.items() if marker.is_file()}
    return {stage: {"commit": own["commit"], "device": own.get("device")} for stage, own in found.items()}


def publish(training: Training, folder: Path) -> Path:
    """Write a training's policy into `folder`, with provenance in the manifest; return the policy folder."""
    target = folder / training.name
    save_lean_policy(training.path / "policy", target, training.about)
    load_policy(target)
    return target


def learning_curve(training: Training) -> Curve:
    """Return success and distance of a training at no more than `MAX_POINTS` of its iterations."""
    lines = read_json_lines(training.path / "train" / "results.jsonl")
    rows = [row for row in lines if row["train/success_rate"] is not None]
    kept = np.unique(np.linspace(0, len(rows) - 1, min(MAX_POINTS, len(rows))).astype(int))
    names = ("env_steps", "train/success_rate", "train/distance_m")
    values = [[rows[place][name] for name in names] for place in kept]
    return Curve(training.group, training.seed, *np.array(values, float).reshape(-1, 3).T)
