import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import ray
import torch

from jobs.rollout.episodes import roll_out
from jobs.run.files import json_lines
from jobs.run.folder import finish, open_run
from jobs.run.ray_cluster import start_ray
from jobs.run.torch_threads import torch_threads
from jobs.tools.search import search, trial
from jobs.tools.search.space import read_settings, search_space
from jobs.tools.search.trial import SearchTrial
from jobs.tracking.tracker import open_store
from tests.support.configs import tune_config
from tests.support.runs import trial_storage, write_encoder

SMALL = (
    *("budget=smoke", "env.time_limit_s=0.1", "algo.num_envs_per_env_runner=2"),
    *("algo.train_batch_size_per_learner=64", "algo.minibatch_size=32", "train.env_steps=256"),
    *("search.report_steps=64", "search.trials=3", "~search.space"),
    "+search.space={algo.lr: {low: 1.0e-4, high: 1.0e-2, log: true}, model.hidden: [[8], [16, 16]]}",
)


def row(trial, env_steps, distance_m, **settings):
    metrics = {"train/entropy": 1.0 / env_steps}
    figures = {"distance_m": distance_m, "success_rate": 0.5, "metrics": metrics}
    return {"trial": trial, "env_steps": env_steps, "settings": settings, **figures}


ROWS = [row("a", 10, 5.0), row("b", 10, 9.0), row("a", 30, 7.0), row("c", 30, 8.0), row("d", 10, 1.0)]


def test_those_that_were_trained_longest_come_first_then_the_best():
    assert [one["trial"] for one in search.ranked(ROWS)] == ["c", "a", "b", "d"]
    assert [one["env_steps"] for one in search.of_trial(ROWS[::-1], "a")] == [10, 30]


def test_a_child_run_has_the_curves_of_its_trial_and_its_numbers_as_metrics_too():
    settings = {"algo.lr": 0.1, "model.hidden": [8]}
    child = search.child_run([row("a", 10, 5.0, **settings), row("a", 30, 7.0, **settings)])
    assert child.curves["tune/distance_m"] == {10: 5.0, 30: 7.0}
    assert child.curves["train/entropy"] == {10: 0.1, 30: 1.0 / 30}
    assert child.metrics == {"tune/algo.lr": 0.1}
    assert child.params == {"algo.lr": 0.1, "model.hidden": [8]}


def test_the_words_of_settings_can_be_given_to_the_launcher():
    said = search.words({"algo.lr": 0.000312345, "model.hidden": [64, 64]})
    assert said == "algo.lr=0.0003123 'model.hidden=[64,64]'"


def test_a_finished_search_takes_more_trials(tmp_path):
    config = dataclasses.replace(tune_config(*SMALL), runs_dir=str(tmp_path / "runs"))
    folder, fewer = open_run(config), dataclasses.replace(config.own, trials=2)
    assert search.earlier_trials(folder, config.own) == search.Earlier()
    tried = [{"algo.lr": 1e-3, "model.hidden": [8]}, {"algo.lr": 2e-3, "model.hidden": [16, 16]}]
    rows = [row("a", 64, 1.0, **tried[0]), row("b", 64, 2.0, **tried[1])]
    file = folder.path / search.place_name(fewer) / "results.jsonl"
    file.parent.mkdir()
    file.write_text(json_lines(rows))
    assert search.earlier_trials(folder, config.own) == search.Earlier()  # not finished
    finish(folder, file.parent.name, {})
    begun = search.earlier_trials(folder, config.own)
    assert (begun.trials, list(begun.rows)) == (2, rows)
    assert search.earlier_trials(folder, fewer) == search.Earlier()
    optuna = search._optuna(config, begun)
    optuna.set_search_properties("distance_m", "max", search_space(config.own.space))
    assert [trial.value for trial in optuna._ot_study.trials] == [1.0, 2.0]
    assert read_settings(optuna.suggest("c")) not in tried


class Diverging:
    """A training that notes how many threads it has."""

    def __init__(self, config):
        self.threads = [torch.get_num_threads()]

    def train(self):
        self.threads.append(torch.get_num_threads())
        raise ValueError("losses must be finite")

    def save_checkpoint(self, checkpoint_dir):
        Path(checkpoint_dir, "weights").write_bytes(b"w")


@pytest.fixture
def a_trial(tmp_path, monkeypatch):
    """One of such a training, which Tune keeps."""
    algorithm = SimpleNamespace(build=lambda *asked: None, trainable=lambda config: Diverging)
    monkeypatch.setattr(trial, "algorithm_of", lambda config: algorithm)
    one = SearchTrial.__new__(SearchTrial)
    one.__dict__.update(_logdir=str(tmp_path / "log"), _storage=trial_storage(tmp_path))
    return one


def test_a_trial_takes_one_thread_and_gives_the_others_back(a_trial):
    with torch_threads(3):
        a_trial.setup({}, base=tune_config(*SMALL, "model=event_columns"), files={})
        assert torch.get_num_threads() == 3
        assert a_trial.step()["diverged"] == 1.0
        assert (a_trial._training.threads, torch.get_num_threads()) == ([1, 1], 3)


def test_a_measurement_leaves_nothing_beside_the_checkpoints_even_if_it_was_killed(
    a_trial, tmp_path, monkeypatch
):
    place, made_in = tmp_path / "train" / "trial", []
    (place / ".checkpoint-killed" / "checkpoint").mkdir(parents=True)
    a_trial.setup({}, base=tune_config(*SMALL, "model=event_columns"), files={})
    assert not list(place.iterdir())

    def exported(asked, checkpoint, encoder, target, figures):
        assert (checkpoint / "weights").read_bytes() == b"w"
        made_in.append(checkpoint.parents[1])

    monkeypatch.setattr(trial, "export_policy", exported)
    monkeypatch.setattr(trial, "make_agent", lambda *asked: None)
    told = np.array([(1.0, True)], [("distance_m", float), ("success", bool)])
    monkeypatch.setattr(trial, "roll_out", lambda *asked: told)
    assert a_trial.measured() == {"distance_m": 1.0, "success_rate": 1.0}
    assert made_in == [place]
    assert not list(place.iterdir())


@pytest.fixture
def a_ray(tmp_path):
    start_ray(tune_config("cluster.num_cpus=2").cluster, tmp_path)
    yield
    ray.shutdown()


@pytest.mark.system
def test_a_trial_is_measured_in_validation_corridors_and_goes_on_from_its_checkpoint(
    a_ray, tmp_path, monkeypatch
):
    config = tune_config(*SMALL, "model=bytestream")
    path = write_encoder(tmp_path, config)
    files = {file.name: file.read_bytes() for file in (path, path.with_suffix(".json"))}
    seen = []

    def watched(agent, env, seeds, num_envs):
        seen.append((env.split, list(seeds), env))
        return roll_out(agent, env, seeds, num_envs)

    monkeypatch.setattr(trial, "roll_out", watched)
    sampled = {"algo.lr": 1e-3, "model.hidden": "[8]"}

    def made():
        one = SearchTrial.__new__(SearchTrial)
        one.__dict__["_logdir"] = str(tmp_path)
        one.setup(dict(sampled), base=config, files=files)
        return one

    whole = made()
    assert whole.step()["done"] is False
    whole.save_checkpoint(str(tmp_path / "checkpoint"))
    rest = [whole.step() for _ in range(3)]
    assert rest[-1]["done"] is True
    again = made()
    again.load_checkpoint(str(tmp_path / "checkpoint"))

    def told(result):
        return {**result, "metrics": {key: x for key, x in result["metrics"].items() if key[:4] != "perf"}}

    assert json.dumps(told(again.step())) == json.dumps(told(rest[0]))
    assert {(split, tuple(seeds)) for split, seeds, _ in seen} == {("validation", (0, 1))}
    assert {dataclasses.replace(env, split="train").scene for _, _, env in seen} == {config.env.scene}
    for one in (whole, again):
        one.cleanup()


@pytest.mark.system
def test_a_search_is_recorded_and_the_same_command_repeats_nothing(tmp_path):
    words = *SMALL, "model=event_columns", f"runs_dir={tmp_path / 'runs'}", "cluster.num_cpus=2"
    config = tune_config(*words, f"tracking.uri=sqlite:///{tmp_path}/m.db")
    try:
        figures = search.run(config)
        assert search.run(config) == figures
    finally:
        ray.shutdown()
    (place,) = (tmp_path / "runs").glob("*/tune-*/")
    rows = [json.loads(line) for line in (place / "results.jsonl").read_text().splitlines()]
    assert len({row["trial"] for row in rows}) == 3
    assert len({(row["trial"], row["env_steps"]) for row in rows}) == len(rows)
    assert max(row["env_steps"] for row in rows) == 256
    client, experiment = open_store(config.tracking.uri, config.tracking.experiment)
    (parent,) = client.search_runs([experiment], "tags.kind = 'tune'")
    children = client.search_runs([experiment], f"tags.`mlflow.parentRunId` = '{parent.info.run_id}'")
    assert {child.info.run_name for child in children} == {f"trial {row['trial']}" for row in rows}
    for child in children:
        own = [row for row in rows if f"trial {row['trial']}" == child.info.run_name]
        curve = client.get_metric_history(child.info.run_id, "tune/distance_m")
        assert {p.step: p.value for p in curve} == {row["env_steps"]: row["distance_m"] for row in own}
