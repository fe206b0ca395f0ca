"""The one table of episodes: what is read back is what was written, whatever version wrote it."""

import gzip
import json

import numpy as np
import pytest

from jobs.config.config import parse
from jobs.config.errors import ConfigError
from jobs.rollout import episodes, table, tasks
from jobs.rollout.episodes import EPISODE
from jobs.rollout.store import EpisodeStore
from jobs.rollout.table import read_table
from jobs.run.files import RunError, write_json
from jobs.run.folder import run_name
from jobs.run.provenance import REPOSITORY
from jobs.study.results import (
    Results,
    check_whole,
    joined,
    read_cells,
    read_published,
    read_results,
    texts_of,
    value_of,
    write_cells,
)
from tests.support.configs import compose, sweep_config
from tests.support.episodes import flights
from tests.support.runs import planned
from tests.support.sweep_folders import ABOUT, write_sweep

DATA = REPOSITORY / "docs" / "data"


@pytest.fixture
def study(tmp_path):
    return write_sweep(tmp_path / "runs" / "robustness-short-s0-1" / "study")


def test_a_published_table_is_written_again_byte_for_byte(tmp_path):
    file = DATA / "encoder_seeds_episodes.csv.gz"
    write_cells(tmp_path / "again.csv", read_cells(file))
    again, before = (tmp_path / "again.csv").read_bytes(), gzip.decompress(file.read_bytes())
    assert sorted(again.splitlines()) == sorted(before.splitlines())


def test_flights_survive_their_file_and_values_are_numbers(study):
    results = read_results(study)
    assert set(results.trainings(("sparsity", 0.2), "bytestream")) == {0, 1, 2}
    np.testing.assert_array_equal(results.cells[results.nominal, "bytestream"][2], flights(16))
    assert results.trainings(results.nominal, "oracle").keys() == {None}
    assert results.trained == ["bytestream", "event_image"]
    check_whole(results)


def test_a_value_is_a_number_where_its_text_is_one():
    numbers = {"45": 45.0, "0.05": 0.05, "0.12345678": 0.12345678}
    values = {**numbers, "texture_change": "texture_change", "nan": "nan"}
    assert {text: value_of(text) for text in values} == values
    assert [tasks.text_of(value) for value in values.values()] == list(values)
    assert tasks.text_of(None) == "null"


def test_a_column_that_an_older_file_lacks_has_its_default_and_a_first_column_is_missed(study, monkeypatch):
    later = np.dtype([*EPISODE.descr, ("near_misses", "i8")])
    monkeypatch.setattr(table, "COLUMNS", later.names)
    monkeypatch.setattr(table, "ADDED", {"near_misses": 7})
    assert set(read_table(study / "episodes.csv")["near_misses"]) == {7}
    monkeypatch.setattr(table, "EPISODE", later)
    assert table.episodes_of([(3, *[0] * 9)], EPISODE.names)["near_misses"].tolist() == [7]
    lines = (study / "episodes.csv").read_text().splitlines()
    lines[0] = lines[0].replace("success", "won")
    (study / "episodes.csv").write_text("\n".join(lines))
    with pytest.raises(RunError, match=r"must have the columns \['success'\]; evaluate again"):
        read_table(study / "episodes.csv")


def test_a_new_column_renames_no_task_and_older_stores_are_read(tmp_path, monkeypatch):
    """The key of this task has been the same since the first sweeps; `KEYED_COLUMNS` is never extended."""
    assert EPISODE.names[: len(tasks.KEYED_COLUMNS)] == tasks.KEYED_COLUMNS
    assert set(EPISODE.names[len(tasks.KEYED_COLUMNS) :]) == set(episodes.ADDED)
    plan = planned(sweep_config(tmp_path), "straight")
    before = plan.tasks[0].key
    monkeypatch.setattr(episodes, "EPISODE", np.dtype([*EPISODE.descr, ("near_misses", "i8")]))
    assert planned(sweep_config(tmp_path), "straight").tasks[0].key == before
    store, rows = EpisodeStore(tmp_path / "store"), flights(1, trials=2)
    old = {"label": ["nominal", "poles_eval", "straight"], "commits": ["c0ffee"], "encoder": {}}
    old |= {"restarts": 0, "episodes": rows.tolist()}
    write_json(tmp_path / "store" / "episodes" / f"{before}.json", old)
    np.testing.assert_array_equal(store.result(plan.tasks[0]).episodes, rows)
    assert store.missing(plan.tasks[0]).seeds == ()


@pytest.mark.parametrize("name", ["ppo_claims", "camera_rates"])
def test_a_run_of_an_earlier_version_is_found_in_its_folder(name):
    told = json.loads((DATA / f"{name}_about.json").read_text())["run"]
    assert run_name(parse(compose(f"+exp={name}"))) == told


def test_a_study_that_lacks_episodes_or_is_of_the_first_versions_is_refused(study):
    lines = (study / "episodes.csv").read_text().splitlines(keepends=True)
    own = [line for line in lines if line.startswith("sparsity,0.5,bytestream,1,")]
    (study / "episodes.csv").write_text("".join(line for line in lines if line not in own[9:]))
    said = r"sparsity 0\.5 of bytestream s1 must have 20 episodes, got 9; run the command of the study again"
    with pytest.raises(ConfigError, match=said):
        check_whole(read_results(study))
    without = {name: value for name, value in ABOUT.items() if name != "met"}
    for about, reason in (({**ABOUT, "episodes_sha256": "0" * 64}, "damaged"), (without, "earlier version")):
        write_json(study / "about.json", about)
        with pytest.raises((ConfigError, RunError), match=reason):
            read_results(study)


def only(results, seeds):
    """The trainings of these seeds, as if no others had been evaluated."""
    groups = {name: [seed for seed in own if seed in seeds] for name, own in results.groups.items()}
    cells = {at: {seed: one for seed, one in own.items() if seed in seeds}
             for at, own in results.cells.items()}  # fmt: skip
    return Results({**results.facts, "groups": groups, "seeds": sorted(seeds)}, cells)


def test_a_study_that_was_trained_in_two_runs_is_the_study_trained_in_one():
    whole = read_published(DATA, "encoder_targets")
    earlier, more = only(whole, {0, 1, 2}), only(whole, {3, 4})
    both = joined(earlier, more)
    assert list(both.cells) == list(whole.cells)
    for at, trainings in whole.cells.items():
        assert list(both.cells[at]) == list(trainings)
        assert all(np.array_equal(both.cells[at][seed], own) for seed, own in trainings.items())
    assert {**both.facts, "earlier": ()} == {**whole.facts, "earlier": ()}
    assert [one["run"] for one in both.facts["earlier"]] == [whole.facts["run"]]


def test_a_study_from_before_a_fact_was_recorded_is_joined_unless_the_fact_differs():
    whole = read_published(DATA, "encoder_targets")
    older = {name: fact for name, fact in whole.facts.items() if name not in ("split", "env_steps")}
    earlier, more = only(Results(older, whole.cells), {0, 1, 2}), only(whole, {3, 4})
    assert joined(earlier, more).groups == whole.groups
    with pytest.raises(ConfigError, match="other split"):
        joined(earlier, Results({**more.facts, "split": "validation"}, more.cells))


@pytest.mark.parametrize(
    ("seeds", "changed", "named"),
    [
        ({3, 4}, {"trials": 7}, "trials"),
        ({3, 4}, {"axes": {}}, "axes"),
        ({3, 4}, {"variants": {"occupancy": {"algo.lr": 1.0}}}, "other occupancy"),
        ({2, 3}, {}, "s2"),
    ],
)
def test_runs_that_differ_or_share_a_training_are_not_joined(seeds, changed, named):
    whole = read_published(DATA, "encoder_targets")
    facts = {**whole.facts, "variants": {"occupancy": {}}}
    earlier, more = only(Results(facts, whole.cells), {0, 1, 2}), only(whole, seeds)
    with pytest.raises(ConfigError, match=rf"report\.keep: .*{named}"):
        joined(earlier, Results({**more.facts, **changed}, more.cells))


def test_each_group_of_a_joined_study_keeps_what_it_is_compared_with():
    whole, dense = read_published(DATA, "body_conditions"), ("control_hz_dense", 200.0)
    at, nominal = ("control_hz_dense", 25.0), whole.nominal
    parts = [only_groups(whole, {"body_hold"}, dense), only_groups(whole, {"oracle"}, nominal)]
    for both in (joined(*parts), joined(*reversed(parts))):
        assert both.baselines("body_hold")[at] == dense
        assert both.baselines("oracle")[at] == nominal
        assert both.baselines("oracle").keys() == set(whole.conditions)


def only_groups(results, names, baseline):
    """The episodes of these groups, of which the denser conditions are compared with `baseline`."""
    ends = {one: baseline if one[0] == "control_hz_dense" else results.nominal for one in results.conditions}
    keys = ("condition", "baseline", "same_as")
    compared = [dict(zip(keys, map(texts_of, (one, end, one)), strict=True)) for one, end in ends.items()]
    groups = {name: own for name, own in results.groups.items() if name in names}
    cells = {at: own for at, own in results.cells.items() if at[1] in names}
    return Results({**results.facts, "groups": groups, "compared": compared}, cells)
