import numpy as np
import pytest

from benchmarks.latency import load, random_events, random_policy
from models.kinds import KINDS
from models.policy.onnx import export_onnx
from tests.support.policies import kinds

FROM_EVENTS = [name for name, kind in KINDS.items() if kind.observation != "luminance"]


@pytest.mark.parametrize("name", kinds(FROM_EVENTS, quick=("bytestream", "event_image")))
def test_the_policies_that_are_timed_have_the_default_sizes_and_choose_from_any_number_of_events(name):
    policy = random_policy(name)
    for size in (0, 300):
        logits = policy.event_logits(random_events(size), 0, 5000)
        assert logits.shape == (3,)
        assert np.isfinite(logits).all()


@pytest.mark.slow
def test_a_timed_policy_can_be_exported_and_opened(tmp_path):
    session = load(export_onnx(random_policy("event_columns"), tmp_path / "policy.onnx"))
    assert {value.name for value in session.get_inputs()} >= {"events", "window_us", "last_stack"}
