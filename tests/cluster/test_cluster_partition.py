"""Two machines of a cluster that cannot reach each other, for a while and for good."""

import contextlib
import time

import pytest

from tests.support.clusters import RATES, slow_workers
from tests.support.faults import FINE, TRAIN, check_complete
from tests.support.machines import lose_packets, two_machines

pytestmark = pytest.mark.cluster


@contextlib.contextmanager
def both_at_work(folder):
    """A training and a sweep whose work is on the second machine, when the first begins to compute too."""
    slow = {"PYTHONPATH": slow_workers(folder)}
    with two_machines() as machines:
        first, second = machines
        first.head(cpus=0)
        first.wait_for_nodes(1)
        second.join(first, cpus=2, **slow)
        first.wait_for_nodes(2)
        stored = f"cluster.storage={folder / 'shared'}"
        training = first.launch(folder / "training", *TRAIN, *FINE, "train.env_steps=12800", stored)
        training.wait(lambda: training.steps() >= 256)
        sweep = first.launch(folder / "sweep", *RATES, f"cluster.storage={folder / 'shared'}")
        sweep.wait(sweep.kept)
        first.join(first, cpus=2, **slow)
        first.wait_for_nodes(3)
        yield machines, training, sweep


def check_sweep(sweep, undisturbed):
    """It gives what it gives undisturbed on one machine."""
    assert sweep.end() == 0, sweep.said
    assert sweep.kept() == undisturbed.kept()
    for name in ("episodes.csv", "table.md"):
        assert (sweep.run / "study" / name).read_bytes() == (undisturbed.run / "study" / name).read_bytes()


def test_a_network_that_is_down_for_seconds_ends_nothing(tmp_path, undisturbed):
    with both_at_work(tmp_path) as ((_, second), training, sweep):
        second.link("down")
        time.sleep(5.0)
        second.link("up")
        check_complete(training)
        assert training.rows()[-1]["perf/trial_restarts"] == 0
        check_sweep(sweep, undisturbed)
        assert "its process ended" not in sweep.said


def test_what_a_machine_that_nobody_reaches_had_to_do_is_done_again(tmp_path, undisturbed):
    with both_at_work(tmp_path) as (machines, training, sweep):
        lose_packets(machines)
        check_complete(training)
        assert "goes on from its last checkpoint" in training.said
        assert training.rows()[-1]["perf/trial_restarts"] == 1
        check_sweep(sweep, undisturbed)  # whether or not a part of it was under way there
