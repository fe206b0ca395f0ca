"""The list of shipped policies against files made for the purpose, and against the published ones."""

import pytest

from jobs.rollout.policies import PRETRAINED
from jobs.rollout.table import LABELS, write_episodes
from jobs.run.files import write_json
from jobs.study.models import DATA, HEAD, model_rows, models_tables, shipped_groups, success_rates
from tests.support.episodes import flights


@pytest.fixture
def folder(tmp_path):
    """Two policies of one group, one taught policy, and the episodes of the first."""
    for name, about in {
        "bytestream-s0": {"conditions": [{}, {}]},
        "bytestream-s2": {},
        "taught_rgb-s0": {"algo": {"imitation": {}}, "name": "rgb"},
    }.items():
        own = {"name": "bytestream", "train": {"env_steps": 500_000}, **about}
        write_json(tmp_path / name / "policy.json", own)
        (tmp_path / name / "networks.safetensors").write_bytes(bytes(2_000_000))
    usual = flights(2, trials=2)  # at 200 Hz, too: the same simulation
    flown = {
        ("nominal", "poles_eval"): usual,
        ("control_hz", "200"): usual,
        ("control_hz", "45"): flights(1, 2),
    }
    rows = {(*at, "bytestream", 0): own for at, own in flown.items()}
    write_episodes(tmp_path / "robustness_episodes.csv.gz", LABELS, rows)
    return tmp_path


def test_a_row_says_what_manifest_and_episodes_say_of_each_simulation_once(folder):
    (own,) = success_rates(folder / "robustness_episodes.csv.gz").values()
    assert own == (1.0, 0.75, 0.5, ("control_hz", 45.0), 2)
    (row,) = model_rows("robustness", folder, folder)
    cells = dict(zip(HEAD, row, strict=True))
    assert cells["seeds"] == "0, 2"
    assert (cells["method"], cells["trained in"], cells["steps"]) == ("PPO", "poles, randomized (2)", "500k")
    assert (cells["MB"], cells["nominal [%]"], cells["mean [%]"]) == ("2.0", "100", "75")
    assert (cells["worst [%]"], cells["under"]) == ("50", "45 Hz")
    groups = {one.name: one.method for one in shipped_groups(folder)}
    assert groups == {"bytestream": "PPO", "taught_rgb": "imitation"}
    assert model_rows("taught", folder, folder) == []  # without episodes


def test_every_shipped_policy_has_a_row_and_its_sweep_has_36_conditions():
    named = {line.split("`")[1] for text in models_tables().values() for line in text.splitlines()[2:]}
    assert named == {group.name for group in shipped_groups(PRETRAINED)}
    rates = success_rates(DATA / "robustness_episodes.csv.gz")
    assert {own.conditions for own in rates.values()} == {36}
