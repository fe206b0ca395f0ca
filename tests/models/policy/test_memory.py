import numpy as np
import pytest

from models.kinds import KINDS, checked, read_model, read_spec
from models.policy import load_policy, save_policy
from models.policy.memory import kept_shape, remember
from models.policy.networks import build_networks
from tests.support.policies import ABOUT, SIDE, make_evae, make_spec, make_windows

TAUS = [10.0, 30.0, 100.0]


def policy_of(spec, folder, evae=None):
    """Saved and loaded, with logits that differ."""
    networks = build_networks(spec, seed=3)
    *_, last = networks["pi"].modules()
    last.weight.data.mul_(100.0)
    return load_policy(save_policy(folder, networks, spec, ABOUT, evae))


def step_of(window):
    """Events, start and length of a packed window."""
    count, _, window_us, _ = window[0]
    return dict(zip("txyp", window[1 : count + 1].T, strict=True)), 0, window_us


def test_means_are_those_of_the_whole_past():
    rng, spec = np.random.default_rng(0), make_spec("event_columns", memory_ms=TAUS)
    features, window_us = rng.normal(size=(30, 4)).astype("f4"), rng.integers(1000, 40_000, 30)
    kept = np.zeros((1, spec.depth, 4), np.float32)
    for step, feature in enumerate(features):
        first, own_us = np.array([step == 0]), window_us[step : step + 1]
        kept = remember(kept, feature[None], first, spec, own_us, np.zeros(1, int))
    np.testing.assert_array_equal(kept[0, -1], features[-1])
    since_us = window_us.sum() - np.cumsum(window_us)  # since the end of each step
    for mean, tau in zip(kept[0, :-1], TAUS, strict=True):
        weights = np.exp(-since_us / (1e3 * tau)) - np.exp(-(since_us + window_us) / (1e3 * tau))
        weights[0] = np.exp(-since_us[0] / (1e3 * tau))  # what was before the first is like the first
        assert weights.sum() == pytest.approx(1.0)
        np.testing.assert_allclose(mean, weights @ features, rtol=1e-4, atol=1e-5)


def test_an_episode_that_begins_forgets_and_its_neighbours_remember():
    rng, spec = np.random.default_rng(2), make_spec("event_columns", memory_ms=TAUS)
    kept, features = rng.normal(size=(3, 4, 5)).astype("f4"), rng.normal(size=(3, 5)).astype("f4")
    before, first = kept.copy(), np.array([False, True, False])
    after = remember(kept, features, first, spec, 5000, np.zeros(3, int))
    np.testing.assert_array_equal(kept, before)
    np.testing.assert_array_equal(after[1], np.stack([features[1]] * 4))
    alone = remember(kept[2:], features[2:], first[2:], spec, np.array([5000]), np.zeros(1, int))
    np.testing.assert_array_equal(after[2:], alone)
    assert after.dtype == np.float32


def test_a_policy_with_memory_keeps_it_in_its_folder_and_acts_by_the_length_of_its_steps(tmp_path):
    spec = make_spec("bytestream", memory_ms=TAUS)
    policy = policy_of(spec, tmp_path / "policy", make_evae())
    assert policy.spec == spec
    assert policy.stack_shape == (4, 8)
    windows = make_windows(np.random.default_rng(0), 12, side=SIDE)
    shown = []
    for later_us in (20_000, 5000):
        windows[6:, 0, 2] = later_us
        policy.reset()
        shown.append(np.array([policy.logits(window[None])[0] for window in windows]))
        policy.reset()
        for window, expected in zip(windows, shown[-1], strict=True):
            np.testing.assert_array_equal(policy.event_logits(*step_of(window)), expected)
    np.testing.assert_array_equal(shown[0][:6], shown[1][:6])
    assert np.abs(shown[0][6:] - shown[1][6:]).max() > 0.0


def test_a_policy_from_before_has_a_stack():
    values = make_spec("bytestream").manifest()
    del values["memory_ms"]
    assert read_spec(values) == make_spec("bytestream")
    assert read_spec(values).depth == 3


@pytest.mark.parametrize(
    ("name", "value"), [("memory_ms", [10.0]), ("own_actions", True), ("own_velocity", True)]
)
def test_networks_that_read_events_or_pictures_have_no_memory_in_time_and_see_nothing_of_the_vehicle(
    name, value, monkeypatch
):
    with pytest.raises(ValueError, match=rf"{name} must be (\[\]|false) for encoder=finetuned"):
        read_spec(make_spec("finetuned").manifest() | {name: value})
    pictured = KINDS["event_columns"]._replace(feature="models.policy.features:EVENT_IMAGE")
    monkeypatch.setitem(KINDS, "pictured", pictured)
    if value is True:
        with pytest.raises(ValueError, match=f"{name} must be false for pictured"):
            kept_shape(make_spec("pictured", **{name: True}))


def test_a_time_constant_of_nothing_is_refused():
    with pytest.raises(ValueError, match=r"memory_ms\.0: .*greater than 0, got 0\.0"):
        checked(read_model, {"name": "event_columns", "stack": 3, "hidden": [8], "memory_ms": [0.0]})


@pytest.mark.parametrize("memory_ms", [[], TAUS])
def test_own_actions_are_remembered_as_features_are(memory_ms):
    spec = make_spec("event_columns", memory_ms=memory_ms, own_actions=True)
    plain = make_spec("event_columns", memory_ms=memory_ms)
    assert kept_shape(spec) == (spec.depth, 2 * SIDE + 3)
    rng, window_us = np.random.default_rng(4), 5000
    features = rng.normal(size=(9, 2, 2 * SIDE)).astype("f4")
    actions = rng.integers(0, 3, (9, 2))
    kept, alone = (np.zeros((2, *kept_shape(one)), np.float32) for one in (spec, plain))
    told = np.zeros((2, spec.depth, 3), np.float32)  # the actions alone, remembered as features
    for step, feature in enumerate(features):
        first = np.full(2, step == 0)
        kept = remember(kept, feature, first, spec, window_us, actions[step])
        alone = remember(alone, feature, first, plain, window_us, actions[step])
        known = np.eye(3, dtype="f4")[actions[step]] * (step > 0)
        told = remember(told, known, first, plain, window_us, actions[step])
    np.testing.assert_array_equal(kept[..., : 2 * SIDE], alone)
    np.testing.assert_array_equal(kept[..., 2 * SIDE :], told)


def test_a_policy_sees_the_actions_that_were_taken_from_observations_and_from_events(tmp_path):
    spec = make_spec("event_columns_gru", memory_ms=TAUS, own_actions=True)
    policy = policy_of(spec, tmp_path / "policy")
    windows = make_windows(np.random.default_rng(0), 12, side=SIDE)

    def logits(forced=None):
        policy.reset()
        shown = []
        for window in windows:
            shown.append(policy.logits(window[None])[0])
            if forced is not None:
                policy.taken = np.array([forced])
        return np.array(shown)

    own = logits()
    policy.reset()
    assert [policy.act(*step_of(window)) for window in windows] == own.argmax(axis=1).tolist()
    forced = [logits(action) for action in range(3)]
    for one in forced:
        np.testing.assert_array_equal(one[0], own[0])  # nothing was taken before the first
    assert all(np.abs(one[1:] - forced[0][1:]).max() > 0.0 for one in forced[1:])


def test_velocity_is_remembered_in_units_of_ten_metres_a_second_behind_the_actions():
    spec = make_spec("event_columns", memory_ms=TAUS, own_actions=True, own_velocity=True)
    assert kept_shape(spec) == (spec.depth, 2 * SIDE + 3 + 2)
    features, first = np.zeros((2, 2 * SIDE), np.float32), np.ones(2, bool)
    kept, taken = np.zeros((2, *kept_shape(spec)), np.float32), np.zeros(2, int)
    velocity = np.array([[3.0, 10.0], [-3.0, 20.0]])
    kept = remember(kept, features, first, spec, 5000, taken, velocity)
    np.testing.assert_allclose(kept[:, :, -2:], (velocity / 10.0)[:, None].repeat(spec.depth, 1), rtol=1e-6)
    kept = remember(kept, features, ~first, spec, 5000, taken, 0.0 * velocity)
    shares = np.append(np.exp(-5.0 / np.array(TAUS)), 0.0)  # of the mean that outlives the step
    np.testing.assert_allclose(kept[0, :, -1], shares, rtol=1e-6)
    with pytest.raises(ValueError, match=r"reads the vehicle's velocity.*got None"):
        remember(kept, features, first, spec, 5000, taken)


def test_a_policy_reads_the_velocity_that_it_is_told_and_asks_for_it(tmp_path):
    policy = policy_of(make_spec("event_columns", own_velocity=True), tmp_path / "policy")
    window = make_windows(np.random.default_rng(0), 1, side=SIDE)
    shown = []
    for ahead_mps in (10.0, 20.0):
        policy.reset()
        with pytest.raises(
            ValueError, match=r"set policy\.velocity_mps \(B, 2\) before .*got \[\[nan nan\]\]"
        ):
            policy.logits(window)
        policy.velocity_mps = np.array([[0.0, ahead_mps]])
        shown.append(policy.logits(window))
    assert np.abs(shown[0] - shown[1]).max() > 0.0
