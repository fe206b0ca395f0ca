"""Untrained policies and their folders for tests."""

import dataclasses
import json

import numpy as np
import pytest
import torch

from envs.config import EnvConfig, sensor_settings, settings_hash
from models.encoder.evae import EventVAE
from models.encoder.weights import with_checksum
from models.kinds import PolicySpec, model_keys, read_model
from models.policy import save_policy
from models.policy.networks import build_networks
from models.policy.policy import MANIFEST, read_policy_manifest

HELD_OUT = EnvConfig(scene="poles_eval", split="eval")
SIDE = 40
SENSOR = {"sensor": {"width": SIDE, "height": SIDE}, "sensor_hash": "0123456789ab"}
ABOUT = {**SENSOR, "figures": {"return": 1.5}}
TRAINED = (
    *("bytestream", "event_columns", "event_columns_gru", "event_set"),
    *("event_image", "event_image_vae", "rgb", "finetuned"),
)
RECURRENT = ("event_columns_gru",)  # their logits depend on all steps; none is shipped

# Kinds that share their networks with rgb, or their encoder with bytestream.
ALIKE = ("event_image", "event_image_vae")


def kinds(names, quick=("bytestream", "rgb")):
    """Parameters of a test: the quick suite takes two kinds of policy, `make check` all but those alike."""
    others = [pytest.mark.system]
    marks = {name: [*others, pytest.mark.slow] if name in ALIKE else others for name in names}
    return [pytest.param(name, marks=() if name in quick else marks[name]) for name in names]


def save_untrained(path, env_config=HELD_OUT, name="bytestream"):
    """A policy folder with random weights; large ones, so that its actions differ."""
    sensor = sensor_settings(env_config)
    spec = dataclasses.replace(make_spec(name, hidden=[16], time_bins=1024), width=64, height=64)
    about = {"sensor": sensor, "sensor_hash": settings_hash(sensor), "figures": {}}
    networks = build_networks(spec, seed=3)
    for value in networks["pi"].parameters():
        value.data *= 1000.0
    torch.manual_seed(0)
    evae = EventVAE(context=64).freeze() if spec.frozen else None
    return save_policy(path, networks, spec, about, evae, {"reconstruction_step": 0.5})


def save_training(path, group, seed, env_config, name="event_columns"):
    """An untrained policy that says it is a training of `group`; returns the folder."""
    save_untrained(path, env_config, name)
    manifest = read_policy_manifest(path / MANIFEST)
    (path / MANIFEST).write_text(json.dumps(with_checksum({**manifest, "exp": group, "seed": seed})))
    return str(path)


def make_evae(seed=0, variant="bytestream"):
    torch.manual_seed(seed)
    return EventVAE(variant, width=SIDE, height=SIDE, context=64, time_bins=32).freeze()


def make_spec(name, **changes):
    """Of a kind of policy, or of "finetuned": bytestream with a fine-tuned encoder."""
    if name == "finetuned":
        return make_spec("bytestream", encoder="finetuned", **changes)
    own = {
        "name": name,
        "stack": 3,
        "memory_ms": [],
        "hidden": [64, 64],
        "context": 64,
        "latent": 8,
        "units": 16,
        "norm": "batch",
    }
    own |= {"target": "signed", "time_bins": 32, "coding": "additive", "pool_rank": 1, "encoder": "frozen"}
    own |= {"octaves": 0, "own_actions": False, "own_velocity": False, "bands": []}
    own |= changes
    return PolicySpec(read_model(**{key: own[key] for key in model_keys(name)}), SIDE, SIDE, 3)


def make_networks(name):
    networks = build_networks(make_spec(name), seed=3)
    *_, last = networks["pi"].modules()
    last.weight.data.mul_(100.0)  # so that actions differ
    return networks


def save(path, name):
    spec = make_spec(name)
    evae = make_evae(variant=name) if spec.frozen else None
    return save_policy(path, make_networks(name), spec, ABOUT, evae)


def make_windows(rng, count, capacity=40, side=16):
    windows = np.zeros((count, capacity + 1, 4), np.int32)
    for window in windows:
        events = int(rng.integers(0, capacity + 1))
        window[0] = events, 0, 5000, 0
        window[1 : events + 1, 0] = np.sort(rng.integers(1, 5001, events))
        window[1 : events + 1, 1:3] = rng.integers(0, side, (events, 2))
        window[1 : events + 1, 3] = rng.choice([-1, 1], events)
    return windows
