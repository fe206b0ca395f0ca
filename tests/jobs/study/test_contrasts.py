import numpy as np
import pytest

from jobs.analysis.statistics import Difference
from jobs.study.contrasts import judge, verdict_of
from jobs.study.results import Results
from jobs.study.spec import Contrast, Family, Side
from tests.support.episodes import flights

NOMINAL, A, B = ("nominal", "poles"), ("world", "a"), ("world", "b")
WORDS = {"above": "holds", "below": "reversed", "no_gain": "no gain", "no_loss": "no loss"}
GAIN = {"success": 0.1, "distance_m": 5.0}


def family(*contrasts, words=WORDS, **changes):
    one = Family("claims", "Claims", contrasts, "holm", GAIN, words, False, {}, "", {})
    return one._replace(**changes)


def better(at=(A, B), change=False, measure="success", paired=False, ours="ours", theirs="theirs"):
    less = (NOMINAL,) * len(at) if change else ()
    return Contrast("better", "", Side(ours, at, less), Side(theirs, at, less), measure, paired)


def results(table):
    return Results({"groups": {group: list(own) for (_, group), own in table.items()}, "axes": {}}, table)


def found(*pairs, before=(20, 20)):
    """Two trainings of ours and theirs in each condition, by their successes."""
    return {(at, group): {0: flights(won), 1: flights(won)}
            for at, pair in zip((NOMINAL, A, B), (before, *pairs), strict=False)
            for group, won in zip(("ours", "theirs"), pair, strict=True)}  # fmt: skip


def judged(contrast, table, **changes):
    (one,) = judge(family(contrast, **changes), results(table))
    return one


@pytest.mark.parametrize(
    ("value", "interval", "p", "verdict"),
    [
        (0.3, (0.2, 0.4), 0.001, "holds"),
        (0.3, (0.01, 0.6), 0.2, "no loss"),  # certain alone, not within its family
        (0.01, (-0.05, 0.08), 0.7, "no gain, no loss"),
        (0.01, (-0.05, 0.1), 0.7, "no loss"),  # at the margin nothing is excluded
        (0.2, (-0.05, 0.45), 0.1, "no loss"),
        (0.0, (-0.3, 0.3), 1.0, "undecided"),
        (0.2, None, None, "undecided"),
    ],
)
def test_certainty_comes_before_the_interval_of_the_single_test(value, interval, p, verdict):
    assert verdict_of(Difference(value, interval, p), p, 0.1, WORDS) == verdict
    turned = Difference(-value, interval and (-interval[1], -interval[0]), p)
    mirrored = {"holds": "reversed", "reversed": "holds", "no gain": "no loss", "no loss": "no gain"}
    assert verdict_of(turned, p, 0.1, WORDS) == mirrored.get(verdict, verdict)
    only = {"above": "certain", "below": "certain"}
    assert verdict_of(Difference(value, interval, p), p, 0.1, only) in ("certain", "undecided")


LOST = Contrast("errors", "", Side("ours", (A, B), (NOMINAL, NOMINAL)), None, "success", True)
FEWER = Contrast("loss", "", Side("ours", (A,), (A, B)), None, "success", True)


@pytest.mark.parametrize(
    ("contrast", "table", "value"),
    [
        (better(), found((18, 4), (10, 6)), (14 - 5) / 20),
        (better(), found((16, 8), (16, 8), before=(20, 12)), 0.4),
        (better(change=True), found((16, 8), (16, 8), before=(20, 12)), 0.0),
        (better(at=(A,), change=True), found((10, 12), before=(20, 12)), -0.5),
        (LOST, found((16, 0), (12, 0)), -0.3),
        (FEWER, found((20, 0), (10, 0)), 1.0 - 0.75),
        (better(), found((18, 4)), 0.7),  # of one condition there is nothing
    ],
)
def test_a_side_is_the_mean_of_its_conditions_less_that_of_its_baselines(contrast, table, value):
    assert judged(contrast, table).difference.value == pytest.approx(value)


def test_of_one_training_nothing_follows_for_others():
    table = {(A, "ours"): {0: flights(18)}, (A, "theirs"): {0: flights(3), 1: flights(4)}}
    one = judged(better(), table)
    assert (one.difference.p, one.verdict) == (None, "undecided")
    assert one.difference.value > 0.5


def test_only_trainings_that_have_all_conditions_are_compared():
    table = {(A, "ours"): {0: flights(18), 1: flights(16), 2: flights(2)},
             (B, "ours"): {2: flights(4), 1: flights(14)},
             (A, "theirs"): {0: flights(3)}, (B, "theirs"): {0: flights(3)}}  # fmt: skip
    assert judged(better(), table).difference.value == pytest.approx((16 + 2 + 14 + 4) / 80 - 3 / 20)
    table[B, "ours"] = {5: flights(20)}  # no training has both
    assert judged(better(), table).verdict == "not tested"


def test_pairs_are_trainings_of_one_seed_whatever_their_order():
    won = {0: 20, 1: 4, 2: 12}
    table = {(A, "ours"): {seed: flights(won[seed]) for seed in (2, 0, 1)},
             (A, "theirs"): {seed: flights(won[seed]) for seed in (0, 1, 2)}}  # fmt: skip
    table[A, "theirs"] = {**table[A, "theirs"], 7: flights(1)}  # without a partner
    one = judged(better(at=(A,), paired=True), table)
    assert one.difference.value == 0.0
    apart = judged(better(at=(A,)), table)
    assert np.ptp(one.difference.interval) < np.ptp(apart.difference.interval)


def test_distances_that_agree_at_the_goal_are_equivalent_only_after_enough_episodes():
    for trainings, verdict in ((2, "undecided"), (10, "no gain, no loss")):
        own = {seed: flights(20) for seed in range(trainings)}
        table = {(at, group): own for at in (A, B) for group in ("ours", "theirs")}
        assert judged(better(measure="distance_m"), table).verdict == verdict


def test_an_exclusion_is_certain_only_if_it_is_so_among_all_tests_of_the_family():
    """The one-sided p of an exclusion is that of the interval's end, and Holm's in its family."""
    rates = {"learned": {"a": np.linspace(0.48, 0.53, 6), "b": np.linspace(0.47, 0.55, 6)}}
    alone = judge(family(learnt("a", "b")), results({}), rates)[0]
    low, high = alone.difference.interval
    assert alone.difference.p_of_gain(high) == pytest.approx(0.025)
    assert alone.difference.p_of_loss(-low) == pytest.approx(0.025)
    assert alone.difference.p_of_gain(0.0) == pytest.approx(1 - alone.difference.p_of_loss(0.0))
    close = {"success": 1.02 * high}
    one = judge(family(learnt("a", "b"), margin=close), results({}), rates)[0]
    many = judge(family(*[learnt("a", "b")] * 18, margin=close), results({}), rates)
    assert one.excluded["no gain"]
    assert [found.excluded["no gain"] for found in many] == [False] * 18
    assert {found.verdict for found in many} == {one.verdict}


def learnt(*groups):
    return Contrast("learns faster", "", Side(groups[0], ()), Side(groups[1], ()), "learned", False)


def test_all_tests_are_one_family_and_what_is_not_tested_is_in_none():
    rates = {"learned": {"a": (0.7, 0.72, 0.71), "b": (0.5, 0.4, 0.6), "c": (0.4, 0.42, 0.38)}}
    three = family(learnt("a", "c"), learnt("b", "c"), learnt("d", "c"))
    one, other, absent = judge(three, results({}), rates)
    assert one.adjusted_p == pytest.approx(2 * one.difference.p)
    assert one.difference.value == pytest.approx(0.71 - 0.4)
    assert (one.verdict, absent.verdict) == ("holds", "not tested")
    alone = judge(three._replace(adjust="none"), results({}), rates)
    assert [found.adjusted_p for found in alone[:2]] == [one.difference.p, other.difference.p]


def test_other_corridors_for_one_training_are_refused():
    table = {(A, "ours"): {0: flights(18), 1: flights(16)}, (A, "theirs"): {0: flights(3), 1: flights(3)}}
    table[A, "ours"][1]["seed"] += 1
    with pytest.raises(ValueError, match="same corridors"):
        judged(better(at=(A,)), table)
