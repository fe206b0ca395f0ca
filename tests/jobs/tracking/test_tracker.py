import dataclasses
import json
import math
import re
import shlex
import signal
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from unittest.mock import Mock

import pytest
from click.testing import CliRunner
from matplotlib.figure import Figure
from mlflow.exceptions import MlflowException
from mlflow.protos.databricks_pb2 import INTERNAL_ERROR, INVALID_STATE, PERMISSION_DENIED, UNAUTHENTICATED
from PIL import Image

from jobs.config.config import ConfigError
from jobs.run.files import RunError
from jobs.run.folder import Run, finish, open_run
from jobs.run.locks import held_alone
from jobs.run.signals import Ended
from jobs.run.undo import undo
from jobs.tracking import retry_queue as retry_queue
from jobs.tracking import tracker as tracking
from jobs.tracking.child_runs import ChildRun, write_child_runs
from jobs.tracking.pages import PAGE_WIDTH, chart_view
from jobs.tracking.store import check_metrics, flatten, of_environment, store_uri
from jobs.tracking.tracker import TrackingError, open_store, open_tracker
from tests.support.configs import small_config
from tests.support.stores import place_store


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return open_run(small_config(tmp_path_factory.mktemp("tracking")))


def test_what_is_logged_can_be_read_back_and_reopening_continues_the_same_run(folder, tmp_path):
    (tmp_path / "note.txt").write_text("hello")
    with open_tracker(folder.config, folder) as tracker:
        tracker.log(3, {"eval/success_rate": 0.25, "eval/distance_m": math.nan})
        tracker.text("eval/table.md", "| a |")
        tracker.table("eval/results", {"agent": ["policy", "oracle"], "success_rate": [0.2, 1.0]})
        tracker.artifact(tmp_path / "note.txt", "eval")
    client, run_id = tracker.client, tracker.run_id
    run = client.get_run(run_id)
    assert (run.info.status, run.info.run_name) == ("FINISHED", folder.path.name)
    assert run.data.metrics == {"eval/success_rate": 0.25}
    assert run.data.params["camera.contrast_threshold"] == "0.2"
    assert run.data.tags["run_folder"] == str(folder.path)
    assert run.data.tags["mlflow.note.content"].endswith("| a |")
    assert "eval/distance_m" in run.data.tags["not_measured"]
    files = {file.path for file in client.list_artifacts(run_id, "eval")}
    assert files == {"eval/table.md", "eval/results.json", "eval/note.txt"}
    with open_tracker(folder.config, folder) as second:
        assert client.get_run(second.run_id).info.status == "RUNNING"
        second.log(4, {"eval/success_rate": 0.5})
        names = {"agent": ["policy", "oracle", "straight"], "success_rate": [0.5, math.nan, 0.1]}
        second.table("eval/results", names)  # takes the place of the earlier one
    assert second.run_id == run_id
    history = client.get_metric_history(run_id, "eval/success_rate")
    assert [(point.step, point.value) for point in history] == [(3, 0.25), (4, 0.5)]
    file = client.download_artifacts(run_id, "eval/results.json", str(tmp_path))
    rows = [["policy", 0.5], ["oracle", None], ["straight", 0.1]]
    assert json.loads(Path(file).read_text()) == {"columns": list(names), "data": rows}


@pytest.mark.parametrize(
    ("error", "status"), [(ZeroDivisionError(), "FAILED"), (Ended(signal.SIGTERM), "KILLED")]
)
def test_a_run_that_raises_ends_as_failed_and_one_that_a_signal_ends_as_killed(folder, error, status):
    with pytest.raises(type(error)), open_tracker(folder.config, folder, key=status) as tracker:
        raise error
    assert tracker.client.get_run(tracker.run_id).info.status == status


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


def test_a_store_lies_beside_the_runs_folder_of_any_name_whatever_the_working_folder(tmp_path, monkeypatch):
    base = tmp_path / "job%2Fmain 100%25done a?b#c&d=e"
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    place_store(base / "mlflow.db")
    folder = open_run(small_config(base))
    with open_tracker(folder.config, folder) as tracker:
        tracker.log(1, {"eval/distance_m": 1.0})
        tracker.text("eval/table.md", "| a |")
    assert tracker.client.get_run(tracker.run_id).data.metrics == {"eval/distance_m": 1.0}
    assert any((base / "mlartifacts").rglob("table.md"))
    assert [path for path in tmp_path.rglob("*") if base not in (path, *path.parents)] == [tmp_path / "here"]


def test_an_address_that_mlflow_keeps_no_runs_in_is_refused(folder):
    tracking = dataclasses.replace(folder.config.tracking, uri="file:///tmp/mlruns")
    with pytest.raises(ConfigError, match=r"tracking.uri: must begin with .* got 'file:///tmp/mlruns'"):
        store_uri(dataclasses.replace(folder.config, tracking=tracking))


@pytest.mark.parametrize(
    ("metrics", "rule"),
    [
        ({"eval/distance_m": -math.inf}, "metrics must be finite, got eval/distance_m = -inf"),
        ({"learners/x": 1.0, "plain": 1.0}, r"got \['learners/x', 'plain'\]"),
        ({f"eval/{number}": 1.0 for number in range(40)}, "at most 40 a call, got 41"),
    ],
)
def test_metrics_that_a_store_should_not_have_are_refused(metrics, rule):
    with pytest.raises(ValueError, match=rule):
        check_metrics({**metrics, "eval/success_rate": 1.0})


def test_settings_that_mlflow_would_cut_are_refused():
    assert flatten({"a": {"b": 1, "c": {}}}) == {"a.b": "1", "a.c": "{}"}
    with pytest.raises(ValueError, match=r"a\.b must be at most 6000 characters, got 6001"):
        flatten({"a": {"b": "x" * 6001}})


def _experiment_of(uri: str) -> str:
    return open_store(uri, "evade")[1]


@pytest.mark.slow
def test_processes_that_start_together_make_one_store(tmp_path):
    uri = f"sqlite:///{tmp_path}/mlflow.db"
    with ProcessPoolExecutor(3) as pool:
        opened = list(pool.map(_experiment_of, [uri] * 3))
    assert len(set(opened)) == 1


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
    silent = Mock(side_effect=MlflowException("API request failed", error_code=INTERNAL_ERROR))
    with open_tracker(folder.config, folder, key="away") as tracker:
        tracker.log(1, {"train/episode_return": 1.0})
        with monkeypatch.context() as away:
            away.setattr(tracker.client, "log_batch", silent)
            tracker.log(2, {"train/episode_return": 2.0})
            tracker.log(3, {"train/episode_return": math.nan})
        assert len(tracker.retry_queue.rows()) == 2
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
    rule = rf"127\.0\.0\.1:9 does not answer \(.*refused.*{folder.path}"
    with pytest.raises(TrackingError, match=rule):
        open_tracker(dataclasses.replace(folder.config, tracking=nowhere), folder).__enter__()


def test_a_second_process_is_kept_out_of_the_run_folder(folder):
    with held_alone(folder.path), pytest.raises(RunError, match="works there; wait until it has ended"):
        open_tracker(folder.config, folder).__enter__()


def test_a_run_that_was_deleted_in_mlflow_is_recorded_again_with_all_its_curves(tmp_path):
    place_store(tmp_path / "mlflow.db")
    place_store(tmp_path / "other.db")
    folder = open_run(small_config(tmp_path))
    with open_tracker(folder.config, folder) as tracker:
        for step, distance in ((10, 1.0), (20, 2.0), (20, 2.5)):
            tracker.log(step, {"eval/distance_m": distance, "eval/success_rate": math.nan})
    tracker.client.delete_run(tracker.run_id)
    with open_tracker(folder.config, folder) as again:
        again.log(30, {"eval/distance_m": 3.0})
    assert again.run_id != tracker.run_id
    points = again.client.get_metric_history(again.run_id, "eval/distance_m")
    assert [(point.step, point.value) for point in points] == [(10, 1.0), (20, 2.5), (30, 3.0)]
    elsewhere = dataclasses.replace(folder.config.tracking, uri="sqlite:///other.db")
    with open_tracker(dataclasses.replace(folder.config, tracking=elsewhere), folder) as other:
        pass
    points = other.client.get_metric_history(other.run_id, "eval/distance_m")
    assert [point.step for point in points] == [10, 20, 30]


def test_an_experiment_that_was_deleted_is_named_with_a_command_that_restores_it(tmp_path, monkeypatch):
    place_store(tmp_path / "mlflow.db")
    folder = open_run(small_config(tmp_path))
    client, experiment_id = open_store(store_uri(folder.config), "evade")
    client.delete_experiment(experiment_id)
    with pytest.raises(TrackingError, match=r"^tracking\.experiment: 'evade' was deleted") as error:
        open_tracker(folder.config, folder).__enter__()
    from mlflow.cli import cli

    variable, *words = shlex.split(re.search("`(.*)`", str(error.value))[1])
    assert (variable, words[0]) == (f"MLFLOW_TRACKING_URI={store_uri(folder.config)}", "mlflow")
    monkeypatch.setenv(*variable.split("=", 1))
    monkeypatch.setattr("mlflow.tracking._tracking_service.utils._tracking_uri", None)
    assert CliRunner().invoke(cli, words[1:]).exit_code == 0
    another = re.search(r"tracking\.experiment=(\w+)", str(error.value))[1]
    named = dataclasses.replace(folder.config.tracking, experiment=another)
    for config in (folder.config, dataclasses.replace(folder.config, tracking=named)):
        with open_tracker(config, folder) as tracker:
            assert tracker.client.get_experiment(tracker.experiment_id).lifecycle_stage == "active"


@pytest.mark.parametrize(
    ("code", "said", "remedy"),
    [
        (UNAUTHENTICATED, "API request failed with error code 401", "MLFLOW_TRACKING_USERNAME"),
        (PERMISSION_DENIED, "Permission denied", "tracking.experiment=NAME"),
        (INVALID_STATE, "The run 7 must be in the 'active' state", "tracking.experiment=NAME"),
    ],
)
def test_a_store_that_refuses_is_told_in_one_line_with_its_remedy(folder, code, said, remedy):
    with pytest.raises(TrackingError) as error, open_tracker(folder.config, folder):
        raise MlflowException(said, error_code=code)
    assert len(str(error.value).splitlines()) == 1
    assert "refuses" in str(error.value)
    assert remedy in str(error.value)


def test_a_refusal_leaves_neither_run_folder_nor_store(tmp_path):
    folder = open_run(small_config(tmp_path))
    with pytest.raises(ConfigError), open_tracker(folder.config, folder):
        raise ConfigError("algo.num_env_runners: too many")
    undo()
    assert list(tmp_path.iterdir()) == []
    more = tmp_path / "more"  # MLflow keeps the connection to a removed file as long as a process lives
    more.mkdir()
    folder = open_run(small_config(more))
    with open_tracker(folder.config, folder):
        finish(folder, "train", {"eval/distance_m": 1.0})
    undo()
    assert (folder.path / "stages" / "train.json").is_file()
    assert (more / "mlflow.db").is_file()


URI, EXPERIMENT = "MLFLOW_TRACKING_URI", "MLFLOW_EXPERIMENT_NAME"


@pytest.mark.parametrize(
    ("variables", "words", "uri", "said"),
    [
        ({URI: "http://u:secret@host"}, [], "http://u:secret@host", "sets tracking.uri=http://***@host"),
        ({URI: "http://h"}, ["tracking.uri=sqlite:///a.db"], "sqlite:///mlflow.db", "the command line gives"),
        ({URI: "databricks"}, [], "sqlite:///mlflow.db", "is not used: must begin with"),
        ({EXPERIMENT: "team"}, [], "sqlite:///mlflow.db", "sets tracking.experiment=team"),
    ],
)  # fmt: skip
def test_the_variables_of_mlflow_are_used_or_named_as_unused(variables, words, uri, said):
    values = {"tracking": {"uri": "sqlite:///mlflow.db", "experiment": "evade"}}
    (line,) = of_environment(values, words, variables)
    assert values["tracking"]["uri"] == uri
    assert said in line
    assert values["tracking"]["experiment"] == variables.get(EXPERIMENT, "evade")
    assert of_environment(values, words, {}) == []
