import numpy as np
import pytest

from jobs.analysis.statistics import Difference, trainings_needed
from jobs.config.conditions import NOMINAL
from jobs.evaluation.group_stats import episode_values
from jobs.reporting.paper_claims import (
    CLAIMS,
    LEARNT,
    VAE,
    Claim,
    compare,
    compare_learning,
    judge_all,
    verdict_of,
)
from tests.support.episodes import flights

BEFORE, AT = (NOMINAL, "poles"), (("world", "a"), ("world", "b"))
BASELINES = dict.fromkeys((BEFORE, *AT), BEFORE)


def found(*pairs, before=(20, 20)):
    """Episodes of two trainings of ours and theirs in each condition, by their successes."""
    table = {(at, group): {0: flights(won), 1: flights(won)}
             for at, pair in zip((BEFORE, *AT), (before, *pairs), strict=False)
             for group, won in zip(("ours", "theirs"), pair, strict=True)}  # fmt: skip
    return lambda at, group: table.get((at, group), {})


def claim(change=False, measure="success"):
    return Claim("it is better", "D.3", "ours", "theirs", measure, AT, change)


@pytest.mark.parametrize(
    ("value", "interval", "p", "verdict"),
    [
        (0.3, (0.2, 0.4), 0.001, "holds"),
        (-0.3, (-0.4, -0.2), 0.001, "reversed"),
        (0.3, (0.01, 0.6), 0.2, "undecided"),  # certain alone, not within its family
        (0.01, (-0.05, 0.08), 0.7, "equivalent"),
        (-0.2, (-0.45, 0.05), 0.1, "does not hold"),
        (0.0, (-0.3, 0.3), 1.0, "undecided"),
        (0.2, None, None, "undecided"),
    ],
)
def test_a_claim_is_judged_by_its_difference(value, interval, p, verdict):
    assert verdict_of(Difference(value, interval, p), p, 0.1) == verdict
    assert verdict_of(None, None, 0.1) == "not tested"


def test_the_difference_over_all_conditions_is_their_mean_with_each_beside_it():
    finding = compare(claim(), found((18, 4), (10, 6)), BASELINES)
    assert finding.overall.value == pytest.approx((14 + 4) / 40)
    assert [one.value for one in finding.conditions.values()] == pytest.approx([0.7, 0.2])


def test_robustness_is_what_a_condition_changes_and_not_who_is_better():
    episodes = found((16, 8), (16, 8), before=(20, 12))
    assert compare(claim(), episodes, BASELINES).overall.value == pytest.approx(0.4)
    assert compare(claim(change=True), episodes, BASELINES).overall.value == pytest.approx(0.0)
    finding = compare(claim(change=True), found((10, 12), before=(20, 12)), BASELINES)
    assert finding.overall.value == pytest.approx(-0.5)
    assert finding.overall.p < 0.05


def test_what_was_not_evaluated_is_not_tested():
    assert compare(claim(), found(), BASELINES).overall is None
    assert len(compare(claim(), found((18, 4)), BASELINES).conditions) == 1


def test_of_one_training_nothing_follows_for_others():
    table = {(AT[0], "ours"): {0: flights(18)}, (AT[0], "theirs"): {0: flights(3), 1: flights(4)}}
    finding = compare(claim(), lambda at, group: table.get((at, group), {}), BASELINES)
    assert finding.overall.p is None
    assert finding.overall.value > 0.5


def test_a_claim_is_about_the_trainings_that_have_all_of_its_conditions():
    table = {(AT[0], "ours"): {0: flights(18), 1: flights(16), 2: flights(2)},
             (AT[1], "ours"): {2: flights(4), 1: flights(14)},
             (AT[0], "theirs"): {0: flights(3)}, (AT[1], "theirs"): {0: flights(3)}}  # fmt: skip
    finding = compare(claim(), lambda at, group: table.get((at, group), {}), BASELINES)
    assert finding.overall.value == pytest.approx((16 + 2 + 14 + 4) / 80 - 3 / 20)
    assert [one.value for one in finding.conditions.values()] == pytest.approx([0.45 - 0.15, 0.45 - 0.15])
    del table[AT[1], "ours"][1], table[AT[1], "ours"][2]
    table[AT[1], "ours"][5] = flights(20)  # no training has both
    assert compare(claim(), lambda at, group: table.get((at, group), {}), BASELINES).overall is None


def test_a_training_that_lacks_a_condition_takes_none_from_the_claim():
    """Of three that fail under b, one was not evaluated there."""
    won = {BEFORE: (20, 20), AT[0]: (20, 8), AT[1]: (0, 20)}
    table = {(at, group): {seed: flights(count) for seed in (0, 1, 2)}
             for at, counts in won.items()
             for group, count in zip(("ours", "theirs"), counts, strict=True)}  # fmt: skip
    del table[AT[1], "ours"][2]
    finding = compare(claim(change=True), lambda at, group: table.get((at, group), {}), BASELINES)
    assert finding.overall.value == pytest.approx((0.6 - 1.0) / 2)
    assert len(finding.conditions) == 2


def test_trainings_are_paired_by_their_seed_whatever_their_order():
    table = {
        (BEFORE, "ours"): {0: flights(20), 1: flights(4)},
        (AT[0], "ours"): {1: flights(4), 0: flights(20)},
    }
    table |= {(at, "theirs"): {0: flights(10), 1: flights(10)} for at in (BEFORE, AT[0])}
    finding = compare(claim(change=True), lambda at, group: table.get((at, group), {}), BASELINES)
    assert finding.overall.value == 0.0
    low, high = finding.overall.interval
    assert -0.8 < low < 0.0 < high < 0.8  # paired by their order: changes of +0.8 and -0.8


def test_distances_that_agree_at_the_goal_are_equivalent_only_after_enough_episodes():
    def verdict(trainings):
        table = {(at, group): {seed: flights(20) for seed in range(trainings)}
                 for at in AT for group in ("ours", "theirs")}  # fmt: skip
        one = compare(claim(measure="distance_m"), lambda at, group: table.get((at, group), {}), BASELINES)
        return verdict_of(one.overall, one.overall.p, 10.0)

    assert verdict(2) == "undecided"
    assert verdict(10) == "equivalent"


def test_all_claims_are_one_family():
    rates = {
        LEARNT[0].ours: (0.7, 0.72, 0.71),
        LEARNT[1].ours: (0.5, 0.4, 0.6),
        LEARNT[0].theirs: (0.4, 0.42, 0.38),
    }
    alone = compare_learning(LEARNT[0], rates).overall.p
    findings = judge_all(lambda at, group: {}, {}, rates)
    assert set(findings) == {*CLAIMS, *LEARNT}
    assert findings[LEARNT[0]].adjusted_p == pytest.approx(2 * alone)
    assert findings[LEARNT[0]].verdict == "holds"
    assert {findings[one].verdict for one in CLAIMS} == {"not tested"}


def test_what_an_undecided_claim_needs_is_counted_by_its_own_episodes_and_for_all_tests():
    one, other = next(claim for claim in CLAIMS if claim.text == VAE), LEARNT[0]
    (at,) = one.conditions
    table = {(at, one.ours): {seed: flights(won) for seed, won in enumerate((9, 14, 11))},
             (at, one.theirs): {seed: flights(won) for seed, won in enumerate((12, 8, 13))}}  # fmt: skip
    rates = {one.ours: (0.7, 0.2, 0.4), one.theirs: (0.6, 0.1, 0.9), other.ours: (0.7, 0.3, 0.5)}

    def needed(learning):
        return judge_all(lambda at, group: table.get((at, group), {}), {}, learning)[one].needed

    sides = [episode_values(table[at, group], "success") for group in (one.ours, one.theirs)]
    assert needed({}) == trainings_needed(*sides, 0.1, 1, (0.0, 1.0))
    assert needed(rates) == trainings_needed(*sides, 0.1, 2, (0.0, 1.0)) > needed({})


def test_the_papers_claims_are_about_conditions_of_the_default_sweep_and_their_baselines(tmp_path):
    from tests.support.configs import small_config, sweep_config
    from tests.support.runs import planned

    axes = small_config(tmp_path, job="sweep").sweep.axes
    sweep = planned(sweep_config(tmp_path, axes=axes), "straight")
    assert {at for claim in CLAIMS for at in claim.conditions} <= set(sweep.conditions)
    nominal = (NOMINAL, "poles_eval")
    dense = {at: base for at, base in sweep.baselines.items() if at[0] == "control_hz_dense"}
    assert set(dense.values()) == {("control_hz_dense", "200")}
    assert sweep.baselines["memory_400hz", "frame"] == ("control_hz", "400")
    assert {base for at, base in sweep.baselines.items() if at[0] in ("world", "sensor_noise")} == {nominal}
    assert sweep.same_as["world", "poles_dense"] == ("control_hz_dense", "200")
    assert sweep.same_as["sparsity", "0"] == nominal
    assert sweep.same_as["sparsity", "0.5"] == ("sparsity", "0.5")


@pytest.mark.parametrize(
    ("ours", "theirs", "low", "high"),
    [((0.7, 0.72, 0.71), (0.4, 0.42, 0.38), 0, 0.001), ((0.9, 0.3, 0.6), (0.4, 0.5, 0.2), 0.05, 1)],
)
def test_who_learns_faster_is_judged_by_the_means_of_all_trainings(ours, theirs, low, high):
    one = LEARNT[0]
    finding = compare_learning(one, {one.ours: ours, one.theirs: theirs})
    assert low <= finding.overall.p <= high
    assert finding.overall.value == pytest.approx(np.mean(ours) - np.mean(theirs))
    assert compare_learning(one, {one.ours: ours[:1], one.theirs: theirs}).overall.p is None
    assert compare_learning(one, {one.theirs: theirs}).overall is None
