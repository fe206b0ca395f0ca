import subprocess
import sys

import numpy as np
import pytest
import torch

from models.encoder.evae import EventVAE
from models.policy import load_policy, save_policy
from models.policy import onnx as export
from models.policy.features import Step
from models.policy.networks import build_networks
from models.policy.onnx import export_onnx
from tests.support.encoders import EVENT, make_events
from tests.support.patience import HANG_S
from tests.support.policies import ABOUT, SIDE, TRAINED, kinds, make_networks, make_spec, save

onnxruntime = pytest.importorskip("onnxruntime", reason="needs the extra onnx")
COMMANDS = [[-0.25, 1.0], [0.0, 1.0], [0.25, 1.0]]
VELOCITY = np.array([-3.0, 12.0], np.float32)
EDGES = [(1, 0, 0, 1), (5000, SIDE - 1, SIDE - 1, -1), (4999, SIDE - 1, 0, 1), (5000, 0, SIDE - 1, -1)]


def steps():
    """Events of the steps of a flight: none, one, a few, many, twice in a pixel, at the edges."""
    counts = (0, 1, 40, 700, 1500, 0, 3)
    yield from (make_events(count, seed, width=SIDE, height=SIDE) for seed, count in enumerate(counts))
    many = make_events(500, len(counts), width=SIDE, height=SIDE)
    many["x"], many["y"] = many["x"] % 3, many["y"] % 2
    yield many
    yield np.sort(np.array(EDGES, EVENT), order="t")


def inputs_of(events):
    """What the exported file takes of the events of a step."""
    rows = np.stack([events[name].astype(np.int64) for name in "txyp"], axis=1)
    return {"events": rows, "window_us": np.array(5000)}


def opened(file):
    return onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])


def stack_type(policy):
    """Of the file's stack: no operator of ONNX takes int16."""
    return policy._stacks.dtype if policy._stacks.dtype != np.int16 else np.int32


def fly_exported(file, shown, shape, dtype):
    """Logits of each step of one flight, by onnxruntime alone."""
    session = opened(file)
    memory, first, logits = {"last_stack": np.full(shape, 7, dtype)}, np.array(True), []
    memory |= {
        one.name: np.ones(one.shape, np.float32 if "state" in one.name else np.int64)
        for one in session.get_inputs()
        if one.name in ("last_state", "last_action")
    }
    told = {"velocity_mps": VELOCITY} if "velocity_mps" in {one.name for one in session.get_inputs()} else {}
    names = [one.name for one in session.get_outputs()]
    for inputs in shown:
        out = dict(zip(names, session.run(None, {**inputs, **told, **memory, "first": first}), strict=True))
        memory, first = {name: out[name.replace("last", "next")] for name in memory}, np.array(False)
        assert out["dropped"] == 0
        assert "command" not in out or out["command"].tolist() == COMMANDS[out["logits"].argmax()]
        logits.append(out["logits"])
    return np.array(logits)


@pytest.fixture(
    scope="module",
    params=kinds([*TRAINED, "bytestream_xy", "eventnet", "ranked", "memory", "own", "bands"]),
)
def folder(request, tmp_path_factory):
    path, name = tmp_path_factory.mktemp("policy") / "policy", request.param
    if name in ("memory", "own", "bands"):
        own = {"own_actions": name == "own", "own_velocity": name == "own"}
        own["bands"] = [2, 5, SIDE - 3] if name == "bands" else []
        spec = make_spec("event_columns", memory_ms=[10.0, 30.0, 300.0], **own)
        return save_policy(path, build_networks(spec, seed=3), spec, {**ABOUT, "commands": COMMANDS})
    changes = {
        "bytestream_xy": {"variant": "bytestream_xy"},
        "eventnet": {"coding": "eventnet"},
        "ranked": {"pool_rank": 3, "octaves": 2},
    }.get(name)
    if changes is None:
        return save(path, name)
    torch.manual_seed(0)
    evae = EventVAE(width=SIDE, height=SIDE, context=64, time_bins=32, **changes).freeze()
    for parameter in evae.ecn.layers.parameters():  # so that magnitudes outlive many ages
        parameter.data.mul_(3.0)
    name, keys = evae.settings.variant, ("coding", "pool_rank", "octaves")
    own = {key: getattr(evae.settings, key) for key in keys}
    return save_policy(path, make_networks(name), make_spec(name, **own), ABOUT, evae)


@pytest.mark.system
def test_the_file_gives_the_logits_of_the_policy_on_every_step_of_an_episode(folder, tmp_path):
    policy = load_policy(folder)
    file = export_onnx(policy, tmp_path / "policy.onnx")
    given = [one.name for one in opened(file).get_outputs()]
    assert ("command" in given) == (policy.commands is not None)
    feature, policy.velocity_mps = policy.feature, VELOCITY[None]
    if feature.from_events is None:
        rng = np.random.default_rng(0)
        pictures = rng.uniform(-0.2, 1.4, (6, SIDE, SIDE)).astype(np.float32)
        expected = np.array([policy.logits(picture[None])[0] for picture in pictures])
        shown = [{"luminance": picture} for picture in pictures]
    else:
        expected, shown = [], []
        for events in steps():
            made = feature.from_events(Step(events, 0, 5000), policy.spec, policy.encoder)
            expected.append(policy._logits(made[None], 5000, None)[0])
            shown.append(inputs_of(events))
    found = fly_exported(file, shown, policy._stacks.shape[1:], stack_type(policy))
    scale = np.abs(expected).max()
    assert np.abs(found - np.array(expected)).max() < 1e-5 * scale
    assert np.ptp(np.array(expected), axis=0).max() > 0.01 * scale


REFUSED = [
    *([10, -1, 3, 1], [10, SIDE, 3, 1], [10, 3, -1, -1], [10, 3, SIDE, 1]),  # left, right, above, below
    *([10, 3, 3, 0], [-1, 3, 3, 1], [5001, 3, 3, 1]),  # no polarity, before, after
]


@pytest.mark.system
@pytest.mark.parametrize("name", ["bytestream", "event_image"])
def test_what_the_policy_refuses_is_left_out_and_counted(name, tmp_path):
    policy = load_policy(save(tmp_path / "policy", name))
    session = opened(export_onnx(policy, tmp_path / "policy.onnx"))
    own = {"last_stack": np.zeros(policy.stack_shape, stack_type(policy)), "first": np.array(True)}

    def run(rows, window_us=5000):
        events = np.array(rows, np.int64).reshape(-1, 4)
        return session.run(["logits", "dropped"], {"events": events, "window_us": np.array(window_us), **own})

    good = [[5, 1, 2, 1], [9, 7, 3, -1], [20, 7, 4, 1]]
    expected, none = run(good)
    assert none == 0
    for rows in REFUSED:
        with pytest.raises(ValueError, match=r"has [xp]=|within their control step"):
            policy.event_logits(dict(zip("txyp", np.array([rows]).T, strict=True)), 0, 5000)
        logits, dropped = run(sorted([rows, *good]))
        assert dropped == 1
        np.testing.assert_array_equal(logits, expected)
    logits, dropped = run(sorted(REFUSED))
    assert dropped == len(REFUSED)
    np.testing.assert_array_equal(logits, run([])[0])
    assert run(good, window_us=0)[1] == len(good)
    assert run(good[::-1])[1] == len(good)
    with pytest.raises(ValueError, match="must be in time order"):
        policy.event_logits(np.array(good[::-1]), 0, 5000)


@pytest.mark.system
@pytest.mark.parametrize("support", [1, 3])
def test_the_file_filters_the_events_of_each_step_as_the_policy_does(support, tmp_path):
    spec = make_spec("event_columns")
    about = {**ABOUT, "sensor": {**ABOUT["sensor"], "filter_support": support, "filter_tau_us": 4000}}
    policy = load_policy(save_policy(tmp_path / "policy", build_networks(spec, seed=3), spec, about))
    session = opened(export_onnx(policy, tmp_path / "policy.onnx"))
    stack, first = np.zeros(policy.stack_shape, np.float32), np.array(True)
    last_us, start_us = np.zeros((SIDE + 2, SIDE + 2), np.int64), 0
    for events in steps():
        own = {"last_stack": stack, "first": first, "last_us": last_us}
        logits, stack, last_us, _ = session.run(None, inputs_of(events) | own)
        events["t"] += start_us
        expected = policy.event_logits(events, start_us, 5000)
        np.testing.assert_allclose(logits, expected, rtol=1e-4, atol=1e-5)
        first, start_us = np.array(False), start_us + 5000
    whole = load_policy(tmp_path / "policy", rng=None)
    whole.manifest["sensor"]["filter_support"] = 0
    whole.reset()
    assert np.abs(whole.event_logits(events, start_us - 5000, 5000) - expected).max() > 1e-3


@pytest.mark.system
def test_the_rest_of_the_package_does_without_onnx():
    code = "import models.policy.policy, models.policy.onnx, sys; sys.exit('onnx' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=HANG_S).returncode == 0


def test_what_is_not_installed_is_named(tmp_path, monkeypatch):
    policy = load_policy(save(tmp_path / "policy", "event_columns"))
    monkeypatch.setattr(export.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r"onnx, onnxscript: pip install 'evade\[onnx\]'"):
        export_onnx(policy, tmp_path / "policy.onnx")
    assert not (tmp_path / "policy.onnx").exists()
