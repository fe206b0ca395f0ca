"""Measure steps per second of every stage from the scene to the training loop, in one run.

Run: python -m benchmarks.throughput
Expect: a table in about three minutes on one core. Rows of the second part include everything
that the rows above them do; "of the loop" is the share of the training loop's time.
"""

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import numpy as np
import torch
import yaml

from envs.config import EnvConfig, sensor_settings, settings_hash
from envs.corridor import CorridorEnv, CorridorVectorEnv
from envs.events import EventCamera
from envs.rasterize import PyrenderRenderer
from envs.raycast import RaycastRenderer
from envs.scene import Scene, make_scene
from jobs.analysis.tables import show_table
from jobs.config.algorithms import AlgoConfig
from jobs.config.config import Config, parse
from jobs.measure.timing import interleaved
from jobs.rollout.policies import PRETRAINED
from jobs.run.progress import console
from jobs.training.pretrain import evae_settings
from models.encoder.evae import EventVAE
from models.encoder.table import EncoderTable
from models.encoder.weights import save_encoder
from models.policy import load_policy

NUM_ENVS = 32
CONFIG = EnvConfig()
POLICY = "bytestream-s0"


def main() -> None:
    """Measure and print the table."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    evae = EventVAE.of(evae_settings(composed())).freeze()
    parts = [*frame_rows(), *step_rows(evae)]
    with TemporaryDirectory() as folder:
        loops = loop_rows(evae, Path(folder))
    whole = loops[0][1]
    rows = [
        (name, f"{1e6 * seconds:,.0f}", f"{1 / seconds:,.0f}", f"{seconds / whole:.1%}")
        for name, seconds in [*parts, *loops]
    ]
    title = "One core, 64x64, scene poles, 200 Hz; medians of interleaved rounds"
    show_table(title, ("station", "us", "per second", "of the loop"), rows)


def frame_rows() -> list[tuple[str, float]]:
    """Return seconds per frame of each renderer, and per step of the event camera alone."""
    scene = make_scene("poles", np.random.default_rng(0))
    path_m = np.linspace(0.0, 90.0, 200)
    raycast = RaycastRenderer(scene, 64, 64)
    frames = [raycast.render(0.0, 0.1 * step, 2.0).copy() for step in range(200)]
    camera = EventCamera(64, 64)
    clock_us = iter(range(5000, 2**60, 5000))

    def watch() -> None:
        camera.reset(frames[0], next(clock_us))
        for frame in frames[1:]:
            camera.step(frame, next(clock_us))

    work: dict[str, Callable[[], object]] = {
        "render: raycast": lambda: [raycast.render(0.0, y, 2.0) for y in path_m],
        "event camera": watch,
    }
    pyrender = _pyrender(scene)
    if pyrender is not None:
        work["render: pyrender"] = lambda: [pyrender.render(0.0, y, 2.0) for y in path_m]
    return [(name, seconds / len(path_m)) for name, seconds in interleaved(work).items()]


def _pyrender(scene: Scene) -> PyrenderRenderer | None:
    """Return the OpenGL renderer; None if it cannot run, and print the reason."""
    try:
        return PyrenderRenderer(scene, 64, 64)
    except RuntimeError as error:
        console.print(str(error), markup=False)
        return None


def step_rows(evae: EventVAE) -> list[tuple[str, float]]:
    """Return seconds per environment step: alone, with pyrender, as a vector, with encoder, with policy."""
    table, policy = EncoderTable.from_evae(evae), load_policy(PRETRAINED / POLICY)
    steps, batches = 416, 416 // NUM_ENVS
    rng = np.random.default_rng(0)
    single = CorridorEnv(CONFIG)
    drawn = CorridorEnv(CONFIG, renderer="pyrender")
    several = CorridorVectorEnv(NUM_ENVS, CONFIG, window_capacity=None)
    several.reset(seed=0)
    policy.reset(NUM_ENVS)

    def step(env: CorridorEnv) -> None:
        env.reset(seed=0)
        over = False
        for _ in range(steps):
            over = any(env.step(int(rng.integers(3)))[2:4])
            if over:
                env.reset()

    def step_several(look: Callable[[Any], object]) -> None:
        for _ in range(batches):
            look(several.step(rng.integers(3, size=NUM_ENVS))[0])

    together = f"env step: raycast, {NUM_ENVS} as a vector"
    work: dict[str, Callable[[], object]] = {
        "env step: raycast": lambda: step(single),
        together: lambda: step_several(len),
        f"{together}, encoded": lambda: step_several(table.encode_windows),
        f"{together}, encoded and decided": lambda: step_several(policy.logits),
    }
    try:
        drawn.reset(seed=0)
        work["env step: pyrender"] = lambda: step(drawn)
    except RuntimeError as error:
        console.print(str(error), markup=False)
    return [(name, seconds / steps) for name, seconds in interleaved(work).items()]


def loop_rows(evae: EventVAE, folder: Path) -> list[tuple[str, float]]:
    """Return seconds per environment step of whole PPO iterations, and of sampling."""
    from jobs.run.ray_cluster import start_ray
    from jobs.training.algorithms import build_algorithm
    from jobs.training.sampling.env_runner import PlainEnvRunner

    config, path = composed(), encoder_file(evae, folder)
    algo = cast(AlgoConfig, config.algo)
    size = algo.train_batch_size_per_learner
    start_ray(config.cluster, folder)
    ppo = {
        minibatch: build_algorithm(replace(config, algo=replace(algo, minibatch_size=minibatch)), path)
        for minibatch in (32, 256)
    }
    runner = PlainEnvRunner(config=ppo[32], worker_index=0)
    algorithms = {minibatch: settings.build_algo() for minibatch, settings in ppo.items()}
    work: dict[str, Callable[[], object]] = {
        "training loop, the paper's minibatch of 32": algorithms[32].train,
        "training loop, minibatch of 256": algorithms[256].train,
        "sampling: simulation, networks, episodes": lambda: runner.sample(num_timesteps=size),
    }
    return [(name, seconds / size) for name, seconds in interleaved(work).items()]


def encoder_file(evae: EventVAE, folder: Path) -> Path:
    """Write an encoder for the default sensor; return its file."""
    sensor = sensor_settings(CONFIG)
    path = folder / f"{evae.settings.variant}.safetensors"
    save_encoder(path, evae, {"sensor": sensor, "sensor_hash": settings_hash(sensor)})
    return path


def composed(*words: str) -> Config:
    """Return the configuration that the launcher composes from words; without words, a training by PPO."""
    given = {_key(word) for word in words}
    usual = [word for word in ("+exp=train", "algo=ppo") if _key(word) not in given]
    command = [sys.executable, "-m", "platform.launch", *usual, *words, "--cfg", "job"]
    said = subprocess.run(command, check=True, capture_output=True, text=True)  # noqa: S603  own words, no shell
    return parse(yaml.safe_load(said.stdout))


def _key(word: str) -> str:
    return word.partition("=")[0]


if __name__ == "__main__":
    main()
