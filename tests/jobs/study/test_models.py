"""The list of shipped policies against files made for the purpose, and against the published ones."""

import gzip
import json

import pytest

from jobs.rollout.policies import PRETRAINED
from jobs.study.models import DATA, HEAD, model_rows, models_tables, shipped_groups, success_rates

COLUMNS = "Axis,Value,Group,Training,seed,success,collision,truncated,distance_m,x_m,return,steps"


def episode(axis, value, group, seed, success, distance=100.0):
    return f"{axis},{value},{group},0,{seed},{success},{not success},False,{distance},1.0,2.0,3"


@pytest.fixture
def folder(tmp_path):
    """Two policies of one group, one taught policy, and the episodes of the first."""
    for name, about in {
        "bytestream-s0": {"conditions": [{}, {}]},
        "bytestream-s2": {},
        "taught_rgb-s0": {"algo": {"imitation": {}}, "name": "rgb"},
    }.items():
        own = {"name": "bytestream", "train": {"env_steps": 500_000}, **about}
        (tmp_path / name).mkdir()
        (tmp_path / name / "policy.json").write_text(json.dumps(own))
        (tmp_path / name / "networks.safetensors").write_bytes(bytes(2_000_000))
    rows = [
        *(episode("nominal", "poles_eval", "bytestream", seed, True) for seed in range(2)),
        *(episode("control_hz", "200", "bytestream", seed, True) for seed in range(2)),  # the same simulation
        episode("control_hz", "45", "bytestream", 0, True),
        episode("control_hz", "45", "bytestream", 1, False, 30.0),
    ]
    with gzip.open(tmp_path / "robustness_episodes.csv.gz", "wt") as file:
        file.write("\n".join([COLUMNS, *rows]) + "\n")
    return tmp_path


def test_a_simulation_that_two_conditions_share_counts_once(folder):
    (own,) = success_rates(folder / "robustness_episodes.csv.gz").values()
    assert own == (1.0, 0.75, 0.5, ("control_hz", "45"), 2)


def test_a_row_says_what_manifest_and_episodes_say(folder):
    (row,) = model_rows("robustness", folder, folder)
    cells = dict(zip(HEAD, row, strict=True))
    assert cells["seeds"] == "0, 2"
    assert (cells["method"], cells["trained in"], cells["steps"]) == ("PPO", "poles, randomized (2)", "500k")
    assert (cells["MB"], cells["nominal [%]"], cells["mean [%]"]) == ("2.0", "100", "75")
    assert (cells["worst [%]"], cells["under"]) == ("50", "45 Hz")
    assert [(one.name, one.method) for one in shipped_groups(folder)] == [
        ("bytestream", "PPO"),
        ("taught_rgb", "imitation"),
    ]


def test_without_episodes_there_is_no_row(folder, tmp_path):
    assert model_rows("taught", folder, tmp_path) == []


def test_every_shipped_policy_has_a_row_and_its_sweep_has_36_conditions():
    named = {line.split("`")[1] for text in models_tables().values() for line in text.splitlines()[2:]}
    assert named == {group.name for group in shipped_groups(PRETRAINED)}
    rates = success_rates(DATA / "robustness_episodes.csv.gz")
    assert {own.conditions for own in rates.values()} == {36}
