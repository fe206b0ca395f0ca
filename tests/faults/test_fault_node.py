"""A machine of a cluster that is lost: the others go on with its work."""

import csv

import pytest

from tests.support.clusters import SMALL, on
from tests.support.faults import FINE, SWEEP, TRAIN, check_complete, launch, outcome

pytestmark = pytest.mark.faults
SLOW = """
import time
whole = roll_out
def roll_out(*given):
    time.sleep(2.0)
    return whole(*given)
"""


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


def test_a_sweep_that_loses_a_machine_evaluates_every_task_once(tmp_path, cluster):
    nodes = [cluster.add_node(num_cpus=1, object_store_memory=SMALL["object_store_memory"]) for _ in "ab"]
    axis = "+sweep.axes.sparsity={faults.sparsity:[0.0,0.25,0.5,0.75]}"
    words = (*SWEEP, "~sweep.axes", axis, "sweep.policies=[straight,oracle]")
    # Workers of a cluster are no children of the launcher: their machine hands them its environment.
    job = launch(tmp_path, *words, *on(cluster), after={"jobs.rollout.executors": SLOW})
    job.wait(lambda: len(job.kept()) >= 1)
    cluster.remove_node(nodes[0], allow_graceful=False)
    assert job.end() == 0, job.said
    with (job.run / "sweep" / "episodes.csv").open() as file:
        rows = [tuple(row.values()) for row in csv.DictReader(file)]
    assert len(rows) == len(set(rows)) == (4 + 1) * 2 * 2
    assert sum(len(rows) for rows in job.kept().values()) == 4 * 2 * 2
    assert (job.run / "stages" / "sweep.json").is_file()
    outcome("node lost, sweep", "its task is evaluated again elsewhere", "episodes under way")
