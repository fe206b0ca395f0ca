import dataclasses
import errno
import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

from envs.config import settings_hash
from jobs.config.config import Config, ConfigError, as_dict, parse
from jobs.config.env_keys import env_with
from jobs.run.files import RunError, read_json, write_json
from jobs.run.folder import finish, finished, latest_policies, open_run, run_name
from jobs.run.identity import ADDED_SETTINGS, TRAINED_BY, identity
from jobs.run.locks import held_alone
from jobs.run.provenance import REPOSITORY, git_commit
from models.kinds import KINDS, RENAMED
from tests.support.configs import small_config


@pytest.fixture
def config(tmp_path: Path) -> Config:
    return small_config(tmp_path)


def test_the_same_settings_find_the_same_folder_whatever_job_tracker_or_cluster(config):
    elsewhere = dataclasses.replace(
        config,
        job="evaluate",
        tracking=dataclasses.replace(config.tracking, uri="http://localhost:1"),
        cluster=dataclasses.replace(config.cluster, num_cpus=7),
    )
    assert open_run(config).path == open_run(elsewhere).path
    assert open_run(config).path.name.startswith("bytestream-smoke-s0-")


def test_every_setting_that_changes_results_changes_the_folder(config):
    noisy = env_with(config.env, {"faults.sparsity": 0.1})
    names = {
        run_name(config),
        run_name(dataclasses.replace(config, seed=1)),
        run_name(dataclasses.replace(config, algo=dataclasses.replace(config.algo, lr=1e-5))),
        run_name(dataclasses.replace(config, env=noisy)),
    }
    assert len(names) == 4


def test_resume_flies_the_stored_settings_under_the_job_that_is_asked_for(config):
    stored = open_run(config)
    other = dataclasses.replace(config, seed=5, job="evaluate", resume=str(stored.path))
    run = open_run(other)
    assert run.path == stored.path
    assert (run.config.seed, run.config.job) == (config.seed, "evaluate")
    assert run.config.algo == config.algo


def test_resume_of_a_folder_without_a_run_says_what_a_run_folder_is(config, tmp_path):
    with pytest.raises(ConfigError, match=r"resume: must be a run folder \(one that holds config.json\)"):
        open_run(dataclasses.replace(config, resume=str(tmp_path)))


def test_a_stage_is_finished_once_its_figures_are_written(config):
    run = open_run(config)
    assert finished(run, "train") is None
    finish(run, "train", {"eval/success_rate": 0.5})
    assert finished(run, "train") == {"eval/success_rate": 0.5}
    assert finished(run, "collect") is None


def test_a_marker_with_nan_is_refused_and_leaves_no_file(config):
    run = open_run(config)
    with pytest.raises(ValueError, match="JSON compliant"):
        finish(run, "train", {"loss": float("nan")})
    assert finished(run, "train") is None
    assert not list(run.path.glob("stages/*"))


def test_the_latest_policy_of_a_kind_is_the_one_finished_last(tmp_path):
    assert latest_policies(tmp_path) == {}
    for name, kind in (("a", "bytestream"), ("c", "bytestream"), ("b", "bytestream"), ("e", "rgb")):
        write_json(tmp_path / name / "policy" / "policy.json", {"name": kind})
        time.sleep(0.01)
    (tmp_path / "d" / "policy").mkdir(parents=True)
    newest = {"bytestream": tmp_path / "b" / "policy", "rgb": tmp_path / "e" / "policy"}
    assert latest_policies(tmp_path) == newest


def test_the_stored_configuration_is_readable_as_yaml_and_json(config):
    import yaml

    run = open_run(config)
    assert yaml.safe_load((run.path / "config.yaml").read_text()) == read_json(run.path / "config.json")


def test_a_damaged_marker_is_named_with_its_remedy(config):
    run = open_run(config)
    finish(run, "train", {})
    (run.path / "stages" / "train.json").write_text('{"fig')
    with pytest.raises(
        RunError, match=r"train\.json: must be JSON, got a damaged file .*; delete it, and the same"
    ):
        finished(run, "train")


def test_a_full_disk_leaves_the_old_file_and_no_part(config, monkeypatch):
    run = open_run(config)
    finish(run, "train", {"loss": 1.0})

    def full(handle):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        finish(run, "train", {"loss": 2.0})
    assert finished(run, "train") == {"loss": 1.0}
    assert [path.name for path in (run.path / "stages").iterdir()] == ["train.json"]


@pytest.mark.system
def test_one_process_works_in_a_run_folder_and_lets_go_when_it_is_killed(config):
    run = open_run(config)
    code = f"""
import sys
from pathlib import Path
from jobs.run.identity import ADDED_SETTINGS, TRAINED_BY, identity
from jobs.run.locks import held_alone
with held_alone(Path({str(run.path)!r})):
    print("in", flush=True)
    sys.stdin.read()
"""
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=REPOSITORY) as other:
        other.stdout.readline()
        with (
            pytest.raises(RunError, match=rf"process {other.pid} of .* works there; wait until"),
            held_alone(run.path),
        ):
            pass
        other.kill()
    with held_alone(run.path):
        pass


def test_without_git_the_commit_is_unknown(monkeypatch):
    monkeypatch.setenv("PATH", "")
    assert git_commit() == "unknown"


def test_a_run_folder_outlives_settings_that_came_later_under_its_old_name(config):
    run = open_run(config)
    stored = read_json(run.path / "config.json")
    for section, added in ADDED_SETTINGS.items():
        for name in added.keys() & stored[section].keys():
            del stored[section][name]
    write_json(run.path / "config.json", stored)
    assert open_run(dataclasses.replace(config, resume=str(run.path))).config.train == config.train
    first = {name: stored[name] for name in TRAINED_BY}
    jobs = {name: value for name, value in identity(config).items() if name in ("replay", "video")}
    assert run.path.name.endswith(settings_hash(first | jobs)[:8])
    noisy = dataclasses.replace(config.train, conditions=[{"faults.sparsity": 0.5}])
    assert run_name(dataclasses.replace(config, train=noisy)) != run.path.name


@pytest.mark.parametrize(("old", "new"), RENAMED.items())
def test_a_run_folder_of_a_model_that_was_renamed_is_not_continued_and_says_its_new_name(config, old, new):
    assert new in KINDS
    run = open_run(config)
    stored = read_json(run.path / "config.json")
    stored["model"]["name"] = old
    write_json(run.path / "config.json", stored)
    with pytest.raises(ConfigError, match=rf"^resume: .* {old}, .* {new} now") as error:
        open_run(dataclasses.replace(config, resume=str(run.path)))
    assert len(str(error.value).splitlines()) == 1


def test_a_run_folder_with_null_for_what_its_model_does_not_have_is_continued(config):
    values = {**as_dict(config), "model": {"name": "event_columns", "stack": 3, "hidden": [64, 64]}}
    run = open_run(parse(values))
    stored = read_json(run.path / "config.json")
    stored["model"] |= {"context": None, "latent": None, "encoder": None}
    write_json(run.path / "config.json", stored)
    again = open_run(dataclasses.replace(config, resume=str(run.path)))
    assert again.config.model == run.config.model


def test_the_stored_groups_are_those_of_the_command_line_so_that_older_folders_keep_their_names(config):
    stored = json.loads((open_run(config).path / "config.json").read_text())
    assert list(stored)[:11] == [
        "job", "exp", "budget", "seed", "resume", "runs_dir",
        "env", "camera", "faults", "renderer", "fidelity",
    ]  # fmt: skip
    assert set(stored["env"]) == {
        "scene", "layout", "control_hz", "speed_mps", "vehicle", "body", "task", "action_delay_ms",
        "velocity_noise_mps",
        "vehicle_radius_m", "camera_height_m", "time_limit_s", "window_capacity",
        "filter_support", "filter_tau_us",
    }  # fmt: skip


def test_a_run_folder_outlives_changes_of_what_acts_after_training(config):
    run = open_run(config)
    stored = read_json(run.path / "config.json")
    stored["sweep"] = {"axes": "of another version"}
    stored["a_job_of_another_version"] = {"trials": 3}
    write_json(run.path / "config.json", stored)
    again = open_run(dataclasses.replace(config, resume=str(run.path), seed=7))
    assert again.config == dataclasses.replace(config, resume=str(run.path))
    del stored["algo"]
    write_json(run.path / "config.json", stored)
    with pytest.raises(ConfigError, match="algo: must be a group of settings"):
        open_run(dataclasses.replace(config, resume=str(run.path)))


def test_a_folder_that_cannot_be_written_is_refused_before_anything_is_made(config, tmp_path):
    (tmp_path / "file").write_text("")
    for runs_dir in ("/proc/nope/runs", str(tmp_path / "file" / "runs")):
        with pytest.raises(ConfigError, match=r"^runs_dir: must be in a folder that you can write, "):
            open_run(dataclasses.replace(config, runs_dir=runs_dir))
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
