"""A published policy can be made again from what is said of it: its commit has the code that it needs."""

import csv
import fnmatch
import functools
import subprocess

import pytest

from jobs.rollout.policies import PRETRAINED
from jobs.run.files import read_json
from jobs.run.provenance import REPOSITORY

DATA = REPOSITORY / "docs" / "data"
MANIFESTS = sorted([*DATA.glob("*_policies/*/policy.json"), *PRETRAINED.glob("*/policy.json")])
# Stage -> the file that computes it, and a word that it has once it can do so on a GPU.
ON_GPU = {"pretrain": "jobs/training/pretrain.py", "train": "jobs/config/schema.py"}


@functools.cache
def shown(commit, file):
    """Return a file at a commit; None if the commit lacks it. Skips where history is not there."""
    command = ["git", "-C", str(REPOSITORY)]
    if subprocess.run([*command, "cat-file", "-e", commit], capture_output=True, check=False).returncode:
        pytest.skip("this clone has no history")
    found = subprocess.run(
        [*command, "show", f"{commit}:{file}"], capture_output=True, text=True, check=False
    )
    return found.stdout if found.returncode == 0 else None


def gpu_rows():
    with (DATA / "made_on_gpu.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("row", gpu_rows(), ids=lambda row: row["folders"])
def test_a_stage_on_a_gpu_names_a_commit_that_can_use_one(row):
    assert "device" in shown(row["commit"], ON_GPU[row["stage"]])
    own = [file for file in MANIFESTS if fnmatch.fnmatch(file.parent.name, row["folders"])]
    assert own
    assert {read_json(file)["commit"][:7] for file in own} == {row["manifest_commit"]}
    if row["commit"] != row["manifest_commit"]:  # why the row is there: the manifest's commit cannot
        assert "device" not in shown(row["manifest_commit"], ON_GPU[row["stage"]])
        page = (REPOSITORY / "docs" / "ppo_paper.md").read_text()
        assert row["commit"] in page
        assert row["manifest_commit"] in page


def test_every_manifest_names_a_commit_that_has_its_experiment():
    missing = []
    for file in MANIFESTS:
        manifest = read_json(file)
        commit = str(manifest.get("commit", "")).removesuffix("-dirty")
        study = str(manifest["exp"])
        names = [study[: len(study) - cut] for cut in range(len(study)) if cut == 0 or study[-cut] == "_"]
        if not any(shown(commit, f"conf/exp/{name}.yaml") for name in names):
            missing.append((file.parent.name, commit[:7]))
    assert missing == []
