"""The head of a cluster is lost: jobs say so and stop, and continue on the next cluster."""

import contextlib
import os
import re
import signal
import socket
from collections.abc import Iterator

import pytest

from tests.support.clusters import RATES, SMALL, TOKEN, on, slow_workers
from tests.support.faults import FINE, TRAIN, check_complete, launch

pytestmark = pytest.mark.cluster
LOST = r"^evade: failed: Ray's head has not answered for 40 s: .* the same command continues$"


@contextlib.contextmanager
def cluster_on(port: int) -> Iterator[object]:
    """A head that computes nothing, and a machine of two cores."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "gcs_server_port": port, **SMALL})
    try:
        cluster.add_node(num_cpus=2, object_store_memory=SMALL["object_store_memory"])
        yield cluster
    finally:
        cluster.shutdown()


def check_stopped(job):
    """It has ended by itself, with one reason."""
    assert job.end() == 1, job.said
    assert len(re.findall(LOST, job.said, re.MULTILINE)) == 1, job.said
    assert "Traceback" not in job.said


def test_jobs_whose_head_is_lost_stop_with_the_reason_and_continue_on_another(
    tmp_path, monkeypatch, undisturbed
):
    for name, value in TOKEN.items():
        monkeypatch.setenv(name, value)
    with socket.socket() as free:
        free.bind(("", 0))
        port = free.getsockname()[1]

    stored = f"cluster.storage={tmp_path / 'shared'}"

    def train(cluster):
        return launch(tmp_path / "training", *TRAIN, *FINE, "train.env_steps=12800", stored, *on(cluster))

    with monkeypatch.context() as slow:
        slow.setenv("PYTHONPATH", slow_workers(tmp_path))
        with cluster_on(port) as cluster:
            address = cluster.address
            training = train(cluster)
            training.wait(lambda: training.steps() >= 256)
            sweep = launch(tmp_path / "sweep", *RATES, *on(cluster))
            sweep.wait(sweep.kept)
            (head,) = cluster.head_node.all_processes["gcs_server"]
            os.kill(head.process.pid, signal.SIGKILL)
            for job in (training, sweep):
                check_stopped(job)
    kept = sweep.kept()
    with cluster_on(port) as cluster:
        assert cluster.address == address  # so the command is the same
        training, sweep = train(cluster), launch(tmp_path / "sweep", *RATES, *on(cluster))
        check_complete(training)
        assert sweep.end() == 0, sweep.said
    assert kept.items() < undisturbed.kept().items()
    assert sweep.kept() == undisturbed.kept()
