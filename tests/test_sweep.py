import dataclasses
import json
import pickle

import numpy as np
import pytest

from jobs import sweep as sweeping
from jobs.conditions import plan, swept_policy
from jobs.config import ConfigError
from jobs.flights import EPISODE
from jobs.runs import open_run
from jobs.sweep import KeepEpisodes, fly_cells, read_episodes, unflown
from jobs.tracking import open_store
from tests.test_evaluate import save_untrained
from tests.test_runs import small_config

AXES = {"faults.sparsity": [0.5, 0.0], "env.control_hz": [200.0, 100.0]}


def sweep_config(tmp_path, trials=2, **changes):
    config = small_config(tmp_path, job="sweep", exp="robustness")
    settings = dataclasses.replace(config.sweep, axes=AXES, trials=trials, policy="straight", **changes)
    return dataclasses.replace(config, sweep=settings, env={**config.env, "time_limit_s": 0.2})


class StubTuner:
    """Flies in this process what Tune would fly in workers, and counts it."""

    flown: list[tuple[str, int]] = []  # noqa: RUF012

    def __init__(self, folder, missing, keep):
        self.missing, self.keep = missing, keep

    def fit(self):
        for cell in self.missing:
            rows = np.zeros(len(cell.seeds), EPISODE)
            rows["seed"], rows["distance_m"] = cell.seeds, 50.0
            self.flown += [(cell.key, seed) for seed in cell.seeds]
            result = {"key": cell.key, "label": list(cell.label), "episodes": rows.tolist()}
            self.keep.on_trial_result(1, [], None, result)
        return type("Results", (), {"errors": []})()


@pytest.fixture
def stub(monkeypatch):
    StubTuner.flown = []
    monkeypatch.setattr(sweeping, "_tuner", StubTuner)
    monkeypatch.setattr(sweeping, "start_ray", lambda *given: None)
    return StubTuner


def test_axes_are_changed_one_at_a_time_and_share_the_unchanged_cell(tmp_path):
    sweep = plan(sweep_config(tmp_path), "straight")
    assert [value for value, _ in sweep.axes["faults.sparsity"]] == [0.0, 0.5]
    unchanged, sparse = (cell for _, cell in sweep.axes["faults.sparsity"])
    slow, paper = (cell for _, cell in sweep.axes["env.control_hz"])
    assert unchanged.key == paper.key == sweep.bounds["straight"].key
    assert sparse.env == dataclasses.replace(
        unchanged.env, faults=dataclasses.replace(unchanged.env.faults, sparsity=0.5)
    )
    assert slow.env == dataclasses.replace(unchanged.env, control_hz=100.0)
    assert len({cell.key for cell in sweep.cells()}) == 4
    assert all(cell.env.split == "eval" and cell.seeds == (0, 1) for cell in sweep.cells())


def test_a_second_run_flies_nothing_twice(tmp_path, stub):
    config = sweep_config(tmp_path)
    folder, cells = open_run(config), plan(config, "straight").cells()
    first = fly_cells(config, folder, cells)
    assert len(stub.flown) == len(set(stub.flown)) == 8
    again = fly_cells(config, folder, cells)
    assert len(stub.flown) == 8
    for key, episodes in first.items():
        np.testing.assert_array_equal(episodes, again[key])


def test_more_trials_fly_only_the_new_corridors(tmp_path, stub):
    few, many = sweep_config(tmp_path, trials=2), sweep_config(tmp_path, trials=5)
    folder = open_run(few)
    fly_cells(few, folder, plan(few, "straight").cells())
    stub.flown.clear()
    flown = fly_cells(many, folder, plan(many, "straight").cells())
    assert sorted({seed for _, seed in stub.flown}) == [2, 3, 4]
    assert all(list(episodes["seed"]) == [0, 1, 2, 3, 4] for episodes in flown.values())


def test_a_sweep_that_was_stopped_flies_what_is_missing(tmp_path, stub):
    config = sweep_config(tmp_path)
    folder, cells = open_run(config), plan(config, "straight").cells()
    fly_cells(config, folder, cells)
    kept = folder.path / "sweep" / "episodes"
    (kept / f"{cells[1].key}.json").unlink()
    stub.flown.clear()
    fly_cells(config, folder, cells)
    assert stub.flown == [(cells[1].key, 0), (cells[1].key, 1)]


def test_episodes_survive_their_file_unchanged(tmp_path):
    cell = dataclasses.replace(plan(sweep_config(tmp_path), "straight").cells()[0], seeds=(3,))
    flown = np.array([(3, True, False, False, 100.0, 200.0, 1000, 1 / 3, 2)], EPISODE)
    keep = KeepEpisodes(tmp_path)
    keep.on_trial_result(
        1, [], None, {"key": cell.key, "label": list(cell.label), "episodes": flown.tolist()}
    )
    np.testing.assert_array_equal(read_episodes(cell, tmp_path), flown)
    assert unflown(cell, tmp_path).seeds == ()


def test_the_callback_can_be_pickled_with_its_progress_bar(tmp_path):
    keep = pickle.loads(pickle.dumps(KeepEpisodes(tmp_path, lambda count, note: None)))
    assert (keep.folder, keep.advance) == (tmp_path, None)


def test_another_policy_is_another_cell(tmp_path):
    config = sweep_config(tmp_path)
    one = save_untrained(tmp_path / "one", config.env_config())
    manifest = json.loads((one / "policy.json").read_text())
    keys = {plan(config, name).cells()[0].key for name in ("straight", "oracle", str(one))}
    (one / "policy.json").write_text(json.dumps({**manifest, "sha256": {}}))
    assert len(keys | {plan(config, str(one)).cells()[0].key}) == 4


def test_a_policy_is_named_by_its_folder_or_its_run_folder(tmp_path):
    config = sweep_config(tmp_path)
    folder = open_run(config)
    policy = save_untrained(tmp_path / "runs" / "trained" / "policy", config.env_config())
    for name in (None, str(policy), str(policy.parent)):
        named = dataclasses.replace(config, sweep=dataclasses.replace(config.sweep, policy=name))
        assert swept_policy(named, folder) == str(policy)
    nowhere = dataclasses.replace(config, sweep=dataclasses.replace(config.sweep, policy=str(tmp_path)))
    with pytest.raises(ConfigError, match=r"sweep\.policy: must be a run folder, a policy folder or"):
        swept_policy(nowhere, folder)


def test_a_sweep_is_one_run_with_a_child_for_each_condition(tmp_path, stub):
    config = sweep_config(tmp_path)
    for _ in range(2):
        figures = sweeping.run(config)
    assert set(figures) == {f"{axis}={value:g}" for axis, values in AXES.items() for value in values}
    folder = open_run(config).path / "sweep"
    assert all((folder / name).is_file() for name in ("faults.sparsity.png", "table.md", "episodes.csv"))
    client, experiment = open_store(f"sqlite:///{tmp_path}/mlflow.db", config.tracking.experiment)
    runs = {run.info.run_name: run for run in client.search_runs([experiment])}
    parent = runs.pop(f"{folder.parent.name} sweep")
    assert set(runs) == set(figures)
    assert {run.data.tags["mlflow.parentRunId"] for run in runs.values()} == {parent.info.run_id}
    assert runs["env.control_hz=100"].data.metrics["eval/distance_m"] == 50.0
    curve = client.get_metric_history(parent.info.run_id, "sweep/distance_m.env.control_hz")
    assert {point.step for point in curve} == {100, 200}


@pytest.mark.slow
def test_conditions_flown_as_tune_trials_come_back_with_the_policys_episodes(tmp_path):
    config = sweep_config(tmp_path)
    save_untrained(tmp_path / "runs" / "trained" / "policy", config.env_config())
    config = dataclasses.replace(config, sweep=dataclasses.replace(config.sweep, policy=None))
    assert set(sweeping.run(config).values()) == {0.0}
    kept = sorted((open_run(config).path / "sweep" / "episodes").glob("*.json"))
    before = [path.read_text() for path in kept]
    assert len(kept) == 5
    assert sweeping.run(config)
    assert [path.read_text() for path in kept] == before
