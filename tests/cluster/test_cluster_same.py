"""The same command on one machine and on a Ray cluster: the same episodes."""

import pytest

from tests.support.clusters import SMALL, on
from tests.support.faults import SWEEP, launch

pytestmark = pytest.mark.cluster
AXIS = "+study.axes.sparsity={faults.sparsity:[0.0,0.5]}"
WORDS = (*SWEEP, "~study.axes", AXIS, "study.policies=[straight,random]")


def test_a_sweep_on_a_cluster_gives_the_bytes_of_a_sweep_on_one_machine(tmp_path, cluster):
    for _ in range(2):
        cluster.add_node(num_cpus=1, object_store_memory=SMALL["object_store_memory"])
    far = launch(tmp_path / "far", *WORDS, *on(cluster), f"cluster.storage={tmp_path / 'shared'}")
    assert far.end() == 0, far.said
    near = launch(tmp_path / "near", *WORDS)
    assert near.end() == 0, near.said
    assert near.run.name == far.run.name
    assert near.kept() == far.kept()
    for name in ("episodes.csv", "table.md"):
        assert (near.run / "study" / name).read_bytes() == (far.run / "study" / name).read_bytes()
