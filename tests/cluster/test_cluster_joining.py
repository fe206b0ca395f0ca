"""A cluster that does not fit the command: refused with the reason and the remedy, in one message."""

import shutil

import pytest

from tests.support.faults import ROOT, SWEEP
from tests.support.machines import two_machines

pytestmark = pytest.mark.cluster
WORDS = (*SWEEP, "~study.axes", "+study.axes.sparsity={faults.sparsity:[0.0]}", "study.policies=[straight]")
HASTY = {"RAY_NUM_REDIS_GET_RETRIES": "1"}  # Ray would try 20 s long


def refusal(job):
    """What the launcher says of a value that it refuses."""
    assert job.end() == 2, job.said
    assert "Traceback" not in job.said
    return job.said.rpartition("evade: refused: ")[2].strip()


def test_a_token_that_is_not_the_clusters_is_refused(tmp_path):
    with two_machines() as (first, second):
        first.head()
        first.wait_for_nodes(1)
        for number, given in enumerate(({"RAY_AUTH_TOKEN": "1" * 64}, {"RAY_AUTH_MODE": "disabled"})):
            said = refusal(first.launch(tmp_path / str(number), *WORDS, **given, **HASTY))
            assert "cluster.address: cannot join '10.77.0.1:6379': it asks for another token" in said
            assert "RAY_AUTH_TOKEN_PATH" in said
        assert second.join(first, RAY_AUTH_TOKEN="1" * 64, **HASTY).wait(300) == 1
        assert "InvalidAuthToken" in (second.folder / "ray.log").read_text()


def test_a_cluster_of_another_ray_is_refused(tmp_path):
    with two_machines() as (first, second):
        (hook := first.folder / "hook").mkdir()
        (hook / "sitecustomize.py").write_text("import ray\nray.__version__ = '2.59.0'\n")
        first.head(PYTHONPATH=str(hook))
        said = refusal(first.launch(tmp_path, *WORDS))
        assert "Version mismatch: The cluster was started with: Ray: 2.59.0 Python:" in said
        assert "install the same packages on every machine" in said
        assert second.join(first).wait(300) == 1
        assert "Version mismatch" in (second.folder / "ray.log").read_text()


def test_a_machine_with_another_version_of_this_package_is_refused(tmp_path):
    other = shutil.copytree(ROOT / "jobs", tmp_path / "jobs")
    (other / "pipeline.py").open("a").write("\n")
    with two_machines() as (first, second):
        first.head()
        first.wait_for_nodes(1)
        # The same folder holds other files there, as in a clone of another commit.
        second.join(first, before=f"mount --bind {other} {ROOT / 'jobs'}")
        first.wait_for_nodes(2)
        said = refusal(first.launch(tmp_path, *WORDS))
        assert said.startswith("cluster.address: 10.77.0.2 must have the code and packages of this machine")
        assert said.count("\n") == 0
        assert "got evade " in said
