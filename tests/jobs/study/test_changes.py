import pytest

from jobs.study.changes import changes_of, compared_pairs, replicated
from jobs.study.results import Results, read_cells
from jobs.study.tables import certain_losses_table, worst_sentence
from tests.support.episodes import flights
from tests.support.sweep_folders import ABOUT, write_sweep

NOMINAL, FEW, MANY = ("nominal", "poles_eval"), ("sparsity", 0.2), ("sparsity", 0.5)


@pytest.fixture
def swept(tmp_path):
    """Every episode of a constructed sweep, to be changed."""
    return read_cells(write_sweep(tmp_path / "sweep") / "episodes.csv")


def changes(swept, every=False, **facts):
    return changes_of(Results({**ABOUT, **facts}, swept), every)


def test_a_group_changes_for_certain_where_all_of_its_trainings_do(swept):
    for seed in (0, 1, 2):
        swept[MANY, "bytestream"][seed]["success"] = False
        swept[FEW, "bytestream"][seed]["success"][:1] = False
    swept[MANY, "event_image"][0]["success"] = True
    found = changes(swept)
    assert {(one.condition, one.group, one.certain) for one in found} == {
        (FEW, "bytestream", False), (MANY, "bytestream", True),
        (FEW, "event_image", False), (MANY, "event_image", False),
    }  # fmt: skip
    text = certain_losses_table(Results(ABOUT, swept), found)
    assert "| `bytestream` (3) | 50 % dead pixels: 80 to 0 %, -80 [" in text
    assert "] (3) |" in text
    assert "oracle" not in text


def test_one_training_that_loses_says_nothing_of_others_and_one_that_gains_does_not_lose(swept):
    swept[MANY, "bytestream"][1]["success"] = False
    swept[FEW, "event_image"][0]["success"] = True  # from 4 to 20 of 20: certain, and no loss
    found = {(one.condition, one.group): one for one in changes(swept)}
    assert found[MANY, "bytestream"].broken.tolist() == [False, True, False]
    assert not found[MANY, "bytestream"].certain
    assert not found[FEW, "event_image"].broken.any()


def test_changes_are_those_of_the_same_trainings_whatever_their_order(swept):
    before = [one.condition for one in changes(swept) if one.group == "bytestream"]
    swept[NOMINAL, "bytestream"] = {seed: swept[NOMINAL, "bytestream"][seed] for seed in (2, 0, 1)}
    swept[NOMINAL, "bytestream"][2]["success"] = False
    turned = [one for one in changes(swept) if one.group == "bytestream"]
    assert [one.condition for one in turned] == before
    assert all(one.before.tolist()[2] == 0.0 < min(one.before.tolist()[:2]) for one in turned)


def test_a_group_of_another_rate_has_its_own_baseline(swept):
    nominal, few, many = (one["condition"] for one in ABOUT["compared"])
    usual = {"baseline": nominal, "own_baseline": {"bytestream": many}}
    told = [{"condition": at, "same_as": at, **usual} for at in (nominal, few, many)]
    found = {(one.group, one.condition, one.baseline) for one in changes(swept, every=True, compared=told)}
    assert {pair[1:] for pair in found if pair[0] == "bytestream"} == {(NOMINAL, MANY), (FEW, MANY)}
    assert {pair[1:] for pair in found if pair[0] == "event_image"} == {(FEW, NOMINAL), (MANY, NOMINAL)}


def test_a_scene_that_is_the_baseline_of_an_axis_is_itself_compared_once():
    """`world/dense` is the simulation of `rate_dense/200`, which is its own baseline."""
    usual, dense, slow = ["nominal", "poles_eval"], ["rate_dense", "200"], ["rate_dense", "25"]
    rows = [
        (usual, usual, usual),
        (dense, dense, dense),
        (slow, dense, slow),
        (["world", "same"], usual, usual),
        (["world", "dense"], usual, dense),
        (["scene", "dense"], ["world", "same"], dense),
        (["slow", "25"], ["world", "dense"], slow),
    ]
    told = [dict(zip(("condition", "baseline", "same_as"), row, strict=True)) for row in rows]
    assert compared_pairs(Results({**ABOUT, "compared": told}, {})) == [
        (("rate_dense", 25.0), ("rate_dense", 200.0)),
        (("world", "dense"), NOMINAL),
    ]


def test_what_is_the_baseline_for_one_group_alone_is_no_change_of_it(swept):
    """By whole episodes: equal successes of other episodes are a finding."""
    assert len(changes(swept)) == 4  # all successes agree, and yet the episodes differ
    swept[FEW, "bytestream"] = swept[NOMINAL, "bytestream"]
    swept[MANY, "event_image"] = swept[FEW, "event_image"]
    left = [(one.condition, one.group) for one in changes(swept)]
    assert left == [(FEW, "event_image"), (MANY, "bytestream")]
    assert len(changes(swept, every=True)) == 4
    swept[FEW, "bytestream"] = {seed: rows.copy() for seed, rows in swept[NOMINAL, "bytestream"].items()}
    swept[FEW, "bytestream"][2]["steps"][0] += 1  # one step of one training
    assert len(changes(swept)) == 3


def test_a_group_of_one_training_is_in_no_test_of_groups(swept):
    for own in swept[MANY, "bytestream"].values():
        own["success"] = False
    swept[NOMINAL, "event_image"][0]["success"] = True
    swept[MANY, "event_image"][0]["success"] = False
    found = {(one.condition, one.group): one for one in changes(swept)}
    assert found[MANY, "bytestream"].certain
    assert found[MANY, "event_image"].broken.tolist() == [True]
    assert not found[MANY, "event_image"].certain
    assert [one.group for one in replicated(list(found.values()))] == ["bytestream", "bytestream"]
    assert [one.certain for one in changes(swept, groups={"event_image": [0]})] == [False, False]


def test_the_worst_conditions_are_those_in_which_most_trainings_lose_half(swept):
    for seed, kept in ((0, 8), (1, 7), (2, 12)):
        swept[MANY, "bytestream"][seed] = flights(kept)  # of 16 before
    sentence = worst_sentence(Results(ABOUT, swept), changes(swept))
    assert sentence.startswith("Of 4 trainings lose half of their success or more")
    assert "2 with 50 % dead pixels (" in sentence
