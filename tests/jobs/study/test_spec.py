import json

import pytest
import yaml

from jobs.config.errors import ConfigError
from jobs.run.provenance import REPOSITORY
from jobs.study.results import Results, text_of
from jobs.study.spec import CONF, families_of, read_study
from tests.support.configs import compose, sweep_config
from tests.support.runs import planned

FACTS = {
    "axes": {"nominal": {"poles": {}}, "hz": {"45": {"env.control_hz": 45}, "400": {"env.control_hz": 400}},
             "late": {"50": {"env.action_delay_ms": 50}}},
    "groups": {"a_45": [0, 1], "a_400": [0, 1], "b_45": [0, 1], "oracle": [None]},
}  # fmt: skip
TAGS = {name: {"kind": name[0], "at_hz": int(name[2:])} for name in ("a_45", "a_400", "b_45")}


def families(said):
    study = {"variants": {name: {"tags": tags} for name, tags in TAGS.items()}, "families": {"one": said}}
    return families_of(study, Results(json.loads(json.dumps(FACTS)), {}))


def contrasts(said):
    (family,) = families({"contrasts": said} if isinstance(said, list) else said)
    return family.contrasts


def test_a_test_of_a_group_or_a_condition_that_the_study_lacks_is_left_out():
    assert contrasts([{"ours": "a_45", "theirs": "rgb"}]) == ()
    (one,) = contrasts([{"ours": "a_45", "at": {"hz": [45, 100], "moon": "all"}}])
    assert one.ours.at == (("hz", 45.0),)


def test_baselines_are_those_of_each_condition():
    (one,) = contrasts([{"ours": "a_45", "at": {"hz": "all", "late": "all"}, "less": "baseline"}])
    assert one.ours.less == (("nominal", "poles"),) * 3
    (mean,) = contrasts([{"ours": "a_45", "at": {"hz": [45]}, "less": {"hz": "all"}}])
    assert mean.ours.less == (("hz", 45.0), ("hz", 400.0))


def compared(**ends):
    """The facts in which conditions have this end each; others are nominal and themselves."""
    every = [["nominal", "poles"], ["hz", "45"], ["hz", "400"], ["late", "50"]]
    return {**FACTS, "compared": [
        {"condition": at, "baseline": every[0], "same_as": at, **{end: to(at) for end, to in ends.items()}}
        for at in every
    ]}  # fmt: skip


def test_a_condition_that_is_its_own_baseline_averages_no_zero_into_a_change():
    facts = compared(baseline=lambda at: ["hz", "400"])
    said = {"contrasts": [{"ours": "a_45", "theirs": "b_45", "at": {"hz": "all"}, "less": "baseline"}]}
    (family,) = families_of({"families": {"one": said}}, Results(facts, {}))
    (one,) = family.contrasts
    assert (one.ours.at, one.ours.less) == ((("hz", 45.0),), (("hz", 400.0),))
    assert one.theirs.at == one.ours.at


def test_all_conditions_are_every_simulation_once_and_the_unchanged_one_too():
    facts = compared(same_as=lambda at: ["nominal", "poles"] if at[0] == "late" else at)
    study = {"families": {"one": {"contrasts": [{"ours": "a_45"}], "pairs": {"at": "all"}}}}
    (family,) = families_of(study, Results(facts, {}))
    assert family.contrasts[0].ours.at == (("nominal", "poles"), ("hz", 45.0), ("hz", 400.0))


def test_the_other_account_is_absolute_and_charges_no_recorded_steps():
    change = {"ours": "a_45", "at": {"hz": [45]}, "less": "baseline"}
    learns = {"ours": "a_45", "theirs": "b_45", "measure": "learned"}
    neither = {"ours": "a_45", "at": {"hz": [45]}}
    one, other = contrasts({"account": "other", "contrasts": [change, learns, neither]})
    assert (one.ours.at, one.ours.less) == ((("hz", 45.0),), ())
    assert other.measure == "learned_uncharged"


def test_a_shared_family_keeps_its_names_for_groups_that_are_called_otherwise():
    said = {"as": {"b_45": "a_400"}, "contrasts": [{"ours": "b_45", "theirs": "a_45"}]}
    (family,) = families(said)
    (one,) = family.contrasts
    assert (one.ours.group, one.theirs.group) == ("a_400", "a_45")
    assert family.alias == {"a_400": "b_45"}


REFUSED = {
    "no such key": ({"contrast": []}, "has the keys"),
    "a wrong correction": (
        {"adjust": "bonferroni", "contrasts": []},
        "adjust holm, bh or none, got 'bonferroni'",
    ),
    "a wrong word": ({"words": {"better": "yes"}, "contrasts": []}, r"got \['words.better'\]"),
    "a wrong file": ("moon", "must name a file of conf/claims, got 'moon'"),
    "a wrong account": ({"account": "fair", "contrasts": []}, "account: must be one of"),
    "no family": (3, "must be a family or a file of conf/claims, got 3"),
    "two groups": (
        {"contrasts": [{"ours": {"kind": "a"}}]},
        r"one group, {'kind': 'a'} selects \['a_45', 'a_400'\]",
    ),
    "no side": ({"contrasts": [{"theirs": "a_45"}]}, "a test has `ours`"),
    "wrong conditions": ({"contrasts": [{"ours": "a_45", "at": "some"}]}, "must be all, nominal"),
    "a wrong loop": ({"for": {"group": "every"}, "contrasts": [{"ours": "a_45"}]}, "must name a list"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_wrong_family_is_refused_with_the_rule(name):
    said, rule = REFUSED[name]
    with pytest.raises(ConfigError, match=rule):
        families(said)


def test_the_papers_claims_are_about_conditions_of_the_default_study_and_their_baselines(tmp_path):
    config = sweep_config(tmp_path, axes=compose("+exp=robustness")["study"]["axes"])
    plan, nominal = planned(config, "straight"), ("nominal", "poles_eval")
    places = _places(yaml.safe_load((CONF / "claims" / "paper.yaml").read_text()))
    asked = {(axis, value) for at in places for axis, values in at.items() for value in values}
    assert asked <= set(plan.conditions)
    dense, sparse, frame = ("control_hz_dense", 200), ("sparsity", 0.5), ("memory_400hz", "frame")
    baselines = {("control_hz_dense", 25): dense, frame: ("control_hz", 400), ("world", "dynamic"): nominal}
    assert baselines.items() <= plan.baselines.items()
    same = {("world", "poles_dense"): dense, ("sparsity", 0.0): nominal, sparse: sparse}
    assert same.items() <= plan.same_as.items()


def _places(block):
    """Yield the conditions of all tests of a block."""
    for one in block.get("contrasts", ()):
        yield from _places(one)
    if isinstance(block.get("at"), dict):
        yield block["at"]


@pytest.mark.parametrize("name", ["ppo_claims", "camera_rates", "encoder_seeds"])
def test_every_published_group_and_condition_is_still_in_the_file_of_its_study(name):
    facts = json.loads((REPOSITORY / "docs" / "data" / f"{name}_about.json").read_text())
    study = compose(f"+exp={name}")["study"]
    assert list(study["variants"]) == list(facts["groups"])
    assert study["trials"] == facts["trials"]
    assert list(study["axes"]) == [axis for axis in facts["axes"] if axis != "nominal"]
    for axis, settings in study["axes"].items():
        first = next(iter(settings.values()))
        assert [text_of(value) for value in first] == list(facts["axes"][axis])
    assert read_study(name)["seeds"] == facts["seeds"]
