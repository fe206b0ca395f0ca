"""Untrained policies and their folders for tests."""

import json

import numpy as np
import pytest
import torch

from envs.config import EnvConfig, sensor_settings, settings_hash
from models.encoder.evae import EventVAE
from models.kinds import KINDS, kind_of
from models.policy import save_policy
from models.policy.networks import build_networks
from models.policy.policy import MANIFEST

HELD_OUT = EnvConfig(scene="poles_eval", split="eval")
SIDE = 40
SENSOR = {"sensor": {"width": SIDE, "height": SIDE}, "sensor_hash": "0123456789ab"}
FLOWN = ("bytestream", "event_columns", "event_set", "event_image", "event_image_vae", "rgb", "finetuned")


def kinds(names, quick=("bytestream", "rgb")):
    """Parameters of a test: the quick suite takes two kinds of policy, `make check` all."""
    return [pytest.param(name, marks=() if name in quick else pytest.mark.system) for name in names]


def save_untrained(path, env_config=HELD_OUT, name="bytestream"):
    """A policy folder with random weights; large ones, so that its actions differ."""
    kind, sensor = KINDS[name], sensor_settings(env_config)
    sizes = {"width": 64, "height": 64, "stack": 3, "num_actions": 3}
    parts = {"latent": 8 if kind.encoder else None, "hidden": [16] if kind.network == "mlp" else None}
    about = {"sensor": sensor, "sensor_hash": settings_hash(sensor), "figures": {}}
    networks = build_networks({"name": name, **sizes, **parts}, seed=3)
    for value in networks["pi"].parameters():
        value.data *= 1000.0
    torch.manual_seed(0)
    evae = EventVAE(context=64).freeze() if kind.encoder else None
    manifest = {"name": name, **sizes, **parts, **about}
    return save_policy(path, networks, manifest, evae, {"reconstruction_step": 0.5})


def save_training(path, group, seed, env_config, name="event_columns"):
    """An untrained policy that says it is a training of `group`; returns the folder."""
    save_untrained(path, env_config, name)
    manifest = json.loads((path / MANIFEST).read_text())
    (path / MANIFEST).write_text(json.dumps({**manifest, "exp": group, "seed": seed}))
    return str(path)


def make_evae(seed=0, variant="bytestream"):
    torch.manual_seed(seed)
    return EventVAE(variant, width=SIDE, height=SIDE, context=64, time_bins=32).freeze()


def make_settings(name):
    """Of a kind of policy, or of "finetuned": bytestream with an encoder that learnt on."""
    if name == "finetuned":
        evae = make_evae().settings
        own = {key: evae[key] for key in ("context", "norm", "target", "time_bins", "coding")}
        return {**make_settings("bytestream"), **own, "encoder": "finetuned"}
    kind = KINDS[name]
    sizes = {"width": SIDE, "height": SIDE, "stack": 3, "num_actions": 3}
    parts = {
        "latent": 8 if kind.encoder else None,
        "hidden": [64, 64] if kind.network == "mlp" else None,
    }
    return {"name": name, **sizes, **parts, **SENSOR, "figures": {"return": 1.5}}


def make_networks(name):
    networks = build_networks(make_settings(name), seed=3)
    *_, last = networks["pi"].modules()
    last.weight.data.mul_(100.0)  # so that actions differ
    return networks


def save(path, name):
    evae = make_evae(variant=name) if kind_of(make_settings(name)).encoder else None
    return save_policy(path, make_networks(name), make_settings(name), evae)


def make_windows(rng, count, capacity=40, side=16):
    windows = np.zeros((count, capacity + 1, 4), np.int32)
    for window in windows:
        events = int(rng.integers(0, capacity + 1))
        window[0] = events, 0, 5000, 0
        window[1 : events + 1, 0] = np.sort(rng.integers(1, 5001, events))
        window[1 : events + 1, 1:3] = rng.integers(0, side, (events, 2))
        window[1 : events + 1, 3] = rng.choice([-1, 1], events)
    return windows
