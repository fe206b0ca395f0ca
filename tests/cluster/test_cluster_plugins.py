"""A plug-in on a Ray cluster: its machines get it from Ray, and the episodes are those of one machine."""

import re
from pathlib import Path

import pytest

from tests.support.clusters import SMALL, on
from tests.support.faults import SWEEP, launch

pytestmark = pytest.mark.cluster
PAGE = Path(__file__).resolve().parents[2] / "docs" / "extend.md"
AXES = "+study.axes={spot: {faults.added.blind_spot: [0.0, 0.5]}, world: {env.scene: [forest]}}"
WORDS = (*SWEEP, "~study.axes", AXES, "study.policies=[bytestream-s0,straight]")


def test_a_plug_in_is_shipped_to_every_machine_of_a_cluster(tmp_path, cluster):
    for _ in range(2):
        cluster.add_node(num_cpus=1, object_store_memory=SMALL["object_store_memory"])
    file = tmp_path / "forest.py"
    file.write_text(re.search(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)[1])
    words = (*WORDS, f"plugins=[{file}]")
    far = launch(tmp_path / "far", *words, *on(cluster), f"cluster.storage={tmp_path / 'shared'}")
    assert far.end() == 0, far.said
    near = launch(tmp_path / "near", *words)
    assert near.end() == 0, near.said
    assert near.kept() == far.kept()
    assert len(near.kept()) == 6
