"""The same command on one machine and on a cluster, which Ray gives a plug-in: the same bytes."""

import re

import pytest

from tests.support.clusters import SMALL, on
from tests.support.faults import ROOT, SWEEP, launch

pytestmark = pytest.mark.cluster
PAGE = ROOT / "docs" / "extend.md"
AXES = "+study.axes={spot: {faults.added.blind_spot: [0.0, 0.5]}, world: {env.scene: [forest]}}"
WORDS = (*SWEEP, "~study.axes", AXES, "study.policies=[bytestream-s0,straight]")


def test_a_sweep_on_a_cluster_gives_the_bytes_of_a_sweep_on_one_machine(tmp_path, cluster):
    for _ in range(2):
        cluster.add_node(num_cpus=1, object_store_memory=SMALL["object_store_memory"])
    file = tmp_path / "forest.py"
    file.write_text(re.search(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)[1])
    words = (*WORDS, f"plugins=[{file}]")
    far = launch(tmp_path / "far", *words, *on(cluster), f"cluster.storage={tmp_path / 'shared'}")
    assert far.end() == 0, far.said
    near = launch(tmp_path / "near", *words)
    assert near.end() == 0, near.said
    assert near.run.name == far.run.name
    assert near.kept() == far.kept()
    assert len(near.kept()) == 6
    for name in ("episodes.csv", "table.md"):
        assert (near.run / "study" / name).read_bytes() == (far.run / "study" / name).read_bytes()
