"""A plan is the text of the commit that planned its study, before its evaluation; changes stand below it."""

import re
import subprocess

import pytest

from jobs.run.files import read_json
from jobs.run.provenance import REPOSITORY

PLANS, DATA = REPOSITORY / "docs" / "plans", REPOSITORY / "docs" / "data"
PLANNED = re.compile(r"^At commit (\w+), `([^`]+)`:\n\n````text\n(.*?)\n````$", re.MULTILINE | re.DOTALL)


def git(*words):
    command = ["git", "-C", str(REPOSITORY), *words]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def planned(name):
    """Return commit, file and text of each part of a plan; skips where history is not there."""
    found = PLANNED.findall((PLANS / f"{name}.md").read_text())
    if any(git("cat-file", "-e", commit).returncode for commit, _, _ in found):
        pytest.skip("this clone has no history")
    return found


NAMES = sorted({path.stem for path in PLANS.glob("*.md")} - {"index"})


@pytest.mark.parametrize("name", NAMES)
def test_a_plan_is_the_text_of_the_commit_that_planned_it(name):
    parts = planned(name)
    assert parts, f"{name}: a plan names its commit and file, and holds the text of that"
    for commit, file, text in parts:
        assert text in git("show", f"{commit}:{file}").stdout, (name, commit)
    assert "\n## Changed\n" in (PLANS / f"{name}.md").read_text()


@pytest.mark.parametrize("name", [name for name in NAMES if (DATA / f"{name}_about.json").is_file()])
def test_a_study_was_planned_before_it_was_evaluated(name):
    """Episodes that it takes from another study may be older; its plan names that study."""
    text = (PLANS / f"{name}.md").read_text()
    others = [other for other in NAMES if f"{other}.md" in text and (DATA / f"{other}_about.json").is_file()]
    taken = {commit for other in others for commit in evaluated_at(other)}
    for commit, _, _ in planned(name):
        later = [
            one
            for one in evaluated_at(name)
            if git("merge-base", "--is-ancestor", commit, one).returncode == 0
        ]
        assert later
        assert set(evaluated_at(name)) - set(later) <= taken, (name, commit)


def evaluated_at(name):
    return [
        commit.removesuffix("-dirty") for commit in read_json(DATA / f"{name}_about.json")["evaluated_at"]
    ]
