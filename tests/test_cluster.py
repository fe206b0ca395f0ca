import multiprocessing
import tempfile
import time

import pydantic
import pytest
import ray
from ray.tune import TuneError

from jobs import cluster as joining
from jobs.cluster import ClusterError, holds, one_at_a_time, storage
from jobs.settings import ClusterConfig


def cluster(place):
    return ClusterConfig(name="ray", address="auto", num_cpus=None, storage=place)


def test_what_nodes_write_lies_in_the_run_folder_or_under_its_name_in_the_storage(tmp_path):
    folder = tmp_path / "runs" / "a-smoke-s0-1" / "train"
    assert storage(cluster(None), folder) == str(folder)
    assert storage(cluster("/nfs/evade/"), folder) == "/nfs/evade/a-smoke-s0-1/train"
    assert storage(cluster("s3://bucket/evade"), folder) == "s3://bucket/evade/a-smoke-s0-1/train"


def test_a_storage_that_other_machines_would_look_for_elsewhere_is_refused():
    with pytest.raises(pydantic.ValidationError, match="must be an absolute folder"):
        cluster("checkpoints")


def test_a_folder_is_searched_by_its_path_and_by_its_address(tmp_path):
    (tmp_path / "experiment_state-1.json").touch()
    for place in (str(tmp_path), tmp_path.as_uri()):
        assert holds(place, "experiment_state-")
        assert not holds(place, "tuner")
        assert not holds(f"{place}/none", "experiment_state-")


def start(results, name):
    with one_at_a_time():
        results.put((name, "in"))
        time.sleep(0.3)
        results.put((name, "out"))


def test_two_processes_start_ray_one_after_the_other(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    context = multiprocessing.get_context("fork")
    results = context.Queue()
    processes = [context.Process(target=start, args=(results, name)) for name in "ab"]
    for process in processes:
        process.start()
    order = [results.get(timeout=20) for _ in range(4)]
    for process in processes:
        process.join()
    assert [place for _, place in order] == ["in", "out", "in", "out"]
    assert order[0][0] == order[1][0] != order[2][0] == order[3][0]


def test_a_process_that_dies_lets_go(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    context = multiprocessing.get_context("fork")
    process = context.Process(target=start, args=(context.Queue(), "a"))
    process.start()
    time.sleep(0.1)
    process.kill()
    process.join()
    with one_at_a_time():
        pass


@pytest.mark.parametrize("failures", [0, 1, joining.STARTS])
def test_a_busy_machine_gets_more_than_one_chance_to_start_ray(monkeypatch, failures):
    calls = []

    def init(**settings):
        calls.append(settings)
        if calls.count(settings) <= failures:
            raise Exception("The current node timed out during startup. ...")

    monkeypatch.setattr(ray, "init", init)
    monkeypatch.setattr(ray, "shutdown", lambda: calls.append("shutdown"))
    if failures < joining.STARTS:
        joining._start_local({"num_cpus": 1})
        assert calls == [{"address": "local", "include_dashboard": False, "num_cpus": 1}] + (
            ["shutdown", calls[0]] * failures
        )
    else:
        with pytest.raises(ClusterError, match="the machine is too busy"):
            joining._start_local({"num_cpus": 1})


def test_another_error_of_ray_is_raised_as_it_is(monkeypatch):
    def init(**settings):
        raise ValueError("no such setting")

    monkeypatch.setattr(ray, "init", init)
    with pytest.raises(ValueError, match="no such setting"):
        joining._start_local({})


def test_what_a_callback_raises_comes_out_of_tune_as_it_is():
    class Tuner:
        def fit(self):
            try:
                raise ClusterError("the reason")
            except ClusterError:
                raise TuneError("Traceback ...")  # noqa: B904

    with pytest.raises(ClusterError, match="the reason"):
        joining.fit(Tuner())
