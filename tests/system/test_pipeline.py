import fnmatch
import json
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
from mlflow import MlflowClient

from envs.config import EnvConfig
from envs.corridor import CorridorEnv
from models.policy import load_policy
from tests.support.faults import launch as start_job
from tests.support.sockets import check_ray, listening
from tests.support.started import ROOT, said

# One run serves most tests of this file; make gives each worker whole files.
pytestmark = pytest.mark.system
SECTIONS = ("evae/", "train/", "eval/", "sim/", "perf/")


def launched(folder: Path, *words: str) -> str:
    """What the launcher prints in a process of its own; it must end well."""
    command = [sys.executable, "-m", "platform.launch", *words, "budget=smoke", f"runs_dir={folder / 'runs'}"]
    return said(*command, PYTHONPATH="")


@pytest.fixture
def again(launch):
    """What the launcher prints in this process: for commands that have nothing left to compute."""

    def run(folder: Path, *words: str) -> str:
        status, out, err = launch(*words, "budget=smoke", f"runs_dir={folder / 'runs'}")
        assert status == 0, out + err
        return out

    return run


# Every stage of budget=smoke, each a part of it.
SMALLER = (
    "collect.num_steps=800",
    "collect.num_validation_steps=200",
    "pretrain.iterations=20",
    "pretrain.validate_every=10",
    "pretrain.checkpoint_every=10",
    "algo.train_batch_size_per_learner=512",
    "train.env_steps=1024",
    "evaluate.episodes=2",
    "evaluate.pyrender_episodes=1",
)
# Eight conditions, one of which is nominal, of more episodes than a job evaluates without Ray.
AXES = (
    "+study.axes.control_hz={env.control_hz:[50,100,200]}",
    "+study.axes.sparsity={faults.sparsity:[0.0,0.25,0.5,0.75]}",
)
POLICY = ("study.policies=[newest]", "study.trials=3", "env.time_limit_s=0.5")
SWEEP = ("+exp=robustness", "~study.axes", *AXES, *POLICY)


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """One smoke run through every stage, shared by the tests of this file."""
    folder = tmp_path_factory.mktemp("flown")
    printed = launched(folder, "+exp=bytestream", *SMALLER)
    (run,) = (folder / "runs").iterdir()
    return folder, run, printed


FEW_STEPS = (
    "algo.train_batch_size_per_learner=256",
    "train.env_steps=512",
    "evaluate.episodes=2",
    "evaluate.renderers=[raycast]",
    "evaluate.video=false",
    "env.scene=poles_eval",  # one scene instead of two
    "env.time_limit_s=1.0",
)

FEW_FITS = "algo.minibatch_size=64", "algo.imitation.fit_steps=2", "algo.imitation.final_steps=2"


@pytest.mark.parametrize(("exp", "words"), [("event_columns", FEW_STEPS), ("rgb", ())])
@pytest.mark.slow
def test_a_policy_without_an_event_vae_trains_and_evaluates_at_once(tmp_path, exp, words):
    printed = launched(tmp_path, f"+exp={exp}", *words)
    assert re.search(r"policy stochastic\s+│ poles_eval\s+│ raycast\s+│\s+\d+ │\s+\d+ \[\d+, \d+\]", printed)
    (run,) = (tmp_path / "runs").iterdir()
    assert run.name.startswith(f"{exp}-smoke-s0-")
    assert not {"data", "encoder"} & {path.name for path in run.iterdir()}
    assert {path.stem for path in (run / "stages").iterdir()} == {"train", "evaluate"}
    assert {path.name for path in (run / "policy").iterdir()} == {"policy.json", "networks.safetensors"}
    assert (run / "eval" / "episode.mp4").is_file() is (not words)
    policy = load_policy(run / "policy")
    env = CorridorEnv(EnvConfig(split="eval", observation=policy.observation))
    observation, _ = env.reset(seed=0)
    for _ in range(5):
        observation, *_ = env.step(int(policy(observation[None])[0]))
    _, stored = stored_run(tmp_path)
    assert (stored.info.status, stored.data.tags["policy"]) == ("FINISHED", policy.manifest["name"])
    assert stored.info.run_name == run.name
    assert all(any(name.startswith(section) for name in stored.data.metrics) for section in SECTIONS[1:])


@pytest.mark.slow
def test_an_encoder_of_what_only_a_simulator_knows_goes_through_every_stage(tmp_path):
    own = ("algo=imitation", "model.target=proximity", "model.octaves=2", *FEW_FITS)
    launched(tmp_path, "+exp=bytestream", *own, *SMALLER, *FEW_STEPS)
    (run,) = (tmp_path / "runs").iterdir()
    assert {path.stem for path in (run / "stages").iterdir()} == {"collect", "pretrain", "train", "evaluate"}
    policy = load_policy(run / "policy")
    assert (policy.spec.evae.target, policy.spec.evae.octaves) == ("proximity", 2)


@pytest.mark.slow
def test_a_recurrent_policy_is_taught_through_every_stage(tmp_path):
    launched(tmp_path, "+exp=event_columns_gru", "algo=imitation", *FEW_FITS, *FEW_STEPS)
    (run,) = (tmp_path / "runs").iterdir()
    assert load_policy(run / "policy").spec.model.name == "event_columns_gru"


@pytest.mark.slow
def test_an_encoder_that_learns_on_goes_through_every_stage_and_the_sweep(tmp_path):
    launched(tmp_path, "+exp=bytestream_finetuned", *FEW_STEPS)
    (run,) = (tmp_path / "runs").iterdir()
    assert {path.stem for path in (run / "stages").iterdir()} == {"collect", "pretrain", "train", "evaluate"}
    assert {path.name for path in (run / "policy").iterdir()} == {"policy.json", "networks.safetensors"}
    pretrained = safetensors.numpy.load_file(run / "encoder" / "encoder.safetensors")
    learnt = safetensors.numpy.load_file(run / "policy" / "networks.safetensors")
    for name, value in pretrained.items():
        if not name.startswith("decoder."):
            moved = not np.array_equal(learnt[f"trunk.{name}"], value)
            assert moved is not ("running" in name or "num_batches" in name), name
    axes = "~study.axes.renderer", "+study.axes.sparsity={faults.sparsity: [0.5]}"
    flown = "study.policies=[newest]", "study.trials=1", *axes
    assert re.search(r"sparsity\s+│ 0\.5", launched(tmp_path, "+exp=renderer", *flown))


def stored_run(folder: Path):
    client = MlflowClient(f"sqlite:///{folder / 'mlflow.db'}")
    experiment = client.get_experiment_by_name("evade")
    runs = client.search_runs([experiment.experiment_id], "tags.kind = 'run'")
    assert len(runs) == 1
    return client, runs[0]


def test_the_table_shows_the_policy_between_its_bounds(flown):
    for name in ("policy stochastic", "policy deterministic", "straight", "random", "oracle"):
        assert re.search(rf"{name}\s+│ poles_eval\s+│ raycast\s+│\s+2 │\s+\d+ \[\d+, \d+\]", flown[2]), name
    assert "/#/experiments/" in flown[2]


def test_the_store_holds_settings_figures_and_pictures_and_a_loss_that_fell(flown):
    client, run = stored_run(flown[0])
    assert run.info.status == "FINISHED"
    assert run.data.params["camera.contrast_threshold"] == "0.2"
    assert run.data.params["algo.minibatch_size"] == "256"
    assert all(any(name.startswith(section) for name in run.data.metrics) for section in SECTIONS)
    assert np.isfinite(list(run.data.metrics.values())).all()
    steps = [point.step for point in client.get_metric_history(run.info.run_id, "train/entropy")]
    assert steps == sorted(set(steps))
    assert steps[-1] >= 1024
    first, last = client.get_metric_history(run.info.run_id, "evae/reconstruction_step")  # on unseen flights
    assert last.value < first.value
    folders = (None, "evae", "eval")
    files = {file.path for place in folders for file in client.list_artifacts(run.info.run_id, place)}
    pictures = {"evae/reconstructions.png", "eval/trajectories.png", "eval/episode.mp4"}
    assert {"config.yaml", "eval/table.md", "eval/episodes.csv"} | pictures <= files


def listed_paths() -> list[str]:
    """Return the paths of "The run folder" as patterns; a bare name is in the folder before."""
    table = (ROOT / "docs" / "experiments.md").read_text().split("\n## The run folder\n")[1]
    found = []
    for line in re.findall(r"^\| (`.*?) \|", table, re.MULTILINE):
        folder = ""
        for path in re.findall(r"`([^`]+)`", line):
            folder = path.rpartition("/")[0] + "/" if "/" in path else folder
            found.append((path if "/" in path else folder + path) + ("*" if path.endswith("/") else ""))
    return found


def test_the_page_lists_what_a_run_writes_and_the_run_wrote_what_it_lists(flown):
    run, paths = flown[1], listed_paths()
    files = [file.relative_to(run) for file in sorted(run.rglob("*")) if file.is_file()]
    written = [str(file) for file in files if not file.parts[0].startswith(".")]
    unlisted = [file for file in written if not any(fnmatch.fnmatch(file, path) for path in paths)]
    assert unlisted == []
    stages = ("config.yaml", "tracking.json", "stages/", "data/", "encoder/", "train/", "policy/", "eval/")
    own = [path for path in paths if path.startswith(stages)]
    assert len(own) > 12
    assert [path for path in own if not fnmatch.filter(written, path)] == []


def test_the_policy_folder_carries_the_very_encoder_and_flies_alone(flown, tmp_path):
    _, run, _ = flown
    encoder = json.loads((run / "encoder" / "encoder.json").read_text())
    shutil.copytree(run / "policy", tmp_path / "alone")
    assert json.loads((tmp_path / "alone" / "encoder.json").read_text())["sha256"] == encoder["sha256"]
    policy = load_policy(tmp_path / "alone")
    env = CorridorEnv(EnvConfig(split="eval"))
    window, _ = env.reset(seed=0)
    for _ in range(10):
        window, *_ = env.step(int(policy(window[None])[0]))


def test_the_same_command_again_repeats_nothing(flown, again):
    def written():
        stages = (flown[1] / "stages").glob("*.json")
        # An evaluation without OpenGL tries its missing rows again.
        return {path: path.stat().st_mtime_ns for path in stages if path.stem != "evaluate"}

    before = written()
    printed = again(flown[0], "+exp=bytestream", *SMALLER)
    assert written() == before != {}
    assert "Train the policy" not in printed
    assert "policy stochastic" in printed
    stored_run(flown[0])


def test_a_sweep_evaluates_the_policy_just_trained_on_loopback_alone_and_a_rerun_nothing(flown, again):
    job = start_job(flown[0], *SWEEP, "budget=smoke")
    job.wait(job.kept)
    found = listening(job.process.pid)
    assert job.end() == 0, job.said
    check_ray(found)
    assert re.search(r"control_hz\s+│ 50", job.said)
    assert re.search(r"sparsity\s+│ 0\.75", job.said)
    assert "Study:" not in again(flown[0], *SWEEP)
    client = MlflowClient(f"sqlite:///{flown[0] / 'mlflow.db'}")
    experiment = client.get_experiment_by_name("evade").experiment_id
    (parent,) = client.search_runs([experiment], "tags.kind = 'sweep'")
    children = client.search_runs([experiment], f"tags.`mlflow.parentRunId` = '{parent.info.run_id}'")
    assert len({child.info.run_name for child in children}) == len(children) >= 7
    assert {child.info.status for child in children} == {"FINISHED"}


def test_the_path_of_a_world_counts_from_the_folder_of_the_command_in_every_process(tmp_path):
    (tmp_path / "world.csv").write_text("sphere,5,0,2,1,0,0,0,1,1,1\n")
    words = "+exp=dodge budget=smoke study.scene=world.csv study.policies=[straight] study.trials=10"
    variants = ["~study.variants.body", "~study.variants.kinematic"]
    command = [sys.executable, "-m", "platform.launch", *words.split(), *variants]
    assert "Not evaluated" not in said(*command, cwd=tmp_path, PYTHONPATH=str(ROOT))
