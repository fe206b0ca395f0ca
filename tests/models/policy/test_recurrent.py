import copy
import pickle

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
from tests.support.policies import ABOUT, SIDE, make_spec, make_windows, save

NAME = "event_columns_gru"


@pytest.fixture
def policy(tmp_path):
    return load_policy(save(tmp_path / "policy", NAME))


@pytest.fixture(scope="module")
def module():
    return module_spec(make_spec(NAME), seed=3).build()


def test_a_sequence_gives_what_its_steps_give():
    torch.manual_seed(0)
    unit, stacks, state = GatedUnit(6, 5), torch.randn(3, 7, 2, 3), torch.randn(3, 5)
    states, last = unit(stacks, state)
    for step in range(7):
        _, state = unit(stacks[:, step : step + 1], state)
        torch.testing.assert_close(states[:, step], state, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(last, state, rtol=1e-6, atol=1e-6)


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


def test_the_policy_acts_by_the_state_of_its_own_episode_alone(policy):
    windows = [make_windows(np.random.default_rng(k), 3, side=SIDE) for k in range(6)]
    policy.reset(3)
    together = [
        policy.logits(shown, np.array([False, step == 4, False])) for step, shown in enumerate(windows)
    ]
    for row, begins in ((0, 0), (1, 4), (2, 0)):
        policy.reset(1)
        for step, shown in enumerate(windows[begins:], begins):
            alone = policy.logits(shown[row : row + 1])[0]
            np.testing.assert_allclose(alone, together[step][row], rtol=1e-5, atol=1e-5)
    policy.reset(1)
    forgetful = policy.logits(windows[-1][:1])[0]
    assert np.abs(forgetful - together[-1][0]).max() > 1e-3


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda policy: pickle.loads(pickle.dumps(policy))])
def test_a_copy_in_mid_episode_continues_as_the_original(policy, duplicate):
    windows = [make_windows(np.random.default_rng(k), 2, side=SIDE) for k in range(5)]
    policy.reset(2)
    for shown in windows[:3]:
        policy.logits(shown)
    other = duplicate(policy)
    for shown in windows[3:]:
        np.testing.assert_array_equal(other.logits(shown), policy.logits(shown))


def test_episodes_that_stay_keep_their_states(policy):
    windows = [make_windows(np.random.default_rng(k), 3, side=SIDE) for k in range(4)]
    policy.reset(3)
    for shown in windows[:2]:
        policy.logits(shown)
    whole = copy.deepcopy(policy).logits(windows[2])
    policy.keep(np.array([2, 0]))
    np.testing.assert_allclose(policy.logits(windows[2][[2, 0]]), whole[[2, 0]], rtol=1e-5, atol=1e-6)


def test_rllibs_forward_passes_over_a_sequence_and_over_its_steps_agree(module):
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
@pytest.mark.parametrize("own", [False, True], ids=["events", "events, actions and velocity"])
def test_the_onnx_file_gives_the_logits_of_the_policy_over_episodes(own, tmp_path):
    spec = make_spec(NAME, own_actions=own, own_velocity=own)
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
        named = dict(zip("txyp", events.T, strict=True))
        expected = policy.event_logits(named, 0, 5000)
        first = np.array(step in (0, 5))
        shown = {"events": events.astype(np.int64), "window_us": np.array(5000)}
        shown |= {"last_stack": stack, "first": first, "last_state": state}
        shown |= {"last_action": action, "velocity_mps": policy.velocity_mps[0]} if own else {}
        logits, stack, *taken, state, _ = session.run(None, shown)
        np.testing.assert_allclose(logits, expected, rtol=1e-4, atol=1e-4)
        if own:
            action = np.array(2 - logits.argmax())  # not the likeliest, as if it were drawn
            policy.taken = np.array([int(action)])
            assert taken[0] == logits.argmax()
