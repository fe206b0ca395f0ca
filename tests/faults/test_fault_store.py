"""Faults of the tracking store beside a training: its curves arrive, late."""

import os
import socket
import subprocess
import sys
import time
import urllib.request

import pytest

from jobs.tracking.tracker import open_store
from tests.support.faults import DEADLINE_S, TRAIN, launch, outcome, start

pytestmark = pytest.mark.faults
LEAN = {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false", "MLFLOW_DISABLE_TELEMETRY": "true"}


class Server:
    """MLflow's server, which can be ended and started again."""

    def __init__(self, folder):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.folder, self.uri = folder, f"http://127.0.0.1:{self.port}"

    def start(self):
        store = f"sqlite:///{self.folder}/server.db"
        words = ["server", "--workers", "1", "--host", "127.0.0.1", "--port", str(self.port)]
        command = [sys.executable, "-m", "mlflow", *words, "--backend-store-uri", store]
        with (self.folder / "server.log").open("a") as log:
            self.process = subprocess.Popen(
                command, env={**os.environ, **LEAN}, cwd=self.folder, stdout=log, stderr=log, process_group=0
            )

    def wait(self):
        deadline = time.monotonic() + DEADLINE_S
        while True:
            try:
                urllib.request.urlopen(f"{self.uri}/health", timeout=5)
            except OSError:
                assert time.monotonic() < deadline, (self.folder / "server.log").read_text()
                time.sleep(0.2)
            else:
                return

    def end(self):
        os.killpg(self.process.pid, 9)
        self.process.wait()


@pytest.fixture
def server(tmp_path):
    server = Server(tmp_path)
    server.start()
    server.wait()
    yield server
    server.end()


def test_a_server_that_goes_away_holds_up_no_training_and_gets_every_point_when_it_is_back(tmp_path, server):
    job = launch(tmp_path, *TRAIN, "train.env_steps=6400", f"tracking.uri={server.uri}")
    job.wait(lambda: job.steps() >= 128)
    server.end()
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
    assert (
        "results wait in" in (tmp_path / sorted(path.name for path in tmp_path.glob("log-*"))[0]).read_text()
    )
    assert not list(job.run.glob("undelivered-*.jsonl"))
    client, experiment = open_store(server.uri, "evade")
    (run,) = client.search_runs([experiment])
    assert run.info.status == "FINISHED"
    points = client.get_metric_history(run.info.run_id, "train/entropy")
    assert [point.step for point in points] == [row["env_steps"] for row in job.rows()]
    outcome("MLflow server away", "training goes on; every point is delivered when it is back", "nothing")
