import pytest

from jobs.reporting.paper_claims import CLAIMS, LEARNT, Claim, judge, judge_learning
from tests.support.episodes import flights

AT = (("world", "a"), ("world", "b"))
CLAIM = Claim("it is better", "D.3", "ours", "theirs", "success", AT)


def found(*pairs):
    """Flights of ours and theirs in each condition, by their successes."""
    table = {(at, group): {0: flights(won)} for at, pair in zip(AT, pairs, strict=False)
             for group, won in zip(("ours", "theirs"), pair, strict=True)}  # fmt: skip
    return lambda at, group: table.get((at, group), {})


@pytest.mark.parametrize(
    ("pairs", "verdict"),
    [
        (((18, 4), (18, 6)), "holds"),
        (((18, 4), (10, 10)), "holds"),
        (((19, 2), (4, 16)), "holds partly"),
        (((20, 0), (6, 12)), "holds partly"),
        (((11, 10), (11, 10)), "undecided"),
        (((10, 10), (12, 12)), "does not hold"),
        (((8, 10), (10, 12)), "does not hold"),
        (((4, 18), (6, 18)), "does not hold"),
        (((18, 4),), "holds"),
        ((), "not tested"),
    ],
)
def test_a_claim_is_judged_by_its_differences(pairs, verdict):
    assert judge(CLAIM, found(*pairs)).verdict == verdict


def test_the_difference_over_all_conditions_is_their_mean_with_each_beside_it():
    finding = judge(CLAIM, found((18, 4), (10, 6)))
    assert finding.overall.value == pytest.approx((14 + 4) / 40)
    assert [estimate.value for estimate in finding.conditions.values()] == pytest.approx([0.7, 0.2])


def test_a_condition_with_a_training_less_is_still_compared():
    table = {(AT[0], "ours"): {0: flights(18), 1: flights(16)}, (AT[1], "ours"): {1: flights(14)},
             (AT[0], "theirs"): {0: flights(3)}, (AT[1], "theirs"): {0: flights(3)}}  # fmt: skip
    finding = judge(CLAIM, lambda at, group: table.get((at, group), {}))
    assert finding.overall.value == pytest.approx((17 / 20 + 14 / 20) / 2 - 3 / 20)


def test_the_papers_claims_are_about_conditions_that_the_default_sweep_flies(tmp_path):
    from tests.support.configs import small_config, sweep_config
    from tests.support.runs import planned

    axes = small_config(tmp_path, job="sweep").sweep.axes
    conditions = planned(sweep_config(tmp_path, axes=axes), "straight").conditions
    assert {at for claim in CLAIMS for at in claim.conditions} <= set(conditions)
    assert {claim.measure for claim in CLAIMS} == {"success", "distance_m"}


@pytest.mark.parametrize(
    ("ours", "theirs", "verdict"),
    [
        ((0.7, 0.72, 0.71), (0.4, 0.42, 0.38), "holds"),
        ((0.4, 0.42, 0.38), (0.7, 0.72, 0.71), "does not hold"),
        ((0.7, 0.72, 0.71), (0.69, 0.71, 0.7), "does not hold"),
        ((0.9, 0.3, 0.6), (0.4, 0.5, 0.2), "undecided"),
        ((0.9,), (0.4,), "undecided"),
        ((), (0.4, 0.5), "not tested"),
    ],
)
def test_who_learns_faster_is_judged_by_the_means_of_all_trainings(ours, theirs, verdict):
    claim = LEARNT[0]
    finding = judge_learning(claim, {claim.ours: ours, claim.theirs: theirs})
    assert finding.verdict == verdict
    if ours:
        assert finding.overall.value == pytest.approx(sum(ours) / len(ours) - sum(theirs) / len(theirs))
