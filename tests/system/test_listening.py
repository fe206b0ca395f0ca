"""Nothing that a user starts can be reached from another machine: every socket is counted while it runs.

A training's are counted in tests/jobs/training/test_train.py, a sweep's in tests/system/test_pipeline.py.
"""

import os
import shlex
import socket
import subprocess
import sys
import time
import urllib.request

import pytest

from tests.support.patience import HANG_S
from tests.support.sockets import beyond_loopback, listening
from tests.support.started import ROOT, said, started

pytestmark = pytest.mark.system


def test_the_dashboard_listens_on_loopback_alone(tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    # The last of an option counts: a port and a store of its own.
    words = f"ARGS=--port {port} --backend-store-uri sqlite:///{tmp_path}/mlflow.db"
    recipe = said("make", "--no-print-directory", "--dry-run", "mlflow", words)
    command = shlex.split("MLFLOW_SERVER" + recipe.replace("\\\n", "").rpartition("\nMLFLOW_SERVER")[2])
    with subprocess.Popen(["env", *command], cwd=ROOT) as server:
        try:
            wait_for(f"http://127.0.0.1:{port}/health", server)
            found = listening(server.pid)
        finally:
            server.terminate()
    assert port in {entry[2] for entry in found}
    assert beyond_loopback(found) == []


# Serves until its standard input ends; the first line it prints is the address.
SIMULATED = """
import sys
from pathlib import Path
import ray
from benchmarks.scaling import ask_for_token, simulated
ask_for_token(Path(sys.argv[1]))
with simulated(nodes=2, cores=1):
    print(ray.get_runtime_context().gcs_address, flush=True)
    sys.stdin.read()
"""
STRANGER = "import sys; from ray._raylet import GcsClient; GcsClient(address=sys.argv[1])"


@pytest.mark.slow
def test_the_simulated_cluster_of_a_bench_listens_on_loopback_alone_and_asks_for_a_token(
    tmp_path, monkeypatch
):
    for name in [name for name in os.environ if name.startswith("RAY_AUTH")]:
        monkeypatch.delenv(name)
    command = [sys.executable, "-c", SIMULATED, str(tmp_path)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, cwd=ROOT, **pipes) as cluster:
        address = cluster.stdout.readline().strip()
        found = listening(cluster.pid)
        stranger = started(sys.executable, "-c", STRANGER, address, RAY_AUTH_MODE="disabled")
        cluster.stdin.close()
        assert cluster.wait(HANG_S) == 0
    assert {"gcs_server", "raylet"} <= {name for name, _, _ in found}, found
    assert beyond_loopback(found) == []
    assert "InvalidAuthToken" in stranger.stderr


def wait_for(address: str, server: subprocess.Popen) -> None:
    """Until a server answers."""
    deadline = time.monotonic() + HANG_S
    while True:
        assert server.poll() is None
        try:
            assert urllib.request.urlopen(address, timeout=HANG_S).status == 200
            return
        except OSError:
            assert time.monotonic() < deadline
            time.sleep(0.2)
