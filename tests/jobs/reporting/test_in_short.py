import numpy as np
import pytest

from jobs.reporting.breaks import changes_of
from jobs.reporting.claims_study import BY_PPO, TAUGHT
from jobs.reporting.figures import judge_claims
from jobs.reporting.in_short import in_short, weak_groups
from jobs.reporting.paper_claims import Finding
from jobs.reporting.report import breaks_table
from jobs.reporting.sweep_data import read_data, read_sweep_episodes
from jobs.run.provenance import REPOSITORY
from tests.support.episodes import flights
from tests.support.sweep_folders import ABOUT, write_sweep

NOMINAL, FEW, MANY = ("nominal", "poles_eval"), ("sparsity", "0.2"), ("sparsity", "0.5")


@pytest.fixture
def swept(tmp_path):
    """Every episode of a constructed sweep, to be changed."""
    return read_sweep_episodes(write_sweep(tmp_path / "sweep") / "episodes.csv")


def test_trainings_that_lose_half_are_counted_beside_those_that_lose_for_certain(swept):
    for seed, kept in ((0, 8), (1, 7), (2, 12)):
        own = swept[MANY, "bytestream"][seed]
        own["success"] = np.arange(own.size) < kept  # of 16 to 20 before
    sentence = in_short(ABOUT, swept, changes_of(ABOUT, swept), {}, {})[1]
    before = [swept[NOMINAL, "bytestream"][seed]["success"].sum() for seed in (0, 1, 2)]
    halved = sum(kept <= all_of / 2 for kept, all_of in zip((8, 7, 12), before, strict=True))
    assert 0 < halved < 3
    assert f"{halved} with 50 % dead pixels (" in sentence


def test_policies_are_recommended_by_the_same_conditions_whatever_changes_them(swept):
    """What is the same simulation as the baseline for one group counts for it nonetheless."""
    for at in (NOMINAL, FEW, MANY):
        swept[at, "bytestream"] = {seed: flights(14) for seed in (0, 1, 2)}
        swept[at, "event_image"] = {0: flights(10 if at == MANY else 20)}
    swept[FEW, "bytestream"][0]["steps"][0] += 1
    first = in_short(ABOUT, swept, changes_of(ABOUT, swept), {}, {})[0]
    assert first.startswith("Take [`event_image`](train.md): 100 % with nothing changed, 75 % as the mean")


def test_a_policy_that_was_not_evaluated_unchanged_is_not_recommended(swept):
    about = {**ABOUT, "compared": [*ABOUT["compared"][:2],
                                   {**ABOUT["compared"][2], "baseline": ["sparsity", "0.2"]}]}  # fmt: skip
    first = in_short(about, swept, changes_of(about, swept), {}, {})[0]
    assert first.startswith("Take [`bytestream`](train.md): 80 %")
    del swept[NOMINAL, "bytestream"]
    changes = changes_of(about, swept)
    assert in_short(about, swept, changes, {}, {})[0].startswith("Take [`event_image`](train.md): 20 %")
    assert "| `bytestream` | - |" in breaks_table(about, changes)
    del swept[NOMINAL, "event_image"]
    assert in_short(about, swept, changes_of(about, swept), {}, {})[0].startswith("What breaks most")


def test_the_success_of_policies_on_the_papers_encoder_is_told(swept):
    sentence = in_short(ABOUT, swept, changes_of(ABOUT, swept), {}, {})[3]
    assert "`bytestream` succeeds in 80 % of its episodes" in sentence
    other = {(at, group.replace("bytestream", "ours")): own for (at, group), own in swept.items()}
    about = {
        **ABOUT,
        "groups": {group.replace("bytestream", "ours"): own for group, own in ABOUT["groups"].items()},
    }
    assert not any("VAE" in one for one in in_short(about, other, changes_of(about, other), {}, {}))


def test_a_group_that_has_little_to_lose_is_named_beside_a_claim_about_losses():
    about, swept = read_data(REPOSITORY / "docs" / "data", "robustness")
    findings = judge_claims(about, swept, [])
    (reversed_,) = [claim for claim, one in findings.items() if one.verdict == "reversed"]
    assert (reversed_.theirs, reversed_.change) == ("rgb", True)
    assert set(weak_groups(about, swept)) == {"rgb"}
    sentence = in_short(about, swept, changes_of(about, swept), findings, {})[4]
    assert "`rgb` certainly loses less than `bytestream`, of which the paper says" in sentence
    assert "(`rgb` succeeds in 40 % with nothing changed, and has little to lose)" in sentence


def test_what_is_reversed_names_the_better_group_first_and_what_it_beats_alike_together():
    about, swept = read_data(REPOSITORY / "docs" / "data", "taught_claims")
    findings = judge_claims(about, swept, [])
    assert sum(one.verdict == "reversed" for one in findings.values()) == 2
    sentence = in_short(about, swept, changes_of(about, swept), findings, {})[-1]
    assert (
        "None holds. Reversed: `event_image` certainly loses less than `bytestream` and `bytestream_xy`, of "
        "which the paper says: tolerates background activity." in sentence
    )


def test_what_no_study_decides_is_named_last():
    about, swept = read_data(REPOSITORY / "docs" / "data", "robustness")
    findings = judge_claims(about, swept, [])
    left = [claim for claim, one in findings.items() if one.verdict == "undecided"]
    some, others = left[: len(left) // 2], left[len(left) // 2 :]
    decided = Finding("equivalent", None, {})
    studies = {TAUGHT: dict.fromkeys(others, decided), BY_PPO: dict.fromkeys(some[1:], decided)}
    last = in_short(about, swept, changes_of(about, swept), findings, studies)[-1]
    assert last.startswith(f"Undecided in each of these, 1 of the {len(findings)} tests: `{some[0].ours}` ")
    assert some[0].text in last
    studies[BY_PPO][some[0]] = decided
    last = in_short(about, swept, changes_of(about, swept), findings, studies)[-1]
    assert "decided by at least one" in last


def test_conditions_that_tie_with_the_third_are_named_too_and_those_of_another_baseline_with_it(swept):
    several = {f"0.{n}": {"faults.sparsity": n / 10} for n in range(2, 8)}
    places = [("nominal", "poles_eval"), *(("sparsity", value) for value in several)]
    about = {**ABOUT, "axes": {"nominal": {"poles_eval": {}}, "sparsity": several}}
    about["compared"] = [
        {"condition": at, "baseline": places[1] if at == places[6] else places[0], "same_as": at}
        for at in places
    ]
    kept = {"0.2": 18, "0.3": 2, "0.4": 3, "0.5": 4, "0.6": 5, "0.7": 6}
    flown = {(at, "bytestream"): {s: flights(kept.get(at[1], 20)) for s in (0, 1, 2)} for at in places}
    sentence = in_short(about, flown, changes_of(about, flown), {}, {})[1]
    for share in ("30", "40", "50", "60"):
        assert f"3 with {share} % dead pixels (" in sentence
    assert "3 with 70 % dead pixels against 20 % dead pixels (" in sentence
    assert "with 20 % dead pixels (" not in sentence


def recommended(won):
    """What is recommended where the trainings of each group succeed so often of 20, in every condition."""
    about = {**ABOUT, "groups": {group: list(range(len(own))) for group, own in won.items()}}
    swept = {
        (at, group): {seed: flights(count - place) for seed, count in enumerate(own)}
        for place, at in enumerate((NOMINAL, FEW, MANY))
        for group, own in won.items()
    }
    return in_short(about, swept, changes_of(about, swept, every=True), {}, {})[0]


def test_a_lead_that_other_trainings_would_keep_is_told_apart_from_a_lucky_one():
    sure = recommended({"ours": (19, 18, 19), "near": (17, 18, 19), "far": (4, 3, 4)})
    assert sure.startswith("Take [`ours`]")
    assert "certain over 1 of the 2 other groups" in sure
    assert "all 3 pairs" in sure
    assert "next best, `near`, is 3 [" in sure
    assert "(`far`)" in sure
    lucky = recommended({"ours": (20, 12, 4), "near": (17, 11, 6)})
    assert "certain over 0 of the 1 other groups" in lucky


def test_pairs_without_the_best_group_count_in_the_family():
    """Which group is best is found by the same episodes: who looks at more groups wants larger leads."""
    two = {"ours": (16, 17, 18), "near": (6, 8, 11)}
    assert "over 1 of the 1 other" in recommended(two)
    assert "over 0 of the 2 other" in recommended({**two, "beside": (6, 8, 11)})


def test_of_a_single_training_nothing_is_said_of_others():
    alone = recommended({"ours": (19,), "near": (17, 18, 19), "far": (4, 3, 4)})
    assert alone.startswith("Take [`ours`]")
    assert "single training" in alone
    assert "lead" not in alone
    beside = recommended({"ours": (19, 18), "near": (17,)})
    assert "No other group has several trainings" in beside
