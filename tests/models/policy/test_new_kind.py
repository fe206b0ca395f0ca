import sys

import numpy as np
import pytest
import torch

from models.kinds import KINDS, DenseModel, Kind, PolicySpec, read_model
from models.policy import load_policy, save_policy
from models.policy.networks import build_networks
from models.policy.onnx import export_onnx
from tests.support.configs import compose

MODULE = '''
"""The number of events in each half of the image, and a linear network: a kind of its own."""

import numpy as np
from torch import nn

from models.policy.features import of_windows


def halves(batch, spec, encoder):
    place = 2 * batch.window + (batch.x >= spec.width // 2)
    return np.bincount(place, minlength=2 * len(batch)).reshape(-1, 2).astype(np.float32)


HALVES = of_windows(np.float32, lambda spec: (2,), halves)


def linear(shape, spec):
    inputs = shape[0] * shape[1]
    return nn.Flatten(), nn.Linear(inputs, spec.num_actions), nn.Linear(inputs, 1)
'''


@pytest.fixture
def spec(tmp_path, monkeypatch):
    """A policy of a kind that is added here: a row, a module, and the settings of a configuration file."""
    (tmp_path / "halves_kind.py").write_text(MODULE)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setitem(
        KINDS, "halves", Kind("window", "halves_kind:HALVES", "halves_kind:linear", DenseModel)
    )
    yield PolicySpec(read_model(name="halves", stack=2, hidden=[4]), 40, 30, 3)
    sys.modules.pop("halves_kind", None)


def test_a_kind_is_added_by_a_row_and_a_module_and_is_built_saved_loaded_and_acts(spec, tmp_path):
    networks = build_networks(spec, seed=1)
    networks["pi"].weight.data.copy_(torch.eye(3, 4).roll(2, 1))  # towards the half with more events
    about = {"sensor": {"width": 40, "height": 30}, "sensor_hash": "0123456789ab"}
    policy = load_policy(save_policy(tmp_path / "policy", networks, spec, about))
    assert (policy.spec, policy.observation) == (spec, "window")
    rng, stack, actions = np.random.default_rng(0), None, set()
    for step in range(20):
        x = rng.integers(0, 40, int(rng.integers(1, 50)))
        events = {"t": np.arange(len(x)), "x": x, "y": np.zeros_like(x), "p": np.ones_like(x)}
        feature = np.array([(x < 20).sum(), (x >= 20).sum()], np.float32)
        stack = np.stack([stack[1], feature]) if step else np.stack([feature, feature])
        with torch.no_grad():
            expected = networks["pi"](torch.from_numpy(stack.reshape(1, -1))).numpy()[0]
        actions.add(action := policy.act(events, 0, 5000))
        assert action == expected.argmax()
    assert len(actions) > 1


def test_a_kind_without_an_onnx_form_says_so(spec, tmp_path):
    policy = load_policy(
        save_policy(tmp_path / "policy", build_networks(spec), spec, {"sensor": {}, "sensor_hash": ""})
    )
    pytest.importorskip("onnx")
    with pytest.raises(ValueError, match="halves has no ONNX form"):
        export_onnx(policy, tmp_path / "policy.onnx")


def test_a_kind_has_a_configuration_file_of_its_settings():
    for name in ("event_columns", "event_image", "event_set", "rgb"):
        assert read_model(**compose("+exp=train", f"model={name}")["model"]).name == name
