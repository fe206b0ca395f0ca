import shutil
from pathlib import Path

import mlflow
import numpy as np
import pandas as pd
import pytest

from envs.config import EnvConfig
from envs.corridor import CorridorEnv
from jobs.run.files import write_json
from jobs.run.folder import open_run
from jobs.tracking.model_registry import register, register_training
from jobs.tracking.tracker import open_tracker
from models.policy import load_policy
from models.policy.policy import HEADINGS
from tests.support.configs import small_config
from tests.support.policies import save_training
from tests.support.stores import place_store

STEPS = 5
SEEN = ("bytestream", "event_image", "rgb")
TAGS = {"seed": 3, "commit": "c0ffee", "eval/success_rate": 1 / 3}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """A run of a tracker, and policies that see event windows, event images and luminance."""
    place = tmp_path_factory.mktemp("registry")
    place_store(place / "mlflow.db")
    folder = open_run(small_config(place))
    with open_tracker(folder.config, folder) as tracker:
        pass
    env = folder.config.env
    return tracker, {name: Path(save_training(folder.path / name, name, 3, env, name)) for name in SEEN}


def seen(observation):
    """What a flight straight on shows: (decisions, ...)."""
    env = CorridorEnv(EnvConfig(split="eval", observation=observation))
    first, _ = env.reset(seed=1)
    return [first, *(env.step(0)[0] for _ in range(STEPS))]


def as_input(observation):
    """The same flight as the registered model takes it."""
    if observation == "luminance":
        return np.stack(seen("luminance"))
    return pd.DataFrame(np.concatenate(seen("events")), columns=["t", "x", "y", "p"])


def load(tracker, name):
    mlflow.set_tracking_uri(tracker.uri)  # also in the environment, for whatever is started later
    try:
        return mlflow.pyfunc.load_model(f"models:/{name}")
    finally:
        mlflow.set_tracking_uri(None)


# The kernels that travel with the encoder of single events compile anew, for most of a minute.
@pytest.mark.parametrize("kind", [pytest.param("bytestream", marks=pytest.mark.system), *SEEN[1:]])
def test_a_registered_policy_gives_the_logits_and_actions_of_the_policy_itself(store, kind):
    tracker, folders = store
    model = load(tracker, register(tracker, folders[kind], kind, TAGS))
    policy = load_policy(folders[kind])
    expected = np.concatenate([policy.logits(shown[None]) for shown in seen(policy.observation)])
    for _ in range(2):  # it remembers no flight before
        found = model.predict(as_input(policy.observation))
        np.testing.assert_array_equal(found[list(HEADINGS)].to_numpy(), expected)
        np.testing.assert_array_equal(found["action"], expected.argmax(axis=1))
        np.testing.assert_array_equal(found["step"], np.arange(STEPS + 1))
    assert len(np.unique(expected, axis=0)) > 2


def test_a_training_is_registered_once_and_its_tags_are_renewed(store):
    tracker, folders = store
    first = register(tracker, folders["event_image"], "once", TAGS)
    renewed = {**TAGS, "eval/success_rate": 0.5}
    assert register(tracker, folders["event_image"], "once", renewed) == first == "evade-once/1"
    assert register(tracker, folders["rgb"], "once", TAGS) == "evade-once/2"
    client = tracker.client
    assert len(client.search_model_versions("name = 'evade-once'")) == 2
    one = client.get_model_version("evade-once", "1")
    assert one.run_id == tracker.run_id
    assert {"seed": "3", "commit": "c0ffee", "eval/success_rate": "0.5"}.items() <= one.tags.items()
    assert "evade-once/1" in client.get_registered_model("evade-once").description


def test_trainings_of_any_length_are_versions_of_their_experiments_model(store, tmp_path):
    tracker, folders = store
    lengths = {"event_image": 500_000, "rgb": 1_500_000}
    for name, env_steps in lengths.items():
        run = tmp_path / name
        shutil.copytree(folders[name], run / "policy")
        settings = {"exp": "lengths", "seed": 0, "budget": "paper", "train": {"env_steps": env_steps}}
        write_json(run / "config.json", settings)
        write_json(run / "stages" / "train.json", {"commit": "c0ffee", "figures": {}})
    found = [register_training(tracker, tmp_path / name) for name in lengths]
    assert found == ["evade-lengths/1", "evade-lengths/2"]
    versions = tracker.client.search_model_versions("name = 'evade-lengths'")
    assert {version.tags["env_steps"] for version in versions} == {"500000", "1500000"}


def test_a_model_holds_the_policys_own_files_and_the_code_that_reads_them_and_no_pickle(store):
    tracker, folders = store
    name, _, number = register(tracker, folders["bytestream"], "files", TAGS).partition("/")
    place = Path(tracker.client.get_model_version_download_uri(name, number).removeprefix("file://"))
    kept = {path.relative_to(place).as_posix() for path in place.rglob("*") if path.is_file()}
    own = {path.name for path in folders["bytestream"].iterdir()}
    assert own == {Path(path).name for path in kept if path.startswith("artifacts/")}
    code = {"served_policy.py", "code/models/policy/policy.py", "code/core/__init__.py"}
    assert code | {"MLmodel", "requirements.txt"} <= kept
    assert {Path(path).suffix for path in kept} <= {".py", ".json", ".safetensors", ".yaml", ".txt", ""}
