import dataclasses

import numpy as np
import pytest

from jobs.rollout.episodes import EPISODE
from jobs.rollout.store import EpisodeStore, PartResult, SimulationAccuracy
from jobs.rollout.tasks import split
from jobs.run.files import read_json, write_json
from tests.support.configs import sweep_config
from tests.support.runs import planned


@pytest.fixture
def task(tmp_path):
    """Of 24 corridors, in three parts."""
    return dataclasses.replace(planned(sweep_config(tmp_path), "straight").tasks[0], seeds=tuple(range(24)))


@pytest.fixture
def store(tmp_path):
    return EpisodeStore(tmp_path / "sweep")


def result_of(part, **changes):
    episodes = np.zeros(len(part.seeds), EPISODE)
    episodes["seed"] = part.seeds
    return PartResult(**{"episodes": episodes, "drift": {}, **changes})


def test_episodes_survive_their_file_unchanged(task, store):
    task = dataclasses.replace(task, seeds=(3,))
    rows = np.array([(3, True, False, False, 100.0, -4.5, 200.0, 1000, 1 / 3, 2)], EPISODE)
    store.add(task, PartResult(rows, {}), "c0")
    np.testing.assert_array_equal(store.result(task).episodes, rows)
    assert store.missing(task).seeds == ()


def test_accuracy_is_kept_for_all_tasks_of_a_simulation(tmp_path, store):
    usual, sparse, slow = (planned(sweep_config(tmp_path), "straight").tasks[place] for place in (0, 2, 3))
    assert store.accuracy(usual) is None
    store.add(usual, result_of(usual, accuracy=SimulationAccuracy(0.01, 3.0)), "c0")
    assert store.accuracy(sparse) == SimulationAccuracy(0.01, 3.0)
    assert store.accuracy(slow) is None


def test_the_parts_of_a_task_have_each_seed_once_and_none_has_too_many(task):
    for count, sizes in ((10, [10]), (24, [8, 8, 8])):
        task = dataclasses.replace(task, seeds=tuple(range(3, 3 + count)))
        parts = split(task)
        assert [seed for part in parts for seed in part.seeds] == list(task.seeds)
        assert [len(part.seeds) for part in parts] == sizes
        assert {part.key for part in parts} == {task.key}
        assert len({part.part_id for part in parts}) == len(parts)


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_parts_of_several_runs_in_any_order_are_one_task_with_the_drift_of_the_first(task, store, order):
    parts = split(task)
    for place in order:
        with pytest.raises(KeyError):
            store.result(task)
        result = result_of(parts[place], drift={"drift": place})
        store.add(parts[place], result, f"c{place % 2}", restarts=2)
    found = store.result(task)
    assert list(found.episodes["seed"]) == list(range(24))
    assert (found.drift, set(found.commits), found.restarts) == ({"drift": 0}, {"c0", "c1"}, 6)


@pytest.mark.parametrize(
    "damage",
    [
        lambda file: file.write_text(file.read_text()[:40]),
        lambda file: write_json(file, {"episodes": []}),
        lambda file: write_json(file, read_json(file) | {"episodes": [[1, 2]]}),
    ],
    ids=["cut short", "of another version", "of other columns"],
)
def test_a_damaged_file_is_put_aside_and_its_task_evaluated_again(task, store, damage, capsys):
    store.add(task, result_of(task), "c0")
    (file,) = (store.folder / "episodes").iterdir()
    damage(file)
    assert store.missing(task) == task
    assert [left.suffix for left in (store.folder / "episodes").iterdir()] == [".damaged"]
    assert str(file) in capsys.readouterr().out
    store.add(task, result_of(task), "c1")
    assert store.result(task).commits == ("c1",)
