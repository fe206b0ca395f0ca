import dataclasses
import errno
import time
from pathlib import Path

import pytest
import yaml

from jobs.config.config import Config, ConfigError, as_dict, parse
from jobs.config.env_keys import env_with
from jobs.run.files import RunError, read_json, write_json
from jobs.run.folder import finish, finished, latest_policies, open_run, run_name
from jobs.run.provenance import git_commit
from models.kinds import KINDS, RENAMED
from tests.support.configs import small_config


@pytest.fixture
def config(tmp_path: Path) -> Config:
    return small_config(tmp_path)


@pytest.fixture
def run(config):
    return open_run(config)


def resumed(run, **changes):
    return open_run(dataclasses.replace(run.config, resume=str(run.path), **changes))


def stored_with(run, **changes):
    """Change the groups of the stored configuration; those that become None go."""
    stored = {**read_json(run.path / "config.json"), **changes}
    write_json(run.path / "config.json", {name: part for name, part in stored.items() if part is not None})


def test_the_folder_is_the_same_unless_a_setting_changes_results(config):
    elsewhere = dataclasses.replace(
        config,
        job="evaluate",
        tracking=dataclasses.replace(config.tracking, uri="http://localhost:1"),
        cluster=dataclasses.replace(config.cluster, num_cpus=7),
    )
    assert open_run(config).path == open_run(elsewhere).path
    assert open_run(config).path.name.startswith("bytestream-smoke-s0-")
    others = {
        "seed": 1,
        "algo": dataclasses.replace(config.algo, lr=1e-5),
        "env": env_with(config.env, {"faults.sparsity": 0.1}),
        "train": dataclasses.replace(config.train, conditions=[{"faults.sparsity": 0.5}]),
    }
    names = {run_name(dataclasses.replace(config, **{name: part})) for name, part in others.items()}
    assert len(names | {run_name(config)}) == 5


def test_resume_flies_the_stored_settings_under_the_job_that_is_asked_for(run):
    again = resumed(run, seed=5, job="evaluate")
    assert again.path == run.path
    assert (again.config.seed, again.config.job) == (run.config.seed, "evaluate")
    assert again.config.algo == run.config.algo


def test_resume_of_a_folder_without_a_run_says_what_a_run_folder_is(config, tmp_path):
    with pytest.raises(ConfigError, match=r"resume: must be a run folder \(one that holds config.json\)"):
        open_run(dataclasses.replace(config, resume=str(tmp_path)))


def test_a_stage_is_finished_once_its_figures_are_written_and_they_are_numbers(run):
    with pytest.raises(ValueError, match="JSON compliant"):
        finish(run, "train", {"loss": float("nan")})
    assert finished(run, "train") is None
    assert not list(run.path.glob("stages/*"))
    finish(run, "train", {"eval/success_rate": 0.5})
    assert finished(run, "train") == {"eval/success_rate": 0.5}
    assert finished(run, "collect") is None


def test_the_latest_policy_of_a_kind_is_the_one_finished_last(tmp_path):
    assert latest_policies(tmp_path) == {}
    for name, kind in (("a", "bytestream"), ("c", "bytestream"), ("b", "bytestream"), ("e", "rgb")):
        write_json(tmp_path / name / "policy" / "policy.json", {"name": kind})
        time.sleep(0.01)
    (tmp_path / "d" / "policy").mkdir(parents=True)
    newest = {"bytestream": tmp_path / "b" / "policy", "rgb": tmp_path / "e" / "policy"}
    assert latest_policies(tmp_path) == newest


def test_the_stored_configuration_is_readable_as_yaml_and_json(run):
    assert yaml.safe_load((run.path / "config.yaml").read_text()) == read_json(run.path / "config.json")


def test_a_damaged_marker_is_named_with_its_remedy(run):
    finish(run, "train", {})
    (run.path / "stages" / "train.json").write_text('{"fig')
    rule = r"train\.json: must be JSON, got a damaged file .*; delete it, and the same"
    with pytest.raises(RunError, match=rule):
        finished(run, "train")


def test_a_full_disk_leaves_the_old_file_and_no_part(run, monkeypatch):
    finish(run, "train", {"loss": 1.0})

    def full(handle):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        finish(run, "train", {"loss": 2.0})
    assert finished(run, "train") == {"loss": 1.0}
    assert [path.name for path in (run.path / "stages").iterdir()] == ["train.json"]


def test_without_git_the_commit_is_unknown(monkeypatch):
    monkeypatch.setenv("PATH", "")
    assert git_commit() == "unknown"


@pytest.mark.parametrize(("old", "new"), RENAMED.items())
def test_a_run_folder_of_a_model_that_was_renamed_is_not_continued_and_says_its_new_name(run, old, new):
    assert new in KINDS
    stored_with(run, model={**read_json(run.path / "config.json")["model"], "name": old})
    with pytest.raises(ConfigError, match=rf"^resume: .* {old}, .* {new} now") as error:
        resumed(run)
    assert len(str(error.value).splitlines()) == 1


def test_a_run_folder_with_null_for_what_its_model_does_not_have_is_continued(config):
    model = {"name": "event_columns", "stack": 3, "hidden": [64, 64]}
    run = open_run(parse({**as_dict(config), "model": model}))
    stored = read_json(run.path / "config.json")["model"]
    stored_with(run, model={**stored, "context": None, "latent": None, "encoder": None})
    assert resumed(run).config.model == run.config.model


def test_a_run_folder_outlives_changes_of_what_acts_after_training(run):
    stored_with(run, sweep={"axes": "of another version"}, a_job_of_another_version={"trials": 3})
    assert resumed(run, seed=7).config == dataclasses.replace(run.config, resume=str(run.path))
    stored_with(run, algo=None)
    with pytest.raises(ConfigError, match="algo: must be a group of settings"):
        resumed(run)


def test_a_folder_that_cannot_be_written_is_refused_before_anything_is_made(config, tmp_path):
    (tmp_path / "file").write_text("")
    for runs_dir in ("/proc/nope/runs", str(tmp_path / "file" / "runs")):
        with pytest.raises(ConfigError, match=r"^runs_dir: must be in a folder that you can write, "):
            open_run(dataclasses.replace(config, runs_dir=runs_dir))
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
