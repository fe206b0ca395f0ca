"""Numbers of the README and of pages that other tests do not know are those of data and configuration."""

import re
import shlex

import numpy as np
import pytest

from jobs.analysis.statistics import wilson_interval
from jobs.config.conditions import NOMINAL
from jobs.config.config import parse
from jobs.evaluation.sweep_plan import axes_of, plan_sweep
from jobs.reporting.sweep_data import SWEEP, read_sweep_episodes
from jobs.rollout.policies import BASELINES, PRETRAINED, find_sweep_policies
from jobs.run.files import read_json
from jobs.run.folder import locate_run
from jobs.run.provenance import REPOSITORY
from models.policy.policy import MANIFEST
from tests.support.configs import compose

DATA = REPOSITORY / "docs" / "data"


def page_text(name):
    """A page without its line breaks, which may stand anywhere."""
    return " ".join((REPOSITORY / name).read_text().split())


def said_numbers(pattern, text):
    """The groups of a pattern, which must be in the text, as whole numbers."""
    found = re.search(pattern, text)
    assert found, pattern
    return [int(number.replace(",", "")) for number in found.groups()]


def planned(*words):
    """The sweep of a command, and its episodes without those that several conditions share."""
    config = parse(compose(*words))
    sweep = plan_sweep(config, find_sweep_policies(config, locate_run(config)))
    return sweep, len({(task.key, seed) for task in sweep.tasks for seed in task.seeds})


@pytest.fixture(scope="module")
def held():
    """Condition -> success of each training of `bytestream_hold` [%], in 100 corridors each."""
    episodes = read_sweep_episodes(DATA / "hold_episodes.csv.gz")
    assert {group for _, group in episodes} == {"bytestream_hold"}
    assert {len(own) for trainings in episodes.values() for own in trainings.values()} == {100}
    return {
        at: [100 * own["success"].mean() for own in trainings.values()]
        for (at, _), trainings in episodes.items()
    }


def test_the_command_on_the_readme_evaluates_as_many_episodes_as_it_says():
    sweep, episodes = planned("+exp=robustness")
    trained = [seeds for group, seeds in sweep.groups.items() if group not in BASELINES]
    assert {len(seeds) for seeds in trained} == {3}
    assert (len(trained), len(sweep.groups) - len(trained)) == (6, 2)
    text = page_text("README.md")
    assert "six kinds of policies, three trainings each, and two baselines" in text
    said = said_numbers(r"all in the same (\d+) corridors: ([\d,]+) episodes, 9 minutes", text)
    assert said == [len(sweep.tasks[0].seeds), episodes]
    for page in ("docs/sweep.md", "docs/robustness.md"):
        assert f"{episodes:,} episodes" in page_text(page), page


def test_the_sweep_of_the_readmes_table_has_the_size_that_it_says_and_the_same_conditions():
    about = read_json(DATA / f"{SWEEP}_about.json")
    sweep, episodes = planned(*shlex.split(about["command"])[3:])
    assert sweep.groups == about["groups"]
    assert len([group for group in sweep.groups if group not in BASELINES]) == 11
    said = said_numbers(
        r"eleven shipped groups and the baselines in (\d+) corridors, ([\d,]+) episodes",
        page_text("README.md"),
    )
    assert said == [about["trials"], episodes]
    assert axes_of(parse(compose("+exp=robustness")).sweep) == sweep.axes == about["axes"]
    rows = sum(len(task.seeds) for task in sweep.tasks)
    shared = f"{rows:,} rows of `{SWEEP}_episodes.csv.gz` are {episodes:,} episodes"
    assert shared in page_text("docs/data.md")


@pytest.mark.parametrize("page", ["README.md", "docs/index.md"])
def test_what_is_said_of_the_policy_that_holds_is_what_its_own_sweep_says(held, page):
    means = {at: round(sum(rates) / len(rates)) for at, rates in held.items()}
    dense = {rate: means.pop(("control_hz_dense", rate)) for rate in ("200", "25")}
    text = page_text(page)
    spread = r"reach (?:on average )?(\d+) to (\d+) % (?:on average )?under (\d+) conditions"
    assert said_numbers(spread, text) == [min(means.values()), max(means.values()), len(means)]
    said = said_numbers(r"(\d+) % in `poles_dense`(?:,| and) (\d+) % there at 25 Hz", text)
    assert said == [dense["200"], dense["25"]]
    if page == "README.md":
        worst = min(min(rates) for at, rates in held.items() if at in means)
        assert said_numbers(r"the lowest single training (\d+) %", text) == [worst]


def test_the_taught_policy_in_the_first_table_does_as_in_its_own_sweep(held):
    (at,) = [at for at in held if at[0] == NOMINAL]
    rate = round(held[at][0])
    low, high = (round(100 * end) for end in wilson_interval(rate, 100))
    row = r"`bytestream_hold s0`[^|]*\| `poles_eval` \| \*\*(\d+)\*\* \[(\d+), (\d+)\]"
    assert said_numbers(row, page_text("README.md")) == [rate, low, high]


def test_pages_say_the_minutes_that_the_readme_measured():
    measured = re.findall(r"took (\d+) min (\d+) s", page_text("README.md"))
    quick, slow = (round(int(minutes) + int(seconds) / 60) for minutes, seconds in measured)
    for page in ("README.md", "docs/index.md", "docs/start.md", "docs/commands.md", "docs/faq.md"):
        assert f"{quick} to {slow} minutes" in page_text(page), page


def test_pages_give_the_number_of_the_readmes_policy_and_those_of_three_processors_before():
    readme, text = page_text("README.md"), page_text("docs/representations.md")
    now = re.search(r"sampled action \| `poles_eval` \| \*\*(\d+)\*\* (\[\d+, \d+\])", readme)
    assert f"succeeded in {now[1]} {now[2]} of 100 held-out corridors" in text
    rate = r"(\d+) \[\d+, \d+\]"
    before = re.search(rf"which succeeded in {rate}, {rate} and {rate}", text).groups()
    assert "reached {}, {} and {} %".format(*before) in page_text("docs/faq.md")
    assert f"of {min(before)} to {max(before)} %" in readme


def test_the_front_page_counts_the_shipped_policies():
    shipped = [path.parent.name for path in PRETRAINED.glob(f"*/{MANIFEST}")]
    groups = read_json(DATA / f"{SWEEP}_about.json")["groups"]
    evaluated = [f"{group}-s{seed}" for group, seeds in groups.items() for seed in seeds if seed is not None]
    taught = [name for name in shipped if name.startswith("taught_")]
    assert sorted(shipped) == sorted([*evaluated, *taught])
    said = said_numbers(
        r"Any of (\d+) shipped policies .* the (\d+) of the eleven groups .*?, and (\d+) by which",
        page_text("docs/index.md"),
    )
    assert said == [len(shipped), len(evaluated), len(taught)]


def test_what_the_gallery_says_of_other_textures_is_what_the_data_say():
    episodes = read_sweep_episodes(DATA / f"{SWEEP}_episodes.csv.gz")
    textured = [
        own
        for (at, group), trainings in episodes.items()
        if at == ("world", "texture_change") and group not in BASELINES
        for own in trainings.values()
    ]
    first = np.concatenate([own[own["seed"] == 0] for own in textured])
    said = said_numbers(
        r"(\d+) of the (\d+) trainings .* do not reach the goal, (\d+) of them end within 20 m; "
        r"in all of its (\d+) corridors together half of the episodes end within (\d+) m",
        page_text("docs/gallery.md"),
    )
    early, failed = (first["distance_m"] < 20).sum(), (~first["success"]).sum()
    half = np.median(np.concatenate([own["distance_m"] for own in textured]))
    assert said == [failed, len(first), early, len(textured[0]), round(half)]
