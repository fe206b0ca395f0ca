import csv
import dataclasses
import gzip
import json
import os
import re

import numpy as np
import pytest
from PIL import Image

from jobs.config.config import ConfigError
from jobs.evaluation.group_stats import LABELS
from jobs.reporting import report as results
from jobs.reporting.breaks import changes_of, compared_pairs, replicated
from jobs.reporting.figures import group_results
from jobs.reporting.headline import BEGIN, END
from jobs.reporting.in_short import in_short
from jobs.reporting.report import (
    breaks_table,
    estimates_table,
    find_study,
    results_pages,
    several_at_once,
    write_results,
    write_trade,
)
from jobs.reporting.sweep_data import (
    read_data,
    read_sweep,
    read_sweep_episodes,
    write_changes,
    write_data,
    write_estimates,
)
from jobs.run.files import read_json, write_json
from jobs.run.provenance import REPOSITORY
from tests.support.configs import small_config
from tests.support.episodes import flights
from tests.support.sweep_folders import ABOUT, write_shipped, write_sweep


@pytest.fixture
def sweep(tmp_path, monkeypatch):
    """The folder that a sweep leaves, made of constructed episodes; coverage is simulated elsewhere."""
    monkeypatch.setattr(results, "coverage_text", lambda trainings, corridors: "95 % at 0")
    return write_sweep(tmp_path / "runs" / "robustness-short-s0-1" / "sweep")


def shipped(tmp_path):
    """A folder with learning curves, of policies that are there."""
    return write_shipped(tmp_path / "shipped")


def test_the_page_tells_what_made_it_and_what_it_says_of_the_paper(sweep, tmp_path):
    page = write_results(sweep, tmp_path / "docs", shipped(tmp_path))
    text, tables = page.read_text(), (tmp_path / "docs" / "results_tables.md").read_text()
    for fact in ("2026-01-02", "`python -m platform.launch +exp=robustness`", "commit c0ffee", "sweep `abc`"):
        assert fact in text
    assert "\n\n\n" not in text + tables
    assert "bytestream (3), event_image (1), oracle (1)" in text
    assert "| sparsity | 0.5 | 5 | 1.6 | 5.0 |" in tables
    assert tables.index("(images/results_axes.png)") < tables.index("## Success [%]")
    assert re.search(
        r"\| `bytestream`: tolerates dead pixels \| D.3 \| `event_image` \| undecided \| \S+ m", text
    )
    assert re.search(r"adapts to other control rates \| abstract, D.3 \| `event_image` \| not tested", text)
    assert "| `bytestream`: learns faster | abstract | `event_image` | holds | +20 [" in text
    assert "| `bytestream_xy`: learns faster | abstract | `event_image` | not tested |" in text
    assert "| nominal | poles_eval | 80 [" in tables
    assert tables.count("(images/results_") == 2
    assert {path.name for path in (tmp_path / "docs" / "images").iterdir()} == {
        f"results_{name}.png" for name in ("axes", "contacts", "survival", "map", "claims")
    }
    assert str(tmp_path) not in text + tables


def test_every_episode_and_training_is_there_to_be_analysed_again(sweep, tmp_path):
    write_results(sweep, tmp_path / "docs", shipped(tmp_path))
    data = tmp_path / "docs" / "data"
    with gzip.open(data / "robustness_episodes.csv.gz", "rt") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 3 * 5 * 20
    with (data / "robustness_trainings.csv").open() as file:
        trainings = list(csv.DictReader(file))
    for one in trainings:
        own = [row for row in rows if all(row[name] == one[name] for name in LABELS)]
        assert float(one["success_rate"]) == np.mean([row["success"] == "True" for row in own])
        assert float(one["distance_m"]) == pytest.approx(np.mean([float(row["distance_m"]) for row in own]))
        assert int(one["episodes"]) == len(own) == 20
    assert len(trainings) == 3 * 5
    before = (data / "robustness_episodes.csv.gz").read_bytes()
    write_data(data, "robustness", sweep, read_sweep(sweep)[1])
    assert before == (data / "robustness_episodes.csv.gz").read_bytes()


def test_a_sweep_of_an_earlier_version_is_refused_with_the_remedy(sweep, tmp_path):
    write_json(sweep / "about.json", {name: value for name, value in ABOUT.items() if name != "met"})
    with pytest.raises(ConfigError, match="earlier version; give its command again"):
        write_results(sweep, tmp_path / "docs")


def test_flights_survive_their_file(sweep):
    found = read_sweep_episodes(sweep / "episodes.csv")
    assert set(found[("sparsity", "0.2"), "bytestream"]) == {0, 1, 2}
    np.testing.assert_array_equal(found[("nominal", "poles_eval"), "bytestream"][2], flights(16))


def test_the_newest_study_is_found_unless_one_is_named(sweep, tmp_path):
    older = tmp_path / "runs" / "older"
    (older / "sweep").mkdir(parents=True)
    (older / "sweep" / "about.json").write_text("{}")
    os.utime(older / "sweep" / "about.json", (1, 1))
    config = small_config(tmp_path, job="report")
    assert find_study(config, "sweep") == sweep
    assert find_study(dataclasses.replace(config, resume=str(older)), "sweep") == older / "sweep"
    assert find_study(config, "trade") is None


def test_a_sweep_in_validation_corridors_is_no_result(sweep, tmp_path):
    later = tmp_path / "runs" / "later" / "sweep"
    later.mkdir(parents=True)
    config = small_config(tmp_path, job="report")
    for split, found in (("eval", later), ("validation", sweep)):
        write_json(later / "about.json", ABOUT | {"split": split})
        os.utime(later / "about.json", (2**32, 2**32))
        assert find_study(config, "sweep") == found
    study = tmp_path / "runs" / "study" / "ablation"
    study.mkdir(parents=True)
    for split, found in (("validation", None), ("eval", study)):
        write_json(study / "about.json", {"exp": "taught_claims", "split": split})
        assert find_study(config, "taught_claims") == found


@pytest.fixture
def trade(tmp_path):
    """The folder that a trade leaves."""
    folder = tmp_path / "runs" / "trade-short-s0-1" / "trade"
    (folder / "images").mkdir(parents=True)
    (folder / "trade.md").write_text("# A page\n![](images/trade.png)\n")
    picture = np.zeros((40, 50, 3), np.uint8)
    picture[10:20], picture[:, 30] = (37, 99, 235), 255
    Image.fromarray(picture).save(folder / "images" / "trade.png")
    (folder / "about.json").write_text("{}")
    return folder


def test_the_page_of_a_trade_is_copied_with_its_picture(trade, tmp_path):
    text = write_trade(trade, tmp_path / "docs").read_text()
    assert text == (trade / "trade.md").read_text()
    copy, whole = (folder / "images" / "trade.png" for folder in (tmp_path / "docs", trade))
    one, other = (np.asarray(Image.open(path).convert("RGB"), int) for path in (copy, whole))
    np.testing.assert_array_equal(one, other)


def test_what_there_is_is_written_and_nothing_else(trade, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    results.run(small_config(tmp_path, job="report"))
    assert [path.name for path in (tmp_path / "docs").glob("*.md")] == ["trade.md"]


def test_nothing_finished_is_refused_with_the_remedy(tmp_path):
    config = small_config(tmp_path, job="report")
    rule = r"^resume: no finished sweep or trade in .*: run python -m platform\.launch \+exp=robustness or "
    with pytest.raises(ConfigError, match=rule):
        results.run(config)


def test_a_condition_breaks_a_policy_where_its_own_loss_is_certain(sweep, tmp_path):
    swept = read_sweep_episodes(sweep / "episodes.csv")
    for seed in (0, 1, 2):
        swept[("sparsity", "0.5"), "bytestream"][seed]["success"] = False
        swept[("sparsity", "0.2"), "bytestream"][seed]["success"][:1] = False
    swept[("sparsity", "0.5"), "event_image"][0]["success"] = True
    changes = changes_of(ABOUT, swept)
    assert {(change.condition[1], change.group, change.certain) for change in changes} == {
        ("0.2", "bytestream", False), ("0.5", "bytestream", True),
        ("0.2", "event_image", False), ("0.5", "event_image", False),
    }  # fmt: skip
    text = breaks_table(ABOUT, changes)
    assert re.search(
        r"\| `bytestream` \| 80 \| 50 % dead pixels: 80 to 0 % "
        r"\| \*\*50 % dead pixels: -80 \[-\d+, -\d+\], 3 of 3\*\* \|",
        text,
    )
    assert "| `event_image` (1 training) | 20 | - | none is certain |" in text
    assert "oracle" not in text


def test_one_training_that_breaks_is_told_and_says_nothing_of_others(sweep):
    swept = read_sweep_episodes(sweep / "episodes.csv")
    swept[("sparsity", "0.5"), "bytestream"][1]["success"] = False
    swept[("sparsity", "0.2"), "bytestream"][2]["success"] = True  # a certain gain is no loss
    found = {
        change.condition[1]: change for change in changes_of(ABOUT, swept) if change.group == "bytestream"
    }
    assert found["0.5"].broken.tolist() == [False, True, False]
    assert not found["0.5"].certain
    assert not found["0.2"].broken.any()
    assert ", 1 of 3" in breaks_table(ABOUT, list(found.values()))


def test_changes_are_those_of_the_same_trainings_whatever_their_order(sweep):
    swept = read_sweep_episodes(sweep / "episodes.csv")
    before = {one.condition: one.difference for one in changes_of(ABOUT, swept) if one.group == "bytestream"}
    nominal = ("nominal", "poles_eval"), "bytestream"
    swept[nominal] = {seed: swept[nominal][seed] for seed in (2, 0, 1)}
    swept[nominal][2]["success"] = False
    turned = {one.condition: one for one in changes_of(ABOUT, swept) if one.group == "bytestream"}
    assert turned.keys() == before.keys()
    assert all(one.before.tolist()[2] == 0.0 < min(one.before.tolist()[:2]) for one in turned.values())


def test_a_simulation_that_two_axes_have_is_tested_once_and_a_baseline_never(sweep):
    swept = read_sweep_episodes(sweep / "episodes.csv")
    same = [*ABOUT["compared"][:2], {**ABOUT["compared"][2], "same_as": ["sparsity", "0.2"]}]
    found = changes_of({**ABOUT, "compared": same}, swept)
    assert {change.condition for change in found} == {("sparsity", "0.2")}
    own = [*ABOUT["compared"][:2], {**ABOUT["compared"][2], "baseline": ["sparsity", "0.5"]}]
    assert {change.condition for change in changes_of({**ABOUT, "compared": own}, swept)} == {
        ("sparsity", "0.2")
    }


def test_a_group_of_another_rate_is_compared_with_its_own_baseline_and_the_others_with_theirs(sweep):
    swept = read_sweep_episodes(sweep / "episodes.csv")
    nominal, sparse, dead = (one["condition"] for one in ABOUT["compared"])
    own = {"own_baseline": {"bytestream": dead}}
    told = [
        {"condition": nominal, "baseline": nominal, "same_as": nominal},
        {"condition": sparse, "baseline": nominal, "same_as": sparse, **own},
        {"condition": dead, "baseline": nominal, "same_as": dead, **own},
    ]
    found = changes_of({**ABOUT, "compared": told}, swept, every=True)
    pairs = {(one.group, one.condition, one.baseline) for one in found}
    assert {pair[1:] for pair in pairs if pair[0] == "bytestream"} == {(tuple(sparse), tuple(dead))}
    others = {(tuple(at), tuple(nominal)) for at in (sparse, dead)}
    assert {pair[1:] for pair in pairs if pair[0] == "event_image"} == others
    assert compared_pairs({**ABOUT, "compared": told}) == sorted(others)


def test_a_scene_that_is_the_baseline_of_an_axis_is_itself_compared_once():
    """`world/dense` is the simulation of `rate_dense/200`, which is its own baseline."""
    usual, dense = ["nominal", "poles_eval"], ["rate_dense", "200"]
    compared = [
        {"condition": usual, "baseline": usual, "same_as": usual},
        {"condition": dense, "baseline": dense, "same_as": dense},
        {"condition": ["rate_dense", "25"], "baseline": dense, "same_as": ["rate_dense", "25"]},
        {"condition": ["world", "same"], "baseline": usual, "same_as": usual},
        {"condition": ["world", "dense"], "baseline": usual, "same_as": dense},
        {"condition": ["scene", "dense"], "baseline": ["world", "same"], "same_as": dense},
        {"condition": ["slow", "25"], "baseline": ["world", "dense"], "same_as": ["rate_dense", "25"]},
    ]
    assert compared_pairs({**ABOUT, "compared": compared}) == [
        (("rate_dense", "25"), ("rate_dense", "200")),
        (("world", "dense"), ("nominal", "poles_eval")),
    ]


def test_conditions_that_change_several_settings_are_told_with_them():
    about, _ = read_data(REPOSITORY / "docs" / "data", "robustness")
    (name, settings) = next(iter(several_at_once(about).items()))
    assert name == "several at once, 45 Hz"
    changed = about["axes"]["worst"]["45"]
    assert settings == ", ".join(f"`{key}={value}`" for key, value in changed.items())


def test_the_published_sweep_tells_what_the_dense_scene_changes():
    about, swept = read_data(REPOSITORY / "docs" / "data", "robustness")
    pairs = compared_pairs(about)
    assert (("world", "poles_dense"), ("nominal", "poles_eval")) in pairs
    groups = {one.group for one in changes_of(about, swept) if one.condition == ("world", "poles_dense")}
    assert groups == set(about["groups"]) - {"straight", "oracle"}


def test_what_is_the_baseline_for_one_group_alone_is_no_change_of_it(sweep):
    """By whole episodes: equal successes of other episodes are a finding."""
    swept = read_sweep_episodes(sweep / "episodes.csv")
    nominal = ("nominal", "poles_eval")
    assert len(changes_of(ABOUT, swept)) == 4  # all successes agree, and yet the episodes differ
    swept[("sparsity", "0.2"), "bytestream"] = swept[nominal, "bytestream"]
    swept[("sparsity", "0.5"), "event_image"] = swept[("sparsity", "0.2"), "event_image"]
    found = changes_of(ABOUT, swept)
    assert [(one.condition[1], one.group) for one in found] == [("0.2", "event_image"), ("0.5", "bytestream")]
    assert len(changes_of(ABOUT, swept, every=True)) == 4
    swept[("sparsity", "0.2"), "bytestream"] = {
        seed: rows.copy() for seed, rows in swept[nominal, "bytestream"].items()
    }
    swept[("sparsity", "0.2"), "bytestream"][2]["steps"][0] += 1  # one step of one training
    assert len(changes_of(ABOUT, swept)) == 3


def test_a_group_of_one_training_is_in_no_test_of_groups(sweep):
    swept = read_sweep_episodes(sweep / "episodes.csv")
    for own in swept[("sparsity", "0.5"), "bytestream"].values():
        own["success"] = False
    swept[("nominal", "poles_eval"), "event_image"][0]["success"] = True
    swept[("sparsity", "0.5"), "event_image"][0]["success"] = False
    changes = changes_of(ABOUT, swept)
    found = {(one.condition[1], one.group): one for one in changes}
    assert found["0.5", "bytestream"].certain
    alone = found["0.5", "event_image"]
    assert alone.broken.tolist() == [True]
    assert not alone.certain
    assert [one.group for one in replicated(changes)] == ["bytestream", "bytestream"]
    only = changes_of({**ABOUT, "groups": {"event_image": [0]}}, swept)
    assert [one.certain for one in only] == [False, False]
    sentence = in_short(ABOUT, swept, changes, {}, {})[2]
    assert "for certain, 1 of 2 changes of groups with several" in sentence


@pytest.mark.parametrize("part", ["results_figures", "page_values", "with_headline"])
def test_what_cannot_be_drawn_or_written_replaces_nothing(sweep, tmp_path, monkeypatch, part):
    docs = tmp_path / "docs"
    docs.mkdir()
    (docs / "robustness.md").write_text(f"{BEGIN}{END}")

    def fail(*args):
        raise KeyError(part)

    if part != "results_figures":
        monkeypatch.setattr(results, "results_figures", lambda *args: {})
    monkeypatch.setattr(results, part, fail)
    with pytest.raises(KeyError, match=part):
        write_results(sweep, docs, shipped(tmp_path))
    assert [path.name for path in docs.rglob("*")] == ["robustness.md"]
    assert (docs / "robustness.md").read_text() == f"{BEGIN}{END}"


def test_the_page_of_a_trade_is_linked_where_there_is_one(sweep, trade, tmp_path):
    docs, (about, episodes) = tmp_path / "docs", read_sweep(sweep)
    assert "(trade.md)" not in results_pages(about, episodes, (), (), docs, tmp_path)["results.md"]
    write_trade(trade, docs)
    assert "(trade.md)" in results_pages(about, episodes, (), (), docs, tmp_path)["results.md"]


@pytest.mark.parametrize("name", ["robustness_estimates.csv", "robustness_changes.csv"])
def test_published_estimates_and_changes_are_those_of_the_published_episodes(name, tmp_path):
    data = REPOSITORY / "docs" / "data"
    about, swept = read_data(data, "robustness")
    if name == "robustness_changes.csv":
        write_changes(tmp_path, "robustness", changes_of(about, swept))
    else:
        write_estimates(tmp_path, "robustness", group_results(about, swept))
    assert (tmp_path / name).read_text() == (data / name).read_text()


def test_no_simulation_stands_twice_in_the_table_of_success():
    about = read_json(REPOSITORY / "docs" / "data" / "robustness_about.json")
    page = (REPOSITORY / "docs" / "results_tables.md").read_text()
    lines = page.split("## Success [%]")[1].split("| ---", 1)[1].split("\n\n")[0].splitlines()[1:]
    assert len(lines) == len({json.dumps(one["same_as"]) for one in about["compared"]}) == 36
    assert len({line.split("|", 3)[3] for line in lines}) == len(lines)


def test_the_table_of_success_leaves_out_what_is_the_same_simulation_as_another(sweep):
    swept = read_sweep_episodes(sweep / "episodes.csv")
    assert len(estimates_table(ABOUT, swept).splitlines()) == 2 + 3
    same = [*ABOUT["compared"][:2], {**ABOUT["compared"][2], "same_as": ["sparsity", "0.2"]}]
    assert len(estimates_table({**ABOUT, "compared": same}, swept).splitlines()) == 2 + 2
