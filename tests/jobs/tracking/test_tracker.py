import dataclasses
import json
import math
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pytest
from matplotlib.figure import Figure
from mlflow.exceptions import MlflowException
from mlflow.protos.databricks_pb2 import INTERNAL_ERROR
from PIL import Image

from jobs.config.config import ConfigError
from jobs.run.files import RunError
from jobs.run.folder import Run, open_run
from jobs.run.locks import held_alone
from jobs.tracking import retry_queue as retry_queue
from jobs.tracking import tracker as tracking
from jobs.tracking.child_runs import ChildRun, write_child_runs
from jobs.tracking.pages import PAGE_WIDTH, chart_view
from jobs.tracking.store import check_metrics, flatten, store_uri
from jobs.tracking.tracker import TrackingError, open_store, open_tracker
from tests.support.configs import small_config


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return open_run(small_config(tmp_path_factory.mktemp("tracking")))


def test_what_is_logged_can_be_read_back(folder, tmp_path):
    (tmp_path / "note.txt").write_text("hello")
    with open_tracker(folder.config, folder) as tracker:
        tracker.log(3, {"eval/success_rate": 0.25, "eval/distance_m": math.nan})
        tracker.text("eval/table.md", "| a |")
        tracker.table("eval/results", {"agent": ["policy", "oracle"], "success_rate": [0.2, 1.0]})
        tracker.artifact(tmp_path / "note.txt", "eval")
    run = tracker.client.get_run(tracker.run_id)
    assert run.info.status == "FINISHED"
    assert run.info.run_name == folder.path.name
    assert run.data.metrics == {"eval/success_rate": 0.25}
    assert [
        (m.step, m.value) for m in tracker.client.get_metric_history(tracker.run_id, "eval/success_rate")
    ] == [(3, 0.25)]
    assert run.data.params["camera.contrast_threshold"] == "0.2"
    assert run.data.tags["run_folder"] == str(folder.path)
    assert run.data.tags["mlflow.note.content"].endswith("| a |")
    assert "eval/distance_m" in run.data.tags["not_measured"]
    assert {file.path for file in tracker.client.list_artifacts(tracker.run_id, "eval")} == {
        "eval/table.md", "eval/results.json", "eval/note.txt"
    }  # fmt: skip


def test_a_table_takes_the_place_of_an_earlier_one(folder, tmp_path):
    with open_tracker(folder.config, folder, key="tables") as tracker:
        for rates in ([0.2, 1.0], [0.5, math.nan, 0.1]):
            names = ["policy", "oracle", "straight"][: len(rates)]
            tracker.table("eval/results", {"agent": names, "success_rate": rates})
    file = tracker.client.download_artifacts(tracker.run_id, "eval/results.json", str(tmp_path))
    rows = [["policy", 0.5], ["oracle", None], ["straight", 0.1]]
    assert json.loads(Path(file).read_text()) == {"columns": ["agent", "success_rate"], "data": rows}


def test_reopening_continues_the_same_run(folder):
    with open_tracker(folder.config, folder) as first:
        first.log(1, {"train/episode_return": 1.0})
    with open_tracker(folder.config, folder) as second:
        assert first.client.get_run(second.run_id).info.status == "RUNNING"
        second.log(2, {"train/episode_return": 2.0})
    assert second.run_id == first.run_id
    assert len(second.client.get_metric_history(second.run_id, "train/episode_return")) == 2


def test_a_run_that_raises_ends_as_failed(folder):
    with pytest.raises(ZeroDivisionError), open_tracker(folder.config, folder, key="broken") as tracker:
        raise ZeroDivisionError
    assert tracker.client.get_run(tracker.run_id).info.status == "FAILED"


def test_a_saved_view_stands_in_the_experiments_tags_and_its_text_leads_there(folder):
    with open_tracker(folder.config, folder) as tracker:
        tracker.save_view("charts-x", "Sweep x: charts", chart_view("", ["sweep/rate_success"]))
        before = tracker.client.get_experiment(tracker.experiment_id).tags
        tracker.save_view("charts-x", "Sweep x: charts", chart_view("", ["sweep/rate_success"]))
        assert tracker.client.get_experiment(tracker.experiment_id).tags == before
    tags = tracker.client.get_experiment(tracker.experiment_id).tags
    assert '"name": "Results"' in tags["mlflow.sharedViewState.results"]
    first = tags["mlflow.note.content"].splitlines()[0]
    for key in ("results", "sweeps", "charts-learning", "charts-x"):
        assert f"viewStateShareKey={key}" in first
    assert tracker.dashboard().endswith("runs?workflowType=machine_learning&viewStateShareKey=results")


def test_the_page_of_a_run_shows_small_copies_of_its_pictures_and_its_tables(folder):
    figure = Figure(figsize=(20, 4))
    with open_tracker(folder.config, folder, key="page") as tracker:
        tracker.figure("eval/trajectories.png", figure)
        tracker.text("eval/table.md", "| success |")
        started = tracker.client.get_run(tracker.run_id).data.tags["mlflow.note.content"]
    note = tracker.client.get_run(tracker.run_id).data.tags["mlflow.note.content"]
    assert "eval/" not in started
    small = f"get-artifact?path=page/eval/trajectories.png&run_uuid={tracker.run_id}"
    assert note.index(small) < note.index("| success |")
    file = tracker.client.download_artifacts(tracker.run_id, "page/eval/trajectories.png")
    assert Image.open(file).size[0] == PAGE_WIDTH
    with open_tracker(folder.config, folder, key="page"):  # copies of copies are not made
        pass
    assert "page/page" not in " ".join(tracker.files())


def test_the_store_lies_beside_the_runs_folder_whatever_the_working_folder(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    base = Path(folder.config.runs_dir).parent
    assert store_uri(folder.config) == f"sqlite:///{base}/mlflow.db"
    with open_tracker(folder.config, folder) as tracker:
        location = tracker.client.get_run(tracker.run_id).info.artifact_uri
    assert location.startswith(f"file://{base}/mlartifacts/")
    assert not list(tmp_path.iterdir())


def test_an_address_that_mlflow_keeps_no_runs_in_is_refused(folder):
    tracking = dataclasses.replace(folder.config.tracking, uri="file:///tmp/mlruns")
    with pytest.raises(ConfigError, match=r"tracking.uri: must begin with .* got 'file:///tmp/mlruns'"):
        store_uri(dataclasses.replace(folder.config, tracking=tracking))


@pytest.mark.parametrize("value", [math.inf, -math.inf])
def test_infinite_metrics_are_refused_by_name(value):
    with pytest.raises(ValueError, match=f"metrics must be finite, got eval/distance_m = {value}"):
        check_metrics({"eval/distance_m": value, "eval/success_rate": 1.0})


def test_metrics_outside_the_known_sections_are_refused():
    with pytest.raises(ValueError, match="got \\['learners/x', 'plain'\\]"):
        check_metrics({"learners/x": 1.0, "plain": 1.0, "eval/success_rate": 1.0})


def test_a_flood_of_metrics_is_refused():
    with pytest.raises(ValueError, match="at most 40 a call, got 41"):
        check_metrics({f"eval/{number}": 1.0 for number in range(41)})


def test_settings_that_mlflow_would_cut_are_refused():
    assert flatten({"a": {"b": 1, "c": {}}}) == {"a.b": "1", "a.c": "{}"}
    with pytest.raises(ValueError, match=r"a\.b must be at most 6000 characters, got 6001"):
        flatten({"a": {"b": "x" * 6001}})


def open_new_store(uri: str) -> str:
    return open_store(uri, "evade")[1]


@pytest.mark.slow
def test_processes_that_start_together_make_one_store(tmp_path):
    uri = f"sqlite:///{tmp_path}/mlflow.db"
    with ProcessPoolExecutor(3) as pool:
        assert len(set(pool.map(open_new_store, [uri] * 3))) == 1


def test_children_are_written_once_and_replaced_where_their_content_has_changed(folder):
    def child(name, success):
        curves = {"sweep/rate_success": {45: success, 100: 1.0}}
        params = {"axis": "rate", "env": {"hz": 45}}
        return ChildRun(name, params, {"note": "x"}, {"eval/success_rate": success}, curves)

    with open_tracker(folder.config, folder, key="children") as parent:
        search = [parent.experiment_id], f"tags.`mlflow.parentRunId` = '{parent.run_id}'"
        write_child_runs(parent, "condition", [child("a", 0.5), child("b", 0.5)])
        before = {run.info.run_name: run for run in parent.client.search_runs(*search)}
        write_child_runs(parent, "condition", [child("a", 0.5), child("b", 1.0)])
        after = {run.info.run_name: run for run in parent.client.search_runs(*search)}
    assert set(after) == {"a", "b"}
    assert after["a"].info.run_id == before["a"].info.run_id
    assert after["b"].info.run_id != before["b"].info.run_id
    assert after["b"].data.metrics == {"eval/success_rate": 1.0, "sweep/rate_success": 1.0}
    curve = parent.client.get_metric_history(after["b"].info.run_id, "sweep/rate_success")
    assert [(point.step, point.value) for point in curve] == [(45, 1.0), (100, 1.0)]
    assert after["b"].data.params == {"axis": "rate", "env.hz": "45"}
    assert after["b"].info.status == "FINISHED"


def test_curves_wait_while_the_store_is_away_and_are_delivered_before_the_run_ends(folder, monkeypatch):
    monkeypatch.setattr(retry_queue, "RETRY_AFTER_S", 0.0)
    with open_tracker(folder.config, folder, key="away") as tracker:
        answer = tracker.client.log_batch

        def silent(*given, **named):
            raise MlflowException("API request failed", error_code=INTERNAL_ERROR)

        tracker.log(1, {"train/episode_return": 1.0})
        monkeypatch.setattr(tracker.client, "log_batch", silent)
        tracker.log(2, {"train/episode_return": 2.0})
        tracker.log(3, {"train/episode_return": math.nan})
        assert len(tracker.retry_queue.rows()) == 2
        monkeypatch.setattr(tracker.client, "log_batch", answer)
    assert not tracker.retry_queue.file.exists()
    history = tracker.client.get_metric_history(tracker.run_id, "train/episode_return")
    assert [(point.step, point.value) for point in history] == [(1, 1.0), (2, 2.0)]
    run = tracker.client.get_run(tracker.run_id)
    assert run.data.tags["not_measured"] == "step 3: train/episode_return"
    assert run.info.status == "FINISHED"


def test_the_same_row_twice_is_the_same_point_once(folder):
    with open_tracker(folder.config, folder, key="twice") as tracker:
        row = {"step": 1, "time_ms": 5, "metrics": {"train/episode_return": 1.0}, "missing": []}
        tracker._send(row)
        tracker._send(row)
        assert len(tracker.client.get_metric_history(tracker.run_id, "train/episode_return")) == 1


def test_a_store_that_does_not_answer_stops_with_one_error_that_says_where_the_results_are(
    folder, monkeypatch
):
    monkeypatch.setitem(tracking.MANY_RETRIES, "MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    nowhere = dataclasses.replace(folder.config.tracking, uri="http://127.0.0.1:9")
    config = dataclasses.replace(folder.config, tracking=nowhere)
    with (
        pytest.raises(TrackingError, match=rf"127\.0\.0\.1:9 does not answer \(.*refused.*{folder.path}"),
        open_tracker(config, folder),
    ):
        pass


def test_a_second_process_is_kept_out_of_the_run_folder(folder):
    with (
        held_alone(folder.path),
        pytest.raises(RunError, match=r"works there; wait until it has ended"),
        open_tracker(folder.config, folder),
    ):
        pass
