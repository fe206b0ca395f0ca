import csv
import json
import os

import numpy as np
import pytest
from mlflow import MlflowClient

from jobs.config.config import ConfigError, as_dict
from jobs.tools import publish as publishing
from jobs.tools.curves import as_csv, read_curves
from jobs.tools.publish import learning_curve, newest_trainings, publish
from models.policy import load_policy
from tests.support.configs import small_config
from tests.support.policies import HELD_OUT, save_training


def finish_training(
    tmp_path, name, exp="bytestream", seed=0, env_steps=500_000, policy="event_columns", **changes
):
    """A run folder as a finished training leaves it."""
    folder = tmp_path / "runs" / name
    values = as_dict(small_config(tmp_path, exp=exp, seed=seed, **changes))
    values["train"]["env_steps"] = env_steps
    save_training(folder / "policy", exp, seed, HELD_OUT, policy)
    (folder / "train").mkdir()
    (folder / "stages").mkdir()
    (folder / "config.json").write_text(json.dumps(values))
    rows = [
        {"env_steps": 2048 * (k + 1), "train/success_rate": k / 120 or None, "train/distance_m": 1.0 * k}
        for k in range(120)
    ]
    (folder / "train" / "results.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (folder / "stages" / "train.json").write_text(json.dumps({"figures": {}, "commit": "abc"}))
    return folder


def test_the_newest_training_of_each_group_and_seed_is_taken(tmp_path):
    for order, name in enumerate(("old", "new")):
        marker = finish_training(tmp_path, name) / "stages" / "train.json"
        os.utime(marker, ns=(order, order))
    finish_training(tmp_path, "long", env_steps=1_500_000)
    finish_training(tmp_path, "other", seed=3)
    finish_training(tmp_path, "rival", exp="event_set")
    finish_training(tmp_path, "tried", exp="rgb", budget="short")
    (finish_training(tmp_path, "unfinished", exp="rgb") / "stages" / "train.json").unlink()
    found = newest_trainings(tmp_path / "runs", "smoke")
    assert [(one.group, one.seed, one.path.name) for one in found] == [
        ("bytestream", 0, "new"),
        ("bytestream", 3, "other"),
        ("bytestream_1500k", 0, "long"),
        ("event_set", 0, "rival"),
    ]


def test_a_published_policy_decides_nearly_as_the_trained_one_in_a_fraction_of_the_space(tmp_path):
    finish_training(tmp_path, "run", policy="bytestream")
    (training,) = newest_trainings(tmp_path / "runs", "smoke")
    target = publish(training, tmp_path / "pretrained")
    assert target.name == "bytestream-s0"
    manifest = json.loads((target / "policy.json").read_text())
    assert (manifest["exp"], manifest["run"], manifest["commit"]) == ("bytestream", "run", "abc")
    folders = target, training.path / "policy"
    small, large = (sum(file.stat().st_size for file in folder.iterdir()) for folder in folders)
    assert small < large / 20
    lean, whole = load_policy(target), load_policy(training.path / "policy")
    windows = np.zeros((1, 4097, 4), np.int32)
    windows[0, :3] = [2, 0, 5000, 0], [1000, 20, 30, 1], [4000, 40, 30, -1]
    ours, theirs = lean.logits(windows), whole.logits(windows)
    assert not np.array_equal(ours, theirs)
    np.testing.assert_allclose(ours, theirs, atol=0.01 * np.abs(theirs).max())
    publish(training, tmp_path / "pretrained")  # a second time replaces it


def test_a_curve_keeps_both_ends_and_the_order_and_leaves_out_what_was_not_measured(tmp_path):
    finish_training(tmp_path, "run")
    one = learning_curve(newest_trainings(tmp_path / "runs", "smoke")[0])
    assert len(one.env_steps) == publishing.MAX_POINTS
    assert (one.env_steps[0], one.env_steps[-1]) == (2 * 2048, 120 * 2048)
    assert (np.diff(one.env_steps) > 0).all()
    np.testing.assert_allclose(one.success_rate, (one.env_steps / 2048 - 1) / 120)
    rows = list(csv.DictReader(as_csv([one]).splitlines()))
    assert len(rows) == publishing.MAX_POINTS
    assert list(rows[-1]) == ["exp", "seed", "env_steps", "success_rate", "distance_m"]
    assert list(rows[-1].values()) == ["bytestream", "0", str(120 * 2048), "0.992", "119.00"]


def test_curves_are_read_back_as_written_if_their_policies_are_still_there(tmp_path):
    finish_training(tmp_path, "run")
    finish_training(tmp_path, "other", exp="event_set", seed=3)
    finish_training(tmp_path, "gone", exp="rgb")
    trainings = newest_trainings(tmp_path / "runs", "smoke")
    assert read_curves(tmp_path) == {}
    (tmp_path / "curves.csv").write_text(as_csv([learning_curve(training) for training in trainings]))
    for training in trainings:
        if training.group != "rgb":
            publish(training, tmp_path)
    found = read_curves(tmp_path)
    assert list(found) == [("bytestream", 0), ("event_set", 3)]
    kept = [training for training in trainings if training.group != "rgb"]
    assert as_csv(list(found.values())) == as_csv([learning_curve(training) for training in kept])


@pytest.mark.parametrize(
    ("budget", "rule"),
    [
        ("paper", "runs_dir: no finished training with budget=paper in"),
        ("smoke", "budget: smoke learns nothing"),
    ],
)
def test_without_trainings_that_learn_there_is_nothing_to_publish(tmp_path, budget, rule):
    finish_training(tmp_path, "run")
    with pytest.raises(ConfigError, match=rule):
        publishing.run(small_config(tmp_path, job="publish", exp="ship", budget=budget))


@pytest.mark.system  # it fills a store, which takes seconds
def test_the_job_writes_policies_curves_and_their_plot(tmp_path, monkeypatch):
    monkeypatch.setattr(publishing, "PRETRAINED", publishing.REPOSITORY / tmp_path / "pretrained")
    monkeypatch.setattr(publishing, "REPOSITORY", tmp_path)
    monkeypatch.setattr(publishing, "PLOT", tmp_path / "learning.png")
    for seed in (0, 1):
        finish_training(tmp_path, f"run{seed}", seed=seed, budget="paper")
    finish_training(tmp_path, "rival", exp="event_set", budget="paper")
    published = publishing.run(small_config(tmp_path, job="publish", exp="ship", budget="paper"))
    assert published == {"bytestream": 2, "event_set": 1}
    names = sorted(path.name for path in (tmp_path / "pretrained").iterdir())
    assert names == ["bytestream-s0", "bytestream-s1", "curves.csv", "event_set-s0"]
    assert (tmp_path / "learning.png").stat().st_size > 10_000
    client = MlflowClient(f"sqlite:///{tmp_path / 'mlflow.db'}")
    versions = client.search_model_versions("name = 'evade-bytestream'")
    assert sorted(version.tags["seed"] for version in versions) == ["0", "1"]
    assert {version.tags["commit"] for version in versions} == {"abc"}


def test_a_published_policy_says_which_commit_and_device_made_each_stage(tmp_path):
    """An encoder may come from an older commit and from a GPU, of which the last stage says nothing."""
    path = finish_training(tmp_path, "run")
    older = {"commit": "older", "device": "cuda"}
    (path / "stages" / "pretrain.json").write_text(json.dumps({"figures": {}, **older}))
    (training,) = newest_trainings(tmp_path / "runs", "smoke")
    manifest = load_policy(publish(training, tmp_path / "published")).manifest
    assert manifest["made_by"] == {"pretrain": older, "train": {"commit": "abc", "device": None}}
