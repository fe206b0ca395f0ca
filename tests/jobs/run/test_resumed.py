import dataclasses
import re

import pytest

from jobs.config.command_line import given_keys, hydra_words
from jobs.config.config import ConfigError, parse
from jobs.run.folder import open_run, run_name
from jobs.run.resumed import check_resumed
from tests.support.configs import compose


@pytest.fixture
def run(tmp_path):
    config = parse(compose("+exp=event_columns", "budget=smoke", "light=day"))
    return open_run(dataclasses.replace(config, runs_dir=str(tmp_path / "runs")))


def checked(run, *words):
    given = hydra_words(words)
    check_resumed(parse({**compose(*words), "resume": str(run.path)}), given_keys(given))


@pytest.mark.parametrize(
    ("words", "keys"),
    [
        (["+exp=event_columns", "algo.lr=0.9", "train.env_steps=7"], ["algo.lr", "train.env_steps"]),
        (["+exp=train", "seed=3", "++env.control_hz=50"], ["env.control_hz", "seed"]),
        (["+exp=train", "budget=paper"], ["budget"]),
        (["+exp=train", "light=night"], ["camera.cutoff_hz", "faults.shot_noise_hz"]),
        (["+exp=train", "algo=imitation"], ["algo.imitation.temperature", "algo.minibatch_size"]),
        (["+exp=event_image"], ["exp"]),
        (["+exp=train", "name=another"], ["exp"]),
    ],
)  # fmt: skip
def test_a_key_that_a_continued_run_does_not_take_is_refused_by_name(run, words, keys):
    with pytest.raises(ConfigError) as error:
        checked(run, *words)
    lines = str(error.value).splitlines()
    assert {re.split("[:]", line)[0] for line in lines} >= {*keys}
    assert all("leave it out" in line for line in lines)


def test_keys_that_a_continued_run_takes_or_has_already_are_accepted(run):
    checked(run, "+exp=evaluate", "evaluate.episodes=7", "cluster.num_cpus=2", "tracking.experiment=mine")
    checked(run, "+exp=event_columns", "budget=smoke", "light=day", "seed=0")
    checked(run, "demo")


def test_the_remedy_works(run):
    """Without the key the run is continued; without resume the key makes a run of its own."""
    checked(run, "+exp=event_columns", "job=train")
    words = "+exp=event_columns", "budget=smoke", "light=day", "algo.lr=0.9"
    assert run_name(parse(compose(*words))) != run.path.name
