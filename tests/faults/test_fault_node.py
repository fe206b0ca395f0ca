"""A machine of a cluster that is lost: the others go on with its work."""

import pytest

from tests.support.clusters import SMALL, on
from tests.support.faults import (
    FINE,
    SEEING,
    TRAIN,
    check_complete,
    check_once,
    launch,
    noting,
    outcome,
    write_hook,
)

pytestmark = pytest.mark.faults


def test_a_training_whose_machine_is_lost_goes_on_elsewhere_from_its_checkpoint(tmp_path, cluster):
    first = cluster.add_node(num_cpus=1, object_store_memory=SMALL["object_store_memory"])
    # Long enough to be still at work when the other machine has joined.
    length = "train.env_steps=6400"
    job = launch(tmp_path, *TRAIN, *FINE, length, *on(cluster), f"cluster.storage={tmp_path / 'shared'}")
    job.wait(lambda: job.steps() >= 256)
    cluster.add_node(num_cpus=1, object_store_memory=SMALL["object_store_memory"])
    cluster.remove_node(first, allow_graceful=False)
    check_complete(job)
    assert "goes on from its last checkpoint" in job.said
    assert job.rows()[-1]["perf/trial_restarts"] == 1
    assert list((tmp_path / "shared").glob("*/train/PPO*/checkpoint_*"))
    outcome("node lost, training", "goes on elsewhere (restarts in results: 1)", "steps since a checkpoint")


def test_a_sweep_that_loses_a_machine_evaluates_every_task_once(tmp_path, cluster, monkeypatch):
    # Workers of a cluster are no children of the launcher: their machine hands them its environment.
    monkeypatch.setenv("PYTHONPATH", write_hook(tmp_path, after=noting(tmp_path)))
    nodes = [cluster.add_node(num_cpus=1, object_store_memory=SMALL["object_store_memory"]) for _ in "ab"]
    job = launch(tmp_path, *SEEING, *on(cluster), after=noting(tmp_path))
    job.wait(lambda: len(job.kept()) >= 1)
    cluster.remove_node(nodes[0], allow_graceful=False)
    check_once(job, tmp_path, again_at_most=2)
    assert (job.run / "stages" / "study.json").is_file()
    outcome("node lost, sweep", "its task is evaluated again elsewhere", "episodes under way")
