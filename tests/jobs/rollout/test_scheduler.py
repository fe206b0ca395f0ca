import dataclasses
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest

from jobs.evaluation.sweep_plan import plan, read_entry
from jobs.rollout.episodes import EPISODE
from jobs.rollout.scheduler import (
    FlightsError,
    KeepEpisodes,
    flown,
    fly_cells,
    packed,
    unmeasured,
    with_files,
)
from jobs.rollout.tasks import MAX_FLIGHTS, read_episodes, read_kept, split, unflown
from jobs.run.files import write_json
from jobs.run.folder import open_run
from tests.support.configs import AXES, sweep_config
from tests.support.policies import save_training
from tests.support.runs import planned

SEEN = {"speed": {"env.speed_mps": [20, 10]}, "rate": AXES["rate"]}  # changes that bounds notice


def test_a_second_run_flies_nothing_twice(tmp_path, stub):
    config = sweep_config(tmp_path, axes=SEEN)
    place, cells = open_run(config).path / "sweep", planned(config, "straight", "oracle").cells
    first, failed = fly_cells(config, place, cells)
    assert len(stub.flown) == len(set(stub.flown)) == 12
    assert not failed
    again, _ = fly_cells(config, place, cells)
    assert len(stub.flown) == 12
    for key, episodes in first.items():
        np.testing.assert_array_equal(episodes, again[key])


def test_more_trials_fly_only_the_new_corridors(tmp_path, stub):
    few, many = sweep_config(tmp_path, trials=2), sweep_config(tmp_path, trials=5)
    place = open_run(few).path / "sweep"
    fly_cells(few, place, planned(few, "straight").cells)
    stub.flown.clear()
    episodes, _ = fly_cells(many, place, planned(many, "straight").cells)
    assert sorted({seed for _, seed in stub.flown}) == [2, 3, 4]
    assert all(list(rows["seed"]) == [0, 1, 2, 3, 4] for rows in episodes.values())


def test_a_sweep_that_was_stopped_flies_what_is_missing(tmp_path, stub):
    config = sweep_config(tmp_path)
    place, cells = open_run(config).path / "sweep", planned(config, "straight").cells
    fly_cells(config, place, cells)
    kept = place / "episodes"
    (kept / f"{cells[2].key}.json").unlink()
    stub.flown.clear()
    fly_cells(config, place, cells)
    assert stub.flown == [(cells[2].key, 0), (cells[2].key, 1)]


def test_each_simulation_is_measured_once_whoever_flies_it(tmp_path, stub):
    config = sweep_config(tmp_path)
    place, cells = open_run(config).path / "sweep", planned(config, "straight", "oracle").cells
    fly_cells(config, place, cells)
    assert len(stub.measured) == len({cell.simulation for cell in cells}) == 2
    more = planned(sweep_config(tmp_path, trials=3), "straight", "oracle", "random").cells
    assert unmeasured(more, place / "episodes") == set()


def test_what_raises_or_dies_stops_no_other_and_is_flown_by_the_next_run(tmp_path, stub):
    config = sweep_config(tmp_path, axes=SEEN)
    place, cells = open_run(config).path / "sweep", planned(config, "straight").cells
    keys = {cell.label: cell.key for cell in cells}
    raised, died = ("speed", "10"), ("rate", "100")
    stub.broken = {raised: "ValueError: no", died: ""}
    episodes, failed = fly_cells(config, place, cells)
    assert failed == {keys[raised]: "ValueError: no", keys[died]: "its process ended 3 times"}
    assert set(episodes) == {keys["speed", "20"]}
    stub.broken = {}
    stub.flown.clear()
    assert fly_cells(config, place, cells)[1] == {}
    assert {key for key, _ in stub.flown} == {keys[raised], keys[died]}


def test_a_sweep_of_which_nothing_flies_stops_with_the_reason(tmp_path, stub):
    config = sweep_config(tmp_path)
    place, cells = open_run(config).path / "sweep", planned(config, "straight").cells
    stub.broken = {cell.label: "ValueError: no" for cell in cells}
    with pytest.raises(FlightsError, match=r"^nothing could be flown: ValueError: no; the same command"):
        fly_cells(config, place, cells)


def test_episodes_survive_their_file_unchanged(tmp_path):
    cell = dataclasses.replace(planned(sweep_config(tmp_path), "straight").cells[0], seeds=(3,))
    rows = np.array([(3, True, False, False, 100.0, -4.5, 200.0, 1000, 1 / 3, 2)], EPISODE)
    keep = KeepEpisodes(tmp_path / "episodes")
    result = {"key": cell.key, "label": list(cell.label), "episodes": rows.tolist()}
    keep.on_trial_result(1, [], None, result | {"accuracy": None, "simulation": "s", "encoder": {}})
    np.testing.assert_array_equal(read_episodes(cell, tmp_path / "episodes"), rows)
    assert unflown(cell, tmp_path / "episodes").seeds == ()


def test_the_callback_can_be_pickled_with_its_progress_bar(tmp_path):
    keep = pickle.loads(pickle.dumps(KeepEpisodes(tmp_path, lambda count, note: None)))
    assert (keep.folder, keep.advance) == (tmp_path, None)


def test_cells_can_be_sent_to_workers(tmp_path):
    cell = planned(sweep_config(tmp_path), "straight").cells[0]
    assert cell.simulation == pickle.loads(pickle.dumps(cell)).simulation


@pytest.mark.timeout(900)  # where no kernel is compiled yet
def test_a_cell_is_flown_as_its_policy_alone_and_measured_where_asked(tmp_path):
    config = sweep_config(tmp_path)
    path = save_training(tmp_path / "policy", "a", 0, config.env)
    cell = plan(config, [read_entry(path)]).cells[0]
    first, again = flown(cell, True), flown(cell, False)
    assert first["episodes"] == again["episodes"]
    assert [row[0] for row in first["episodes"]] == [0, 1]
    assert 0 <= first["accuracy"]["event_error"] < 0.2
    assert again["accuracy"] is None


def test_the_parts_of_a_cell_fly_each_seed_once_and_none_flies_too_many(tmp_path):
    cell = dataclasses.replace(
        planned(sweep_config(tmp_path), "straight").cells[0], seeds=tuple(range(3, 27))
    )
    parts = split(cell)
    assert [seed for part in parts for seed in part.seeds] == list(cell.seeds)
    assert [len(part.seeds) for part in parts] == [8, 8, 8]
    assert MAX_FLIGHTS == 10
    assert {part.key for part in parts} == {cell.key}
    assert len({part.part for part in parts}) == len(parts)
    assert len(split(dataclasses.replace(cell, seeds=tuple(range(10))))) == 1


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_parts_that_end_in_any_order_are_kept_as_one_cell_with_the_encoder_figures_of_the_first(
    tmp_path, order
):
    cell = dataclasses.replace(planned(sweep_config(tmp_path), "straight").cells[0], seeds=tuple(range(24)))
    parts, keep = split(cell), KeepEpisodes(tmp_path / "episodes")
    for place in order:
        rows = np.zeros(len(parts[place].seeds), EPISODE)
        rows["seed"] = parts[place].seeds
        result = {"key": cell.key, "label": list(cell.label), "simulation": "s", "accuracy": None}
        keep.on_trial_result(1, [], None, result | {"encoder": {"drift": place}, "episodes": rows.tolist()})
    assert list(read_episodes(cell, tmp_path / "episodes")["seed"]) == list(range(24))
    assert read_kept(tmp_path / "episodes", cell.key)["encoder"] == {"drift": 0}


def test_a_cell_of_which_a_part_dies_keeps_the_others_and_flies_that_part_again(tmp_path, stub):
    config = sweep_config(tmp_path, trials=24)
    place, cells = open_run(config).path / "sweep", planned(config, "straight").cells[:1]
    stub.dying = {(cells[0].key, 8)}
    with pytest.raises(FlightsError, match="its process ended 3 times"):
        fly_cells(config, place, cells)
    assert {seed for _, seed in stub.flown} == {*range(8), *range(16, 24)}
    stub.dying = set()
    stub.flown.clear()
    (episodes,) = fly_cells(config, place, cells)[0].values()
    assert sorted(seed for _, seed in stub.flown) == list(range(8, 16))
    assert list(episodes["seed"]) == list(range(24))


def test_a_cell_that_several_runs_fly_remembers_their_commits_and_restarts(tmp_path):
    cell = dataclasses.replace(planned(sweep_config(tmp_path), "straight").cells[0], seeds=tuple(range(24)))
    for run, part in enumerate(split(cell)):
        keep = KeepEpisodes(tmp_path / "episodes")
        keep.commit = f"c{run % 2}"
        keep.restarts[part.part] = 2
        rows = np.zeros(len(part.seeds), EPISODE)
        rows["seed"] = part.seeds
        result = {"key": cell.key, "label": [], "simulation": "s", "accuracy": None, "encoder": {}}
        keep.on_trial_result(1, [], None, result | {"episodes": rows.tolist()})
    kept = read_kept(tmp_path / "episodes", cell.key)
    assert (kept["commits"], kept["restarts"]) == (["c0", "c1"], 6)


def test_what_was_kept_with_one_commit_is_still_read(tmp_path):
    write_json(tmp_path / "k.json", {"label": [], "commit": "c", "encoder": {}, "episodes": []})
    assert read_kept(tmp_path, "k")["commits"] == ["c"]


def test_a_worker_flies_the_policy_that_the_driver_has_though_it_cannot_see_its_folder(tmp_path):
    config = sweep_config(tmp_path)
    path = Path(save_training(tmp_path / "policy", "a", 0, config.env))
    cell = plan(config, [read_entry(str(path))]).cells[0]
    here = flown(cell, False)
    files = packed([cell])
    shutil.rmtree(path)
    there = with_files(cell, files)
    assert there.entry.agent != cell.entry.agent
    assert there.key == cell.key
    assert flown(there, False)["episodes"] == here["episodes"]
    assert with_files(cell, files).entry.agent == there.entry.agent  # written once
    bound = planned(config, "straight").cells[0]
    assert with_files(bound, packed([bound])) == bound
