"""Compiles the kernels into numba's cache, by using each once: python -m tests.support.kernels."""

import tempfile
from pathlib import Path

import numpy as np

from envs.config import CameraConfig, EnvConfig, FaultsConfig
from envs.corridor import CorridorEnv
from envs.event_error import measure_event_error
from envs.events import EVENT
from envs.raycast.renderer import sample_luminance
from envs.recordings import read_events, write_events
from envs.scene import make_scene
from envs.scene.planning import cost_to_go
from jobs.bench.latency import random_policy
from models.encoder.evae import EventVAE
from models.encoder.event_batch import batch_windows
from tests.support.looks import HEIGHT, WIDTH, Looker

CAMERA = {"width": 16, "height": 16}


def main() -> None:
    """Move through a few corridors, ask policies what to do, and write and read a recording."""
    noisy = FaultsConfig(sparsity=0.1, background_activity=0.1, shot_noise_hz=10.0, leak_hz=1.0)
    worlds = (
        EnvConfig(camera=CameraConfig(**CAMERA), faults=noisy),
        EnvConfig(camera=CameraConfig(**CAMERA, memory="frame"), observation="event_image", scene="gates"),
        EnvConfig(camera=CameraConfig(**CAMERA, refractory_us=100), scene="texture_change"),
        EnvConfig(camera=CameraConfig(**CAMERA), observation="luminance", scene="dynamic"),
    )
    for config in worlds:
        env = CorridorEnv(config)
        env.reset(seed=0)
        env.step(1)
    for threshold_mismatch in (
        0.0,
        0.1,
    ):  # kernels by themselves are compiled apart from those that call them
        Looker(np.ones((HEIGHT, WIDTH), np.float32), threshold_mismatch=threshold_mismatch).look(
            (np.zeros((HEIGHT, WIDTH), np.float32), 0, WIDTH, 1000)
        )
    measure_event_error(EnvConfig(camera=CameraConfig(**CAMERA)), flights=1, steps=1)
    events = np.zeros(100, EVENT)
    events["t"], events["p"] = np.arange(100), 1
    scene = make_scene("poles", np.random.default_rng(0))
    sample_luminance(scene, (0.0, 0.0, 2.0, 0.0), 8, 8)
    cost_to_go(scene, 0.3).of_actions(0.0, 0.0)
    for name in ("bytestream", "event_image", "event_set"):
        random_policy(name).event_logits(events, 0, 5000)
    evae = EventVAE(context=64)
    evae.ecn(batch_windows([(events, 0, 5000)] * 2, evae.grid)).sum().backward()
    with tempfile.TemporaryDirectory() as folder:
        for name in ("evt2", "evt3"):
            write_events(Path(folder) / name, events, 16, 16, name)
            read_events(Path(folder) / name)


if __name__ == "__main__":
    main()
