import numpy as np
import onnxruntime
import pytest
import torch
from ray.rllib.core.columns import Columns

from models.policy import load_policy, save_policy
from models.policy.networks import build_networks
from models.policy.onnx import export_onnx
from models.policy.recurrent import GatedUnit
from models.policy.rllib_module import STATE, module_spec
from tests.support.policies import ABOUT, SIDE, make_spec

NAME = "event_columns_gru"


def test_the_unit_is_that_of_torch():
    torch.manual_seed(0)
    unit, theirs = GatedUnit(6, 5), torch.nn.GRU(6, 5, batch_first=True)
    for own, name in ((unit.inward, "ih"), (unit.inner, "hh")):
        own.weight.data.copy_(getattr(theirs, f"weight_{name}_l0"))
        own.bias.data.copy_(getattr(theirs, f"bias_{name}_l0"))
    stacks, state = torch.randn(3, 7, 6), torch.randn(3, 5)
    expected, last = theirs(stacks, state[None])
    states, found = unit(stacks[:, :, None], state)
    torch.testing.assert_close(states, expected, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(found, last[0], rtol=1e-5, atol=1e-6)


def test_rllibs_forward_passes_over_a_sequence_and_over_its_steps_agree():
    module = module_spec(make_spec(NAME), seed=3).build()
    assert module.is_stateful()
    torch.manual_seed(0)
    shown = torch.randn(2, 9, *module.observation_space.shape)
    state = {STATE: torch.stack([module.get_initial_state()[STATE]] * 2)}
    whole = module._forward_train({Columns.OBS: shown, Columns.STATE_IN: state})
    values = module.compute_values({Columns.OBS: shown, Columns.STATE_IN: state})
    assert values.shape == (2, 9)
    torch.testing.assert_close(values, module.compute_values({}, embeddings=whole[Columns.EMBEDDINGS]))
    for step in range(9):
        out = module._forward({Columns.OBS: shown[:, step : step + 1], Columns.STATE_IN: state})
        state = out[Columns.STATE_OUT]
        logits = out[Columns.ACTION_DIST_INPUTS][:, 0]
        torch.testing.assert_close(logits, whole[Columns.ACTION_DIST_INPUTS][:, step], rtol=1e-5, atol=1e-6)


@pytest.mark.system
def test_the_onnx_file_gives_the_logits_of_the_policy_over_episodes(tmp_path):
    spec = make_spec(NAME, own_actions=True, own_velocity=True)
    policy = load_policy(save_policy(tmp_path / "policy", build_networks(spec, seed=3), spec, ABOUT))
    file = export_onnx(policy, tmp_path / "policy.onnx")
    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    stack, state = np.zeros(policy.stack_shape, np.float32), np.ones(16, np.float32)
    rng, action = np.random.default_rng(0), np.array(0)
    for step in range(8):
        if step in (0, 5):
            policy.reset(1)
        policy.velocity_mps = rng.uniform(-5.0, 15.0, (1, 2)).astype("f4")
        events = rng.integers(0, SIDE, (20, 4))
        events[:, 0], events[:, 3] = np.sort(rng.integers(1, 5000, 20)), rng.choice([-1, 1], 20)
        expected = policy.event_logits(events, 0, 5000)
        shown = {"events": events.astype(np.int64), "window_us": np.array(5000)}
        shown |= {"last_stack": stack, "first": np.array(step in (0, 5)), "last_state": state}
        shown |= {"last_action": action, "velocity_mps": policy.velocity_mps[0]}
        logits, stack, taken, state, _ = session.run(None, shown)
        np.testing.assert_allclose(logits, expected, rtol=1e-4, atol=1e-4)
        assert taken == logits.argmax()
        action = np.array(2 - logits.argmax())  # not the likeliest, as if it were drawn
        policy.taken = np.array([int(action)])
