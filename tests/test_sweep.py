import dataclasses
import json
import pickle
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from jobs import sweep as sweeping
from jobs.conditions import plan, read_entry
from jobs.drift import FIGURES
from jobs.flights import EPISODE
from jobs.runs import open_run
from jobs.sweep import KeepEpisodes, SweepError, flown, fly_cells, read_episodes, unflown, unmeasured
from jobs.tracking import open_store
from models.policy import NETWORKS
from tests.test_conditions import planned, save_training, sweep_config


class StubTuner:
    """Counts what Tune would fly in workers; what is `broken` raises with a reason, or dies without."""

    flown: list[tuple[str, int]] = []  # noqa: RUF012
    measured: list[str] = []  # noqa: RUF012
    broken: dict[tuple[str, str], str] = {}  # noqa: RUF012

    def __init__(self, place, missing, measured, keep):
        self.missing, self.keep = missing, keep
        self.measured += measured

    def fit(self):
        for cell in self.missing:
            result = {"key": cell.key, "label": list(cell.label)}
            if cell.label in self.broken:
                if self.broken[cell.label]:
                    self.keep.on_trial_result(1, [], None, {**result, "failed": self.broken[cell.label]})
                else:
                    self.die(cell)
                continue
            rows = np.zeros(len(cell.seeds), EPISODE)
            rows["seed"], rows["distance_m"] = cell.seeds, 50.0
            self.flown += [(cell.key, seed) for seed in cell.seeds]
            accuracy = {"event_error": 0.01, "renders_per_step": 3.0} if cell.key in self.measured else None
            result |= {"simulation": cell.simulation, "accuracy": accuracy}
            self.keep.on_trial_result(1, [], None, {**result, "encoder": {}, "episodes": rows.tolist()})

    def die(self, cell):
        trial = SimpleNamespace(config={"trial": {"cell": cell}})
        for hook in [self.keep.on_trial_recover] * sweeping.MAX_FAILURES + [self.keep.on_trial_error]:
            self.keep.on_trial_start(1, [], trial)
            hook(1, [], trial)


@pytest.fixture
def stub(monkeypatch):
    StubTuner.flown, StubTuner.measured, StubTuner.broken = [], [], {}
    monkeypatch.setattr(sweeping, "_tuner", StubTuner)
    monkeypatch.setattr(sweeping, "start_ray", lambda *given: None)
    return StubTuner


def test_a_second_run_flies_nothing_twice(tmp_path, stub):
    config = sweep_config(tmp_path)
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
    config = sweep_config(tmp_path)
    place, cells = open_run(config).path / "sweep", planned(config, "straight").cells
    keys = {cell.label: cell.key for cell in cells}
    raised, died = ("sparsity", "0.5"), ("rate", "100")
    stub.broken = {raised: "ValueError: no", died: ""}
    episodes, failed = fly_cells(config, place, cells)
    assert failed == {keys[raised]: "ValueError: no", keys[died]: "its process ended 3 times"}
    assert set(episodes) == {keys["sparsity", "0"]}
    stub.broken = {}
    stub.flown.clear()
    assert fly_cells(config, place, cells)[1] == {}
    assert {key for key, _ in stub.flown} == {keys[raised], keys[died]}


def test_a_sweep_of_which_nothing_flies_stops_with_the_reason(tmp_path, stub):
    config = sweep_config(tmp_path)
    place, cells = open_run(config).path / "sweep", planned(config, "straight").cells
    stub.broken = {cell.label: "ValueError: no" for cell in cells}
    with pytest.raises(SweepError, match=r"^nothing could be flown: ValueError: no; the same command"):
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
    path = save_training(tmp_path / "policy", "a", 0, config.env_config())
    cell = plan(config, [read_entry(path)]).cells[0]
    first, again = flown(cell, True), flown(cell, False)
    assert first["episodes"] == again["episodes"]
    assert [row[0] for row in first["episodes"]] == [0, 1]
    assert 0 <= first["accuracy"]["event_error"] < 0.2
    assert again["accuracy"] is None


def test_who_flies_and_whose_sensor_differs_is_said(tmp_path, capsys):
    config = sweep_config(tmp_path)
    same = save_training(tmp_path / "same", "a", 0, config.env_config())
    slow = save_training(tmp_path / "slow", "a", 1, config.env_config(control_hz=100.0))
    sweeping.announce(planned(config, same, slow, "oracle"))
    assert capsys.readouterr().out.splitlines() == [
        "Group: a (training seeds 0, 1)",
        "Group: oracle",
        f"Flown with its own sensor: {slow}: control_hz = 100.0 instead of 200.0",
    ]


def tracked_sweeps(config, kind="condition", parent="sweep"):
    """Client, and the children of a kind by name of each sweep's parent run, or of each of another kind."""
    client, experiment = open_store(config.tracking.uri, config.tracking.experiment)
    parents = client.search_runs([experiment], f"tags.kind = '{parent}'")
    below = "tags.`mlflow.parentRunId` = '{}'"
    children = {
        run.info.run_id: client.search_runs(
            [experiment], f"{below.format(run.info.run_id)} and tags.kind = '{kind}'"
        )
        for run in parents
    }
    return client, {parent: {run.info.run_name: run for run in runs} for parent, runs in children.items()}


def in_store(config, tmp_path):
    return dataclasses.replace(
        config, tracking=dataclasses.replace(config.tracking, uri=f"sqlite:///{tmp_path}/m.db")
    )


def test_a_sweep_is_one_run_with_a_child_for_each_condition_and_group_and_a_rerun_adds_no_point(
    tmp_path, stub
):
    config = in_store(sweep_config(tmp_path, policies=["straight", "oracle"], reference="straight"), tmp_path)
    for _ in range(2):
        figures = sweeping.run(config)
    assert len(figures) == 5 * 2
    place = open_run(config).path / "sweep"
    names = (
        "sparsity.png",
        "rate.png",
        "contacts.png",
        "table.md",
        "details.md",
        "episodes.csv",
        "about.json",
    )
    assert all((place / name).is_file() for name in names)
    client, sweeps = tracked_sweeps(config)
    ((parent, children),) = sweeps.items()
    assert client.get_run(parent).info.run_name.startswith(f"{place.parent.name} sweep ")
    assert set(children) == set(figures)
    child = children["rate=100 oracle"]
    assert child.info.status == "FINISHED"
    wanted = {"axis": "rate", "value": "100", "group": "oracle", "seeds": "-", "env.control_hz": "100"}
    assert wanted.items() <= child.data.params.items()
    assert [point.value for point in client.get_metric_history(child.info.run_id, "eval/distance_m")] == [
        50.0
    ]
    assert child.data.metrics["sweep/value"] == 100.0
    assert child.data.metrics["sim/event_error"] == 0.01
    assert child.data.metrics["sweep/success_difference"] == 0.0
    assert [point.value for point in client.get_metric_history(parent, "sweep/conditions")] == [5.0]
    assert client.get_run(parent).data.metrics["sim/event_error_max"] == 0.01
    (groups,) = tracked_sweeps(config, "group")[1].values()
    assert set(groups) == {"straight", "oracle"}
    curve = client.get_metric_history(groups["oracle"].info.run_id, "sweep/sparsity_percent_distance_m")
    assert [(point.step, point.value) for point in curve] == [(0, 50.0), (50, 50.0)]
    note = client.get_run(parent).data.tags["mlflow.note.content"]
    order = ("charts-", "page/sweep/sparsity.png", "| rate | 100 |")
    assert sorted(map(note.index, order)) == list(map(note.index, order))
    table = client.download_artifacts(parent, "sweep/results.json", str(tmp_path))
    assert len(json.loads(Path(table).read_text())["data"]) == len(figures)


def test_a_failed_cell_stands_in_the_table_and_its_child_comes_when_it_is_flown(tmp_path, stub):
    config = in_store(sweep_config(tmp_path), tmp_path)
    stub.broken = {("rate", "100"): "ValueError: no"}
    sweeping.run(config)
    table = open_run(config).path / "sweep" / "table.md"
    assert "| rate | 100 | failed |" in table.read_text()
    assert "| rate | 100 | straight |  | ValueError: no |" in table.read_text()
    stub.broken = {}
    sweeping.run(config)
    assert "failed" not in table.read_text()
    _, sweeps = tracked_sweeps(config)
    ((_, children),) = sweeps.items()
    assert len(children) == 5


def test_sweeps_of_other_policies_or_corridors_share_no_run_and_tell_what_differs_from_training(
    tmp_path, stub
):
    config = in_store(sweep_config(tmp_path), tmp_path)
    pilot = save_training(tmp_path / "policy", "a", 0, config.env_config(control_hz=100.0))
    for policies, trials in (([pilot], 2), ([pilot, "straight"], 2), ([pilot], 3)):
        settings = dataclasses.replace(config.sweep, policies=policies, trials=trials)
        sweeping.run(dataclasses.replace(config, sweep=settings))
    _, sweeps = tracked_sweeps(config)
    assert sorted(len(children) for children in sweeps.values()) == [5, 5, 10]
    for children in sweeps.values():
        differ = {name: json.loads(run.data.tags["differs_from_training"]) for name, run in children.items()}
        assert differ.pop("rate=200 a") == {"control_hz": [100.0, 200.0]}
        assert not any(differ.values())


@pytest.mark.slow
def test_cells_flown_as_tune_trials_come_back_with_their_episodes_and_one_that_raises_stops_no_other(
    tmp_path,
):
    config = sweep_config(tmp_path)
    env = config.env_config()
    kinds = {"brp_full": 0, "event_columns": 0, "eip": 1}
    pilots = [save_training(tmp_path / name, name, seed, env, name) for name, seed in kinds.items()]
    (tmp_path / "eip" / NETWORKS).write_bytes(b"")
    config = dataclasses.replace(config, sweep=dataclasses.replace(config.sweep, policies=pilots))
    figures = sweeping.run(config)
    assert set(figures.values()) == {0.0}
    assert len(figures) == 5 * 2
    place = open_run(config).path / "sweep"
    assert "| eip | 1 | PolicyFileError: " in (place / "table.md").read_text()
    kept = sorted((place / "episodes").glob("*.json"))
    before = [path.read_text() for path in kept]
    cells = [json.loads(text) for text in before]
    assert {frozenset(cell["encoder"]) for cell in cells if "brp_full" in cell["label"]} == {
        frozenset(FIGURES)
    }
    assert not any(cell["encoder"] for cell in cells if "event_columns" in cell["label"])
    assert len(kept) == 3 * 2
    assert sweeping.run(config) == figures
    assert [path.read_text() for path in kept] == before
