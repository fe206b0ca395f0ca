import dataclasses
import json
from pathlib import Path

import pytest

from jobs.rollout.diagnostics import DRIFT_METRICS
from jobs.run.folder import open_run
from jobs.study.study import announce, run
from models.policy.policy import NETWORKS
from tests.support.configs import sweep_config
from tests.support.fake_executor import FakeExecutor
from tests.support.policies import save_training
from tests.support.runs import in_store, planned, tracked_sweeps


def test_who_is_evaluated_and_whose_sensor_differs_is_said(tmp_path, capsys):
    config = sweep_config(tmp_path)
    same = save_training(tmp_path / "same", "a", 0, config.env)
    slow = save_training(tmp_path / "slow", "a", 1, dataclasses.replace(config.env, control_hz=100.0))
    announce(planned(config, same, slow, "oracle"))
    assert capsys.readouterr().out.splitlines() == [
        "Group: a (training seeds 0, 1)",
        "Group: oracle",
        f"Evaluated with its own sensor: {slow}: control_hz = 100.0 instead of 200.0",
    ]


@pytest.mark.slow  # two whole reports
def test_a_sweep_is_one_run_with_a_child_for_each_condition_and_group_and_a_rerun_adds_no_point(tmp_path):
    config = in_store(sweep_config(tmp_path, policies=["straight", "oracle"], reference="straight"), tmp_path)
    for _ in range(2):
        figures = run(config, FakeExecutor())
    assert len(figures) == 5 * 2
    place = open_run(config).path / "study"
    names = ("sparsity.png", "rate.png", "table.md", "details.md", "episodes.csv", "about.json")
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
    assert client.get_run(parent).data.metrics["sweep/episodes"] == 8  # of each baseline two rates
    (groups,) = tracked_sweeps(config, "group")[1].values()
    assert set(groups) == {"straight", "oracle"}
    curve = client.get_metric_history(groups["oracle"].info.run_id, "sweep/sparsity_percent_distance_m")
    assert [(point.step, point.value) for point in curve] == [(0, 50.0), (50, 50.0)]
    note = client.get_run(parent).data.tags["mlflow.note.content"]
    order = ("charts-", "page/sweep/sparsity.png", "| rate | 100 |")
    assert sorted(map(note.index, order)) == list(map(note.index, order))
    rows = client.download_artifacts(parent, "sweep/episodes.csv", str(tmp_path))
    assert Path(rows).read_bytes() == (open_run(config).path / "study" / "episodes.csv").read_bytes()
    # A simulation that several conditions share stands under each: conditions, agents, corridors.
    assert len(Path(rows).read_text().splitlines()) == 1 + 5 * 2 * 2
    table = client.download_artifacts(parent, "sweep/results.json", str(tmp_path))
    assert len(json.loads(Path(table).read_text())["data"]) == len(figures)


@pytest.mark.system  # four seconds of MLflow's store
def test_a_failed_task_stands_in_the_table_and_its_child_comes_when_it_is_evaluated(tmp_path):
    config = in_store(sweep_config(tmp_path), tmp_path)
    executor = FakeExecutor()
    executor.broken = {("rate", 100): "ValueError: no"}
    run(config, executor)
    table = open_run(config).path / "study" / "table.md"
    assert "| rate | 100 | failed |" in table.read_text()
    assert "| rate | 100 | straight |  | ValueError: no |" in table.read_text()
    executor.broken = {}
    run(config, executor)
    assert "failed" not in table.read_text()
    _, sweeps = tracked_sweeps(config)
    ((_, children),) = sweeps.items()
    assert len(children) == 5


@pytest.mark.system  # four seconds of MLflow's store
def test_sweeps_of_other_policies_or_corridors_share_no_run_and_tell_what_differs_from_training(tmp_path):
    config = in_store(sweep_config(tmp_path), tmp_path)
    agent = save_training(tmp_path / "policy", "a", 0, dataclasses.replace(config.env, control_hz=100.0))
    for policies, trials in (([agent], 2), ([agent, "straight"], 2), ([agent], 3)):
        settings = dataclasses.replace(config.own, policies=policies, trials=trials)
        run(dataclasses.replace(config, own=settings), FakeExecutor())
    _, sweeps = tracked_sweeps(config)
    assert sorted(len(children) for children in sweeps.values()) == [5, 5, 10]
    for children in sweeps.values():
        differ = {name: json.loads(run.data.tags["differs_from_training"]) for name, run in children.items()}
        assert differ.pop("rate=200 a") == {"control_hz": [100.0, 200.0]}
        assert not any(differ.values())


@pytest.mark.slow
def test_tasks_evaluated_as_tune_trials_come_back_with_their_episodes_and_one_that_raises_stops_no_other(
    tmp_path,
):
    config = sweep_config(tmp_path)
    env = config.env
    kinds = {"bytestream": 0, "event_columns": 0, "event_image": 1}
    agents = [save_training(tmp_path / name, name, seed, env, name) for name, seed in kinds.items()]
    (tmp_path / "event_image" / NETWORKS).write_bytes(b"")
    config = dataclasses.replace(config, own=dataclasses.replace(config.own, policies=agents))
    figures = run(config)
    assert set(figures.values()) == {0.0}
    assert len(figures) == 5 * 2
    place = open_run(config).path / "study"
    assert "| event_image | 1 | PolicyFileError: " in (place / "table.md").read_text()
    kept = sorted((place / "episodes").glob("*.json"))
    before = [path.read_text() for path in kept]
    tasks = [json.loads(text) for text in before]
    assert {frozenset(task["encoder"]) for task in tasks if "bytestream" in task["label"]} == {
        frozenset(DRIFT_METRICS)
    }
    assert not any(task["encoder"] for task in tasks if "event_columns" in task["label"])
    assert len(kept) == 3 * 2
    assert run(config) == figures
    assert [path.read_text() for path in kept] == before
