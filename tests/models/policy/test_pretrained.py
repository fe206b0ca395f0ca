import json
from pathlib import Path

import numpy as np
import pytest

from models.kinds import KINDS
from models.policy import load_policy
from tests.support.policies import RECURRENT

PRETRAINED = Path(__file__).resolve().parents[3] / "models" / "pretrained"
FOLDERS = sorted(path.parent for path in PRETRAINED.glob("*/policy.json"))


def test_policies_of_every_kind_are_shipped():
    names = {json.loads((folder / "policy.json").read_text())["name"] for folder in FOLDERS}
    assert names == set(KINDS) - set(RECURRENT)


EMPTY = {
    "window": np.zeros((1, 4096, 4), np.int32),
    "event_image": np.zeros((1, 64, 64), np.uint8),
    "luminance": np.zeros((1, 64, 64), np.float32),
}


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_a_shipped_policy_loads_and_gives_finite_logits(folder):
    policy = load_policy(folder)
    logits = policy.logits(EMPTY[policy.observation])
    assert logits.shape == (1, policy.spec.num_actions)
    assert np.all(np.isfinite(logits))
