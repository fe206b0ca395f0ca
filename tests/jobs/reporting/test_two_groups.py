import numpy as np
import pytest

from jobs.analysis.statistics import Difference, crossed_difference
from jobs.analysis.tables import estimate_text
from jobs.config.config import as_dict, parse
from jobs.evaluation.group_stats import episode_values
from jobs.reporting.paper_recipe import PAPER, RECIPES
from jobs.reporting.sweep_data import read_data, read_sweep, read_sweep_episodes
from jobs.reporting.training_studies import SETS, SETS_GROUPS
from jobs.reporting.two_groups import overall, pairs_of, results_text, verdict_text
from jobs.run.provenance import REPOSITORY
from jobs.studies.ablation.ablation import variant_config
from tests.support.configs import compose
from tests.support.sweep_folders import write_ablation


def study(folder, failed):
    return read_sweep(write_ablation(folder, "ppo_event_set", failed))


def more_among_textures(group, axis, value, seed):
    """Sets lose 6 of 14 episodes more under one condition of sixteen; trainings of one seed lose alike."""
    return seed % 3 + 6 * ((group, value) == ("event_set", "texture_change"))


def test_a_condition_has_ten_trainings_of_each_group_in_the_same_corridors(tmp_path):
    pairs = pairs_of(SETS_GROUPS, *study(tmp_path, lambda *_: 1))
    assert ("nominal", "poles_eval") in pairs
    assert len(pairs) == 16
    assert {side.shape for pair in pairs.values() for side in pair} == {(10, 14)}


def test_a_loss_under_one_condition_is_its_own_and_a_share_of_the_mean(tmp_path):
    pairs = pairs_of(SETS_GROUPS, *study(tmp_path, more_among_textures))
    differences = {at: pair.difference().value for at, pair in pairs.items()}
    lost = differences.pop(("world", "texture_change"))
    assert lost == pytest.approx(-6 / 14)
    assert set(differences.values()) == {0.0}
    assert overall(pairs).difference().value == pytest.approx(-6 / 14 / 16)


def test_trainings_of_one_seed_are_compared(tmp_path):
    """Seeds differ much and pairs not at all: unpaired, no such difference would be certain."""
    found = overall(
        pairs_of(SETS_GROUPS, *study(tmp_path, lambda group, *at: at[-1] + (group == "event_set")))
    )
    assert found.difference().value == pytest.approx(-1 / 14)
    assert found.difference().p < 0.05 < crossed_difference(found.tried, found.usual).p


def test_rows_are_paired_by_seed_in_whatever_order_they_come(tmp_path):
    about, episodes = study(tmp_path, lambda group, *at: at[-1])
    for key, own in episodes.items():
        if key[1] == "bytestream":
            episodes[key] = dict(reversed(own.items()))
    assert all(
        np.array_equal(pair.tried, pair.usual) for pair in pairs_of(SETS_GROUPS, about, episodes).values()
    )


def test_a_group_that_lacks_a_training_is_refused(tmp_path):
    about, episodes = study(tmp_path, lambda *_: 0)
    for groups in ({"event_set": [0, 1]}, {"bytestream": [0]}, {"bytestream": [0, 1], "event_set": [0]}):
        with pytest.raises(ValueError, match="trainings of the same seeds"):
            pairs_of(SETS_GROUPS, {**about, "groups": groups}, episodes)
    del episodes[("sparsity", "0.5"), "event_set"][3]
    with pytest.raises(ValueError, match=r"every training must be evaluated under .*'event_set', 3"):
        pairs_of(SETS_GROUPS, about, episodes)


def test_other_corridors_for_one_group_are_refused(tmp_path):
    about, episodes = study(tmp_path, lambda *_: 0)
    for own in episodes[("sparsity", "0.5"), "event_set"].values():
        own["seed"] += 1
    with pytest.raises(ValueError, match="same corridors"):
        pairs_of(SETS_GROUPS, about, episodes)


@pytest.mark.parametrize(
    ("interval", "p", "told"),
    [
        ((0.02, 0.2), 0.01, "`event_set` succeeds more often"),
        ((-0.2, -0.02), 0.01, "`bytestream` succeeds more often"),
        ((-0.03, 0.09), 0.3, "is ruled out"),
        ((-0.03, 0.11), 0.3, "cannot be ruled out"),
        (None, None, "cannot be ruled out"),
    ],
)
def test_the_verdict_follows_the_test_and_the_smallest_difference_that_matters(interval, p, told):
    value = 0.0 if interval is None else sum(interval) / 2
    assert told in verdict_text(SETS_GROUPS, Difference(value, interval, p))


def test_it_has_the_bytestream_and_the_conditions_of_the_study_of_the_papers_claims():
    sets, claims = (parse(compose(f"+exp={name}")) for name in ("ppo_event_set", "ppo_claims"))
    assert sets.sweep == claims.sweep
    assert sets.ablation.seeds == claims.ablation.seeds
    ours, theirs = (as_dict(variant_config(config, "bytestream", 7)) for config in (sets, claims))
    assert {key for key in ours if ours[key] != theirs[key]} <= {"exp", "ablation"}
    learnt = as_dict(variant_config(sets, "event_set", 7))
    assert {key for key in ours if ours[key] != learnt[key]} <= {"exp", "model", "env"}


def test_the_page_has_a_row_for_each_condition_and_one_for_their_mean(tmp_path):
    text = results_text(SETS_GROUPS, *study(tmp_path, lambda *_: 1))
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    assert len(rows) == 2 + 1 + 16
    assert "in 93 % of its episodes" in text


@pytest.mark.parametrize(
    ("name", "groups", "says"),
    [(SETS, SETS_GROUPS, "cannot be ruled out"), (PAPER, RECIPES, "It is certain")],
)
def test_what_the_front_page_says_is_what_the_data_say(name, groups, says):
    about, episodes = read_data(REPOSITORY / "docs" / "data", name)
    pairs = pairs_of(groups, about, episodes)
    mean = overall(pairs)
    found = mean.difference()
    text = " ".join((REPOSITORY / "docs" / "index.md").read_text().split())
    shares = f"{100 * mean.tried.mean():.0f} and {100 * mean.usual.mean():.0f} % over {len(pairs)} conditions"
    assert (
        f"{shares}, a difference of {estimate_text(found, 100, '+.0f').replace(' ', ' points ', 1)}" in text
    )
    assert says in verdict_text(groups, found)


def test_both_learn_at_the_best_of_the_rates_that_were_searched():
    searched = parse(compose("+exp=learning_rates")).ablation.variants
    for name in ("bytestream", "event_set"):
        file = REPOSITORY / "docs" / "data" / f"learning_rates_{name}_episodes.csv.gz"
        won = {
            searched[group]["algo.lr"]: episode_values(own, "success").mean()
            for (_, group), own in read_sweep_episodes(file).items()
        }
        best = max(won, key=lambda lr: (won[lr], -lr))
        assert variant_config(parse(compose("+exp=ppo_event_set")), name, 0).algo.lr == best
    assert parse(compose("+exp=event_set")).algo.lr == best
