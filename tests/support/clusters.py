"""A Ray cluster on this machine for tests, and work for it."""

from pathlib import Path

import pytest

from tests.support.faults import HOOK, SWEEP

TOKEN = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "0" * 64}
SMALL = {"object_store_memory": 100 * 2**20, "include_dashboard": False}
# Twelve parts, of two episodes each.
AXIS = "+study.axes.rate={env.control_hz:[40,50,80,100,160,200]}"
RATES = (*SWEEP, "~study.axes", AXIS, "study.policies=[straight,oracle]")
SLOW = """
import time
whole = roll_out_together
def roll_out_together(*given):
    time.sleep(4.0)
    return whole(*given)
"""


def slow_workers(folder: Path) -> str:
    """The PYTHONPATH of a node whose workers take their time for each part of a sweep."""
    (folder / "slow").mkdir()
    hook = HOOK.format(after={"jobs.rollout.executors": SLOW}, first="")
    (folder / "slow" / "sitecustomize.py").write_text(hook)
    return str(folder / "slow")


@pytest.fixture
def cluster(monkeypatch):
    """A head that computes nothing, and a machine of one core."""
    for name, value in TOKEN.items():
        monkeypatch.setenv(name, value)
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, **SMALL})
    yield cluster
    cluster.shutdown()


def on(cluster):
    return "cluster=ray", f"cluster.address={cluster.address}"
