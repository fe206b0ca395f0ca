"""Faults of the tracking store beside a training: its curves arrive, late."""

import pytest

from jobs.tracking.tracker import open_store
from tests.soak.dashboard import Dashboard
from tests.support.faults import TRAIN, launch, outcome, start

pytestmark = pytest.mark.faults


@pytest.fixture
def server(tmp_path):
    server = Dashboard(tmp_path / "server")
    server.start()
    server.wait()
    yield server
    server.kill()


def test_a_server_that_goes_away_holds_up_no_training_and_gets_every_point_when_it_is_back(tmp_path, server):
    job = launch(tmp_path, *TRAIN, "train.env_steps=6400", f"tracking.uri={server.uri}")
    job.wait(lambda: job.steps() >= 128)
    server.kill()
    job.wait(lambda: list(job.run.glob("undelivered-*.jsonl")))
    before = job.steps()
    job.wait(lambda: job.steps() >= before + 640)
    server.start()
    tries = 1
    while job.end() != 0:  # slower to come back than two minutes after the end of the training
        assert "does not answer" in job.said
        server.wait()
        job, tries = start(tmp_path, job.printed_command()), tries + 1
        assert tries < 4
    assert "results wait in" in min(tmp_path.glob("log-*")).read_text()
    assert not list(job.run.glob("undelivered-*.jsonl"))
    client, experiment = open_store(server.uri, "evade")
    (run,) = client.search_runs([experiment])
    assert run.info.status == "FINISHED"
    points = client.get_metric_history(run.info.run_id, "train/entropy")
    assert [point.step for point in points] == [row["env_steps"] for row in job.rows()]
    outcome("MLflow server away", "training goes on; every point is delivered when it is back", "nothing")
