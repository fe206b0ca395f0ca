import copy
import dataclasses
import hashlib
import json
import pickle
import subprocess
import sys

import numpy as np
import pandas
import pytest
import torch

from envs.config import CameraConfig, EnvConfig, FaultsConfig, FidelityConfig, sensor_settings
from envs.corridor import CorridorEnv
from models.encoder.frozen import encoder_of
from models.policy import Policy, load_policy, save_policy
from models.policy.features import feature_of
from models.policy.networks import build_networks
from models.policy.policy import ENCODER, MANIFEST
from tests.support.encoders import EVENT
from tests.support.policies import (
    ABOUT,
    RECURRENT,
    SIDE,
    TRAINED,
    make_evae,
    make_networks,
    make_spec,
    make_windows,
    save,
)


def make_observations(name, seed, *shape):
    """What an environment might show, (*shape, ...)."""
    rng, count = np.random.default_rng(seed), int(np.prod(shape))
    if make_spec(name).kind.observation == "window":
        shown = make_windows(rng, count, side=SIDE)
    else:
        shown = rng.choice([0, 0, 0, 125, 255], (count, SIDE, SIDE)).astype(np.uint8)
        shown = shown if name == "event_image" else (shown / 255).astype(np.float32)
    return shown.reshape(*shape, *shown.shape[1:])


def expected_logits(name, flights):
    """Logits after the last of each flight's observations (B, T, ...), by a plain loop."""
    spec, networks = make_spec(name), make_networks(name)
    table = encoder_of(make_evae(variant=name)) if spec.frozen else None
    stacks = []
    for observations in flights:
        features = list(feature_of(spec).from_observations(observations, spec, table))
        padded = features[:1] * 2 + features
        stacks.append(np.stack([np.stack(padded[step : step + 3]) for step in range(len(features))]))
    shown = torch.from_numpy(np.stack(stacks))
    with torch.no_grad():
        if name in RECURRENT:
            _, last = networks["trunk"](shown, torch.zeros(len(shown), spec.model.units))
            return networks["pi"](last).numpy()
        return networks["pi"](networks["trunk"](shown[:, -1])).numpy()


@pytest.mark.parametrize("name", TRAINED)
def test_a_policy_folder_alone_gives_the_logits_of_the_policy_that_was_saved(name, tmp_path):
    policy = load_policy(save(tmp_path / "policy", name))
    flights = make_observations(name, 0, 5, 4)
    policy.reset(5)
    for t in range(1, 5):
        logits = policy.logits(flights[:, t - 1])
        np.testing.assert_allclose(logits, expected_logits(name, flights[:, :t]), rtol=1e-5, atol=1e-5)
    assert np.ptp(logits, axis=0).max() > 1e-2
    assert policy.manifest["figures"] == {"return": 1.5}
    assert policy.observation == make_spec(name).kind.observation


@pytest.mark.parametrize("name", ["bytestream", "rgb"])
def test_the_same_policy_is_saved_as_the_same_bytes_and_each_file_has_its_sum(name, tmp_path):
    folder, again = save(tmp_path / "policy", name), save(tmp_path / "again", name)
    files = sorted(path.name for path in folder.iterdir())
    assert files == sorted(path.name for path in again.iterdir())
    assert (ENCODER in files) is make_spec(name).frozen
    for file in files:
        assert (folder / file).read_bytes() == (again / file).read_bytes()
    sums = json.loads((folder / MANIFEST).read_text())["sha256"]
    assert sums == {
        file: hashlib.sha256((folder / file).read_bytes()).hexdigest() for file in files if file != MANIFEST
    }


@pytest.mark.parametrize("name", ["bytestream", "event_columns_gru", "event_image"])
def test_in_mid_episode_a_restart_forgets_what_is_kept_stays_and_copies_go_on(name, tmp_path):
    steps = make_observations(name, 1, 5, 3)
    policy, fresh = load_policy(save(tmp_path / "policy", name)), load_policy(tmp_path / "policy")
    policy.reset(3)
    for step in steps[:3]:
        policy.logits(step)
    copies = [copy.deepcopy(policy), pickle.loads(pickle.dumps(policy)), copy.copy(policy)]
    restarted, kept = copy.deepcopy(policy), copy.deepcopy(policy)
    whole = [policy.logits(step) for step in steps[3:]]
    for other in copies:
        np.testing.assert_array_equal([other.logits(step) for step in steps[3:]], whole)
    begins = np.array([False, True, False])
    part = [restarted.logits(steps[3], begins), restarted.logits(steps[4])]
    kept.keep(np.array([2, 0]))
    for step, found, expected in zip(steps[3:], part, whole, strict=True):
        np.testing.assert_array_equal(found[[0, 2]], expected[[0, 2]])
        assert not np.array_equal(found[1], expected[1])
        np.testing.assert_allclose(found[1], fresh.logits(step[1:2])[0], rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(kept.logits(step[[2, 0]]), expected[[2, 0]], rtol=1e-5, atol=1e-5)


def filtering(support, folder):
    """A policy whose events pass a filter of such a support."""
    spec = make_spec("event_columns")
    about = {**ABOUT, "sensor": {**ABOUT["sensor"], "filter_support": support, "filter_tau_us": 1_000_000}}
    return load_policy(save_policy(folder, build_networks(spec, seed=3), spec, about))


def same_events(window):
    """The events of a window in every form whose meaning is plain."""
    rows = window[1 : window[0, 0] + 1].astype(np.int64)
    events = np.array([tuple(row) for row in rows.tolist()], EVENT)
    fields = {name: events[name] for name in "txyp"}
    return {
        "array": events,
        "other order": events[["p", "y", "x", "t"]],
        "rows": rows,
        "list of rows": rows.tolist(),
        "list of tuples": [tuple(row) for row in rows.tolist()],
        "tensor": torch.from_numpy(rows),
        "fields": fields,
        "lists": {name: values.tolist() for name, values in fields.items()},
        "tensors": {name: torch.from_numpy(rows[:, place].copy()) for place, name in enumerate("txyp")},
        "table": pandas.DataFrame({name: values.astype(np.int64) for name, values in fields.items()}),
        "booleans": {**fields, "p": events["p"] > 0},
        "list of booleans": {**fields, "p": (events["p"] > 0).tolist()},
        "tensor of booleans": {**fields, "p": torch.from_numpy(events["p"] > 0)},
    }


@pytest.mark.parametrize("support", [0, 1])
def test_events_may_come_in_every_form_whose_meaning_is_plain(support, tmp_path):
    policy = filtering(support, tmp_path)

    def logits(events):
        policy.reset()
        return tuple(policy.event_logits(events, 0, 5000).tolist())

    (window,) = make_windows(np.random.default_rng(4), 1, side=SIDE)
    found = {name: logits(events) for name, events in same_events(window).items()}
    assert len(set(found.values())) == 1, found
    none = {logits(events) for events in ([], np.empty((0, 4)), {name: [] for name in "txyp"})}
    assert len(none) == 1
    assert found["array"] not in none


@pytest.mark.parametrize(
    ("events", "rule"),
    [
        (None, "by name or as rows .* of shape \\(\\)"),
        ("events", "by name or as rows"),
        ([1, 2, 3, 1], "of shape \\(4,\\)"),
        ([[1, 2, 3, 1], [2, 2]], "by name or as rows"),
        ([[1.5, 2, 3, 1]], "field t must hold integers, got float64"),
        ({"t": [1], "x": [1], "y": [1]}, "without p"),
        ({"t": [1, 2], "x": [1], "y": [1], "p": [1]}, "shapes"),
        ({"t": [True], "x": [1], "y": [1], "p": [1]}, "field t must hold integers, got bool"),
        ([[10, 2, 3, 0]], "event 0 has p=0: recode 0 as -1"),
        ([[10, 2, 3, 1], [9, 2, 3, 1]], "in time order; event 1 has t=9 after 10: sort them"),
        ([[6000, 2, 3, 1]], r"t in \[0, 5000\] us; got 6000 to 6000: give start_us"),
        ([[10, -1, 3, 1]], "x=-1"),
        ([[10, 2, SIDE, 1]], f"y={SIDE}"),
    ],
)
def test_other_events_are_refused_by_one_rule(events, rule, tmp_path):
    with pytest.raises(ValueError, match=f"event.*{rule}"):
        filtering(0, tmp_path).event_logits(events, 0, 5000)


@pytest.mark.parametrize("name", ["event_columns", "event_image", "rgb"])
def test_observations_may_be_lists_and_tensors(name, tmp_path):
    steps, policy = make_observations(name, 1, 3), load_policy(save(tmp_path, name))
    forms = [np.asarray, torch.from_numpy, np.ndarray.tolist, list]
    if name == "event_columns":
        forms.append(lambda windows: [window[: window[0, 0] + 1] for window in windows])
    else:
        forms.append(lambda pictures: pictures[..., None])
    found = set()
    for form in forms:
        policy.reset(3)
        found.add(policy.logits(form(steps)).tobytes())
    assert len(found) == 1


def test_a_policy_that_sees_no_events_says_so(tmp_path):
    with pytest.raises(ValueError, match="luminance images, not events"):
        load_policy(save(tmp_path, "rgb")).act(np.empty(0, EVENT), 0, 5000)


def test_actions_are_the_likeliest_one_for_each_episode(tmp_path):
    policy, observations = (
        load_policy(save(tmp_path, "event_columns")),
        make_observations("event_columns", 3, 6),
    )
    with pytest.raises(ValueError, match=r"one for each of 1 episodes, got 6: call reset\(num_envs\)"):
        policy(observations)
    policy.reset(6)
    actions = policy(observations)
    policy.reset(6)
    assert actions.dtype == np.int64
    np.testing.assert_array_equal(actions, policy.logits(observations).argmax(axis=1))


def test_a_stochastic_policy_draws_actions_with_their_probabilities():
    count, spec, networks = 4000, make_spec("event_columns"), make_networks("event_columns")
    *_, last = networks["pi"].modules()
    last.weight.data.zero_()
    last.bias.data = torch.log(torch.tensor([0.2, 0.5, 0.3])) + 40.0
    policy = Policy(networks, spec, deterministic=False, rng=np.random.default_rng(4))
    policy.reset(count)
    actions = policy(np.repeat(make_windows(np.random.default_rng(5), 1), count, axis=0))
    shares = np.bincount(actions, minlength=3) / count
    np.testing.assert_allclose(shares, [0.2, 0.5, 0.3], atol=0.03)  # 4 standard errors
    with pytest.raises(ValueError, match="rng must be given"):
        Policy(networks, spec, deterministic=False)


def test_an_encoder_is_saved_if_and_only_if_the_policy_has_one(tmp_path):
    for name, evae, rule in (("bytestream", None, "given"), ("event_image", make_evae(), "None")):
        with pytest.raises(ValueError, match=f"evae must be {rule} for {name}"):
            save_policy(tmp_path, make_networks(name), make_spec(name), ABOUT, evae)


@pytest.mark.system
def test_flying_needs_no_ray():
    code = "import sys, models.policy.policy; sys.exit('ray' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_an_environment_with_the_fields_of_a_policy_shows_it_what_it_was_trained_to_see(tmp_path):
    spec = make_spec("event_columns")
    trained = EnvConfig(
        control_hz=100.0,
        window_capacity=None,
        filter_support=1,
        camera=CameraConfig(width=SIDE, height=SIDE, contrast_threshold=0.3),
        fidelity=FidelityConfig(tolerance=0.1),
    )
    about = {**ABOUT, "sensor": sensor_settings(trained), "window_capacity": None}
    policy = load_policy(save_policy(tmp_path / "policy", build_networks(spec, seed=3), spec, about))
    env = CorridorEnv(**policy.env_fields, faults=FaultsConfig(background_activity=0.3))
    assert dataclasses.replace(env.config, faults=trained.faults) == trained
    observation, info = env.reset(seed=0)
    other = load_policy(tmp_path / "policy")
    for step in range(10):
        start_us = info["t_us"] - 10_000 if step else 0
        events = env.events if step else env.events[:0]
        np.testing.assert_array_equal(
            policy.logits(observation[None])[0], other.event_logits(events, start_us, 10_000)
        )
        observation, _, _, _, info = env.step(0)
