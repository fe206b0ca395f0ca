"""A store with an evaluated training and a sweep, as a dashboard shows them, in seconds."""

import dataclasses

import numpy as np

from jobs import pipeline
from jobs.rollout.episodes import EPISODE
from jobs.rollout.store import PartResult, SimulationAccuracy
from jobs.run.folder import Run, finish, open_run
from jobs.study.study import run as run_study
from tests.support.configs import sweep_config
from tests.support.fake_executor import FakeExecutor
from tests.support.policies import save_training


def crashed(part):
    """The policy hits something everywhere, a baseline nowhere."""
    episodes = np.zeros(len(part.task.seeds), EPISODE)
    episodes["seed"], episodes["distance_m"] = part.task.seeds, 50.0
    episodes["collision"] = part.task.policy.training is not None
    episodes["success"] = ~episodes["collision"]
    return PartResult(episodes, {}, SimulationAccuracy(0.01, 3.0))


def evaluated_training(config) -> Run:
    """A pipeline whose training is done, evaluated and registered by its job."""
    evaluation = dataclasses.replace(config.evaluate, episodes=2, renderers=["raycast"])
    config = dataclasses.replace(config, job="pipeline", exp="bytestream", evaluate=evaluation)
    folder = open_run(config)
    save_training(folder.policy, "bytestream", 0, config.env, "bytestream")
    for stage in ("collect", "pretrain", "train"):
        finish(folder, stage, {"train/success_rate": 0.5} if stage == "train" else {})
    pipeline.run(config)
    return folder


def fill(place):
    """Make `mlflow.db` in a folder; returns the sweep's configuration and the training's folder."""
    axes = {"control_hz": {"env.control_hz": [100, 200]}, "sparsity": {"faults.sparsity": [0.0, 0.5]}}
    config = sweep_config(place, policies=["straight"], reference="straight", axes=axes)
    folder = evaluated_training(config)
    settings = dataclasses.replace(config.own, policies=[str(folder.policy), "straight"])
    run_study(dataclasses.replace(config, own=settings), FakeExecutor(crashed))
    return config, folder
