"""Numbers of the README and of the first pages are those of data, configuration and code."""

import csv
import gzip
import json
import re
from collections import defaultdict

import numpy as np
import pytest

from docs.tables import DATA, ROOT, stale
from envs.events import EVENT
from envs.recordings import write_events
from jobs.config.config import parse
from jobs.rollout.policies import BASELINES, PRETRAINED, find_study_policies
from jobs.run.folder import locate_run
from jobs.study.models import MANIFEST, success_rates
from jobs.study.plan import plan_study
from models.kinds import KINDS
from tests.support.configs import compose
from tests.support.policies import RECURRENT

TIMES = json.loads((DATA / "times.json").read_text())
# Command -> the pages that say how long it takes.
TIMED = {
    "make setup": ("README.md", "docs/index.md", "docs/start.md"),
    "make demo": ("README.md", "docs/index.md", "docs/start.md", "docs/experiments.md"),
    "make bytestream": (
        "README.md", "docs/index.md", "docs/start.md", "docs/experiments.md", "docs/train.md",
        "docs/troubleshooting.md", "Makefile", "conf/hydra/help/evade.yaml",
    ),
    "make sweep-robustness": ("README.md", "docs/experiments.md", "docs/sweep.md"),
}  # fmt: skip
FINDINGS = ("README.md", "docs/index.md")


def text_of(page):
    """Return a page without its line breaks, which may stand anywhere."""
    return " ".join((ROOT / page).read_text().split())


def said(pattern, page):
    """Return the groups of a pattern, which must be on the page, as whole numbers."""
    found = re.search(pattern, text_of(page))
    assert found, (page, pattern)
    return [int(number.replace(",", "")) for number in found.groups()]


def success(name):
    """Return success [%] of a file of episodes: (axis, value, group) -> seed -> mean over corridors."""
    wins = defaultdict(lambda: defaultdict(list))
    with gzip.open(DATA / f"{name}_episodes.csv.gz", "rt", newline="") as file:
        for row in csv.DictReader(file):
            wins[row["Axis"], row["Value"], row["Group"]][row["Training"]].append(row["success"] == "True")
    return {
        at: {seed: 100 * sum(own) / len(own) for seed, own in seeds.items()} for at, seeds in wins.items()
    }


def mean(values):
    values = list(values)
    return sum(values) / len(values)


def family_rows(study, family):
    """Return the rows of a family's tests in a published study."""
    with (DATA / f"{study}_tests.csv").open() as file:
        return [row for row in csv.DictReader(file) if row["family"] == family]


def planned(*words):
    """Return the groups of a command's sweep, its corridors, and its episodes; shared ones count once."""
    config = parse(compose(*words))
    sweep = plan_study(config, find_study_policies(config, locate_run(config)))
    episodes = {(task.key, seed) for task in sweep.tasks for seed in task.seeds}
    return sweep.groups, len(sweep.tasks[0].seeds), len(episodes)


def test_the_tables_of_the_pages_are_those_of_today():
    assert stale() == []


@pytest.mark.parametrize("command", TIMED)
def test_pages_say_the_measured_time_of_a_command(command):
    for page in TIMED[command]:
        assert TIMES[command] in text_of(page), page


def test_no_page_says_another_time_of_a_first_command():
    known = [time for command, time in TIMES.items() if command.startswith("make")]
    for page in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")):
        for line in page.read_text().splitlines():
            if re.search(r"make (bytestream|sweep-robustness|demo)\b", line):
                times = re.findall(r"\d+ to \d+ minutes|\b\d+ seconds", line)
                assert [time for time in times if time not in known] == [], (page.name, line)


def test_the_first_pages_count_policies_and_kinds():
    shipped = len(list(PRETRAINED.glob(f"*/{MANIFEST}")))
    assert said(r"(\d+) trained policies \(`evade models`", "README.md") == [shipped]
    assert said(r"any of \[(\d+) trained policies\]", "docs/index.md") == [shipped]
    assert said(r"(\d+) trained policies come with", "docs/models.md") == [shipped]
    assert "**Policies.** Seven kinds" in text_of("README.md")
    assert len(set(KINDS) - set(RECURRENT)) == 7
    beyond = len(list(DATA.glob(f"*_policies/*/{MANIFEST}")))
    assert said(r"(\d+) more policies, of the studies", "docs/models.md") == [beyond]


def test_the_first_pages_count_conditions_and_episodes():
    (conditions,) = {own.conditions for own in success_rates(DATA / "robustness_episodes.csv.gz").values()}
    for page in ("README.md", "docs/index.md", "docs/start.md"):
        assert f"under {conditions} conditions" in text_of(page), page
    groups, corridors, episodes = planned("+exp=robustness")
    seeds = [len(own) for group, own in groups.items() if group not in BASELINES]
    assert said(r"flies (\d+) corridors under each", "docs/sweep.md") == [corridors]
    assert said(r"has ([\d,]+) episodes of (\d+) policies and two", "docs/sweep.md") == [episodes, sum(seeds)]
    assert len(groups) - len(seeds) == 2


@pytest.mark.parametrize("page", FINDINGS)
def test_the_first_pages_say_which_claims_hold_and_by_which_account(page):
    claims = {row["test"] for row in family_rows("robustness", "claims")}
    assert said(r"Of the paper's (\d+) claims, one holds by one account", page) == [len(claims)]
    found = {(family, row["verdict"], row["test"]) for study in ("ppo_claims", "taught_claims")
             for family in ("claims", "accounts") for row in family_rows(study, family)}  # fmt: skip
    certain = {one for one in found if one[1] in ("holds", "reversed")}
    reversed_ = {(family, "reversed", "tolerates background activity") for family in ("claims", "accounts")}
    assert certain == {("accounts", "holds", "learns faster"), *reversed_}
    learns = [next(float(row["difference"]) for row in family_rows("ppo_claims", family)
                   if (row["Group"], row["test"]) == ("bytestream", "learns faster"))
              for family in ("accounts", "claims")]  # fmt: skip
    counted = (
        r"faster by (\d+) points if the steps recorded for the encoder do not count, and by (\d+) if they do"
    )
    assert said(counted, page) == learns


def test_false_events_cost_what_the_front_page_says_and_other_errors_little():
    rates = success("dose_response_taught")
    lost = defaultdict(dict)
    for group in ("event_image", "bytestream", "bytestream_xy"):
        nominal = mean(rates["nominal", "poles_eval", group].values())
        for kind in ("invented", "lost", "displaced", "flipped", "jittered"):
            own = [mean(seeds.values()) for (axis, _, other), seeds in rates.items()
                   if (axis, other) == (kind, group)]  # fmt: skip
            lost[kind][group] = nominal - mean(own)
            assert len(own) == 4
    false = lost.pop("invented").values()
    found = said(r"lose (\d+) to (\d+) points of success when (\d+) to (\d+) %", "docs/index.md")
    assert found[:2] == [round(min(false)), round(max(false))]
    assert {len(seeds) for (axis, _, _), seeds in rates.items() if axis == "invented"} == {10}
    (most,) = said(r"lose fewer than (\d+) points when as many are lost", "docs/index.md")
    assert max(value for own in lost.values() for value in own.values()) < most


def test_the_robust_policy_does_as_the_pages_say():
    means = {at[:2]: round(mean(seeds.values())) for at, seeds in success("hold").items()}
    dense = {rate: means.pop(("control_hz_dense", rate)) for rate in ("200", "25")}
    expected = [min(means.values()), max(means.values()), len(means)]
    assert said(r"reaches (\d+) to (\d+) % under (\d+) conditions", "docs/index.md") == expected
    assert said(r"each: (\d+) to (\d+) % under (\d+) conditions", "docs/train.md") == expected
    told = said(r"(\d+) % in `poles_dense` and (\d+) % there at 25 Hz", "docs/train.md")
    assert told == [dense["200"], dense["25"]]
    late = mean(success("robustness")["action_delay", "100", "bytestream_hold"].values())
    assert said(r"With actions 100 ms late it reaches (\d+) %", "docs/index.md") == [round(late)]


def test_the_policy_for_late_actions_does_as_the_pages_say():
    means = {
        at[:2]: mean(own.values()) for at, own in success("robustness").items() if at[2] == "bytestream_late"
    }
    late = round(means.pop(("action_delay", "100")))
    others = [round(value) for value in means.values()]
    ends = [min(others), max(others)]
    assert said(r"`bytestream_late` (\d+) %", "docs/index.md") == [late]
    assert said(r"(\d+) to (\d+) % under \d+ of \d+ conditions, and (\d+) % with", "docs/results.md") == [
        *ends,
        late,
    ]
    here = {at: round(mean(own.values())) for at, own in success("late_actions").items()}
    delays = [
        here["action_delay", ms, group]
        for group in ("bytestream_late", "bytestream_hold")
        for ms in ("50", "100")
    ]
    dense = [here["control_hz_dense", "25", group] for group in ("bytestream_late", "bytestream_hold")]
    told = r"(\d+) % at 50 ms and (\d+) % at 100 ms \(`bytestream_hold`: (\d+) and (\d+)\)"
    assert said(told, "docs/train.md") == delays
    assert said(r"(\d+) % in `poles_dense` at 25 Hz \((\d+)\)", "docs/train.md") == dense


def test_the_readme_counts_the_formats_that_can_be_written(tmp_path):
    with pytest.raises(ValueError, match="format") as error:
        write_events(tmp_path / "a.unknown", np.empty(0, EVENT), 1, 1, "unknown")
    formats = re.findall(r"\b(npz|hdf5|txt|csv|aedat4|evt3|evt2|dat)\b", str(error.value))
    words = {8: "eight", 9: "nine", 10: "ten"}
    assert f"Write {words[len(set(formats))]} formats" in text_of("README.md")


def test_the_page_of_claims_tells_what_is_certain_from_what_an_interval_excludes():
    rows = family_rows("ppo_claims", "claims")
    excluded = [row for row in rows if "no gain" in row["verdict"] or row["verdict"] == "reversed"]
    verdicts = ("reversed", "no gain", "no gain, no loss")
    certain = [row for row in excluded if row["certain_in_family"] in verdicts]
    pattern = r"Of these (\d+) tests, (\d+) exclude a gain by their own interval, (\d+) of them for certain"
    assert said(pattern, "docs/claims.md") == [len(rows), len(excluded), len(certain)]
