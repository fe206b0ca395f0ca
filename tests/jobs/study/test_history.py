"""Published policies name commits that have their code, published studies commits that have their plan."""

import csv
import fnmatch
import re
import subprocess

import pytest

from jobs.rollout.policies import PRETRAINED
from jobs.run.files import read_json
from jobs.run.provenance import REPOSITORY

DOCS = REPOSITORY / "docs"
PLANS, DATA = DOCS / "plans", DOCS / "data"
PLANNED = re.compile(r"^At commit (\w+), `([^`]+)`:\n\n````text\n(.*?)\n````$", re.MULTILINE | re.DOTALL)
NAMES = sorted({path.stem for path in PLANS.glob("*.md")} - {"index"})
MANIFESTS = sorted([*DATA.glob("*_policies/*/policy.json"), *PRETRAINED.glob("*/policy.json")])
# Stage -> the file that computes it, and a word that it has once it can do so on a GPU.
ON_GPU = {"pretrain": "jobs/training/pretrain.py", "train": "jobs/config/schema.py"}
with (DATA / "made_on_gpu.csv").open() as rows:
    GPU_ROWS = list(csv.DictReader(rows))


def git(*words):
    command = ["git", "-C", str(REPOSITORY), *words]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def shown(commit, file):
    """Return a file at a commit, "" if the commit lacks it. Skips where history is not there."""
    if git("cat-file", "-e", commit).returncode:
        pytest.skip("this clone has no history")
    return git("show", f"{commit}:{file}").stdout


def planned(name):
    """Return commit, file and text of each part of a plan."""
    return PLANNED.findall((PLANS / f"{name}.md").read_text())


@pytest.mark.parametrize("row", GPU_ROWS, ids=lambda row: row["folders"])
def test_a_stage_on_a_gpu_names_a_commit_that_can_use_one(row):
    assert "device" in shown(row["commit"], ON_GPU[row["stage"]])
    own = [file for file in MANIFESTS if fnmatch.fnmatch(file.parent.name, row["folders"])]
    assert {read_json(file)["commit"][:7] for file in own} == {row["manifest_commit"]}
    if row["commit"] != row["manifest_commit"]:  # why the row is there: the manifest's commit cannot
        assert "device" not in shown(row["manifest_commit"], ON_GPU[row["stage"]])
        page = (DOCS / "ppo_paper.md").read_text()
        assert row["commit"] in page
        assert row["manifest_commit"] in page


def test_every_manifest_names_a_commit_that_has_its_experiment():
    """The name of a policy's study may have words behind that of its experiment."""
    studies = {}
    for file in MANIFESTS:
        manifest = read_json(file)
        studies[str(manifest["commit"]).removesuffix("-dirty"), str(manifest["exp"])] = file.parent.name
    for (commit, study), folder in studies.items():
        words = study.split("_")
        names = ["_".join(words[:count]) for count in range(len(words), 0, -1)]
        assert any(shown(commit, f"conf/exp/{name}.yaml") for name in names), (folder, commit)


@pytest.mark.parametrize("name", NAMES)
def test_a_plan_is_the_text_of_the_commit_that_planned_it_and_changes_stand_below(name):
    parts = planned(name)
    assert parts, f"{name}: a plan names its commit and file, and holds the text of that"
    for commit, file, text in parts:
        assert text in shown(commit, file), (name, commit)
    assert "\n## Changed\n" in (PLANS / f"{name}.md").read_text()


@pytest.mark.parametrize("name", [name for name in NAMES if (DATA / f"{name}_about.json").is_file()])
def test_a_study_was_planned_before_it_was_evaluated(name):
    """Episodes that it takes from another study may be older; its plan names that study."""
    text = (PLANS / f"{name}.md").read_text()
    others = [other for other in NAMES if f"{other}.md" in text and (DATA / f"{other}_about.json").is_file()]
    taken = {commit for other in others for commit in evaluated_at(other)}
    for commit, file, _ in planned(name):
        assert shown(commit, file)
        is_later = {one: not git("merge-base", "--is-ancestor", commit, one).returncode
                    for one in evaluated_at(name)}  # fmt: skip
        assert any(is_later.values())
        assert {one for one, later in is_later.items() if not later} <= taken, (name, commit)


def evaluated_at(name):
    about = read_json(DATA / f"{name}_about.json")
    return [commit.removesuffix("-dirty") for commit in about["evaluated_at"]]
