"""Compiles the kernels into numba's cache, by using each once: python -m jobs.run.compile.

What is compiled already is only loaded, and nothing is done while no source file has changed. One
job compiles, in two processes; others that are started meanwhile wait for it. The rooms are imported only
where there is something to compile, because that takes seconds.
"""

import hashlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from jobs.run.files import write_atomic
from jobs.run.locks import locked
from jobs.run.progress import console
from jobs.run.provenance import REPOSITORY

CACHE = REPOSITORY / "envs" / "__pycache__"


def compile_kernels() -> None:
    """Compile, in a process of its own, before several processes start that would each do it.

    Nothing is done where the folder of the source cannot be written: numba then compiles elsewhere.
    """
    if not _is_current() and os.access(CACHE.parent, os.W_OK):
        subprocess.run([sys.executable, "-m", "jobs.run.compile"], cwd=REPOSITORY, check=False)


def main() -> None:
    """Compile what has changed since the last time, and say how long it took."""
    with locked(CACHE / "compile.lock", "Another process compiles the kernels; waiting for it ..."):
        if _is_current():
            return
        now = _digest()
        console.print("Compiling the kernels (a minute and a half at the first time) ...")
        start = time.perf_counter()
        side_by_side((draw, respond))
        side_by_side((simulate, learn))  # a compiled step is made of what was drawn and responded by
        console.print(f"Compiled the kernels in {time.perf_counter() - start:.0f} s.")
        write_atomic(CACHE / "compiled", now)


def _is_current() -> bool:
    """Whether nothing has changed since all was compiled."""
    compiled = CACHE / "compiled"
    return compiled.is_file() and compiled.read_text() == _digest()


def _digest() -> str:
    """A hash of all sources of kernels, of what is compiled of them, by which numba and where to."""
    files = sorted(path for room in ("envs", "models") for path in (REPOSITORY / room).rglob("*.py"))
    whole = hashlib.sha256(b"".join(path.read_bytes() for path in (Path(__file__), *files)))
    python = sys.version_info[:2]  # each has machine code of its own
    whole.update(f"{version('numba')} {python} {os.environ.get('NUMBA_CACHE_DIR')}".encode())
    return whole.hexdigest()


def side_by_side(parts: Sequence[Callable[[], None]]) -> None:
    """Call functions of modules, each in a process of its own."""
    with ProcessPoolExecutor(len(parts), get_context("spawn")) as pool:
        for done in [pool.submit(part) for part in parts]:
            done.result()


def draw() -> None:
    """Draw a scene."""
    from envs.raycast.renderer import RaycastRenderer
    from envs.scene import make_scene

    RaycastRenderer(make_scene("poles", np.random.default_rng(0)), 16, 16).render(0.0, 0.0, 2.0)


def respond() -> None:
    """Let pixels see light change, in whole images and in columns; encode events, and write and read them."""
    from envs.config import CameraConfig, FaultsConfig
    from envs.events import EventCamera, RealSensor
    from envs.events.crossings import make_room, named
    from envs.events.emission import Span
    from envs.events.ramps import ColumnCamera, Watch, events_of_ramps, look_at, make_ramps

    light, config = np.ones((16, 16), np.float32), CameraConfig(width=16, height=16)
    faults = FaultsConfig(background_activity=0.1, shot_noise_hz=10.0, leak_hz=1.0)
    for changed in ({"memory": "frame"}, {"refractory_us": 100}, {"cutoff_hz": 100.0, "readout_hz": 1e6}):
        camera = EventCamera(replace(config, **changed))
        camera.reset(light, 0)
        camera.step(0.5 * light, 1000)
    columns = ColumnCamera(config)
    columns.reset(light)
    state, ramps, (model, memory) = columns.state, make_ramps(1000), named(*columns.state[:2])
    watch = Watch(model, memory, np.zeros(16, np.int64), state[2], ramps, make_room(), columns.bandwidth)
    _, kept, _ = look_at(0.5 * light, 0, 16, 1000, watch, 0)
    rng = np.random.default_rng(0)
    sensor = RealSensor(config, faults, (state, columns.pixels), rng, 0)
    sensor.events(events_of_ramps(watch, kept, Span(0, 1000)), 0, 1000)
    record()
    encode()


def simulate() -> None:
    """Move through a few corridors."""
    from envs.config import CameraConfig, EnvConfig, FaultsConfig
    from envs.corridor import CorridorEnv, CorridorVectorEnv
    from envs.event_error import measure_event_error
    from envs.scene.planning import cost_to_go

    small = partial(CameraConfig, width=16, height=16)
    noisy = FaultsConfig(sparsity=0.1, background_activity=0.1, shot_noise_hz=10.0, leak_hz=1.0)
    for config in (
        EnvConfig(camera=small(), faults=noisy),
        EnvConfig(camera=small(memory="frame"), observation="event_image", scene="gates"),
        EnvConfig(camera=small(refractory_us=100), scene="texture_change"),
        EnvConfig(camera=small(cutoff_hz=100.0, readout_hz=1e6), faults=noisy),
        EnvConfig(camera=small(), observation="luminance", scene="dynamic"),
    ):
        env = CorridorEnv(config)
        env.reset(seed=0)
        env.step(1)
    several = CorridorVectorEnv(2, camera=small(), window_capacity=None)
    several.reset(seed=0)
    several.step(np.zeros(2, np.int64))
    cost_to_go(several.envs[0].scene, 0.3).of_actions(0.0, 0.0)
    measure_event_error(EnvConfig(camera=small()), flights=1, steps=1)


def record() -> None:
    """Write and read recordings."""
    from envs.recordings import read_events, write_events
    from envs.recordings.ecf import decode_ecf
    from envs.recordings.event_stream import MAGIC_ES

    with tempfile.TemporaryDirectory() as folder:
        for name in ("dat", "evt2", "evt3"):
            write_events(Path(folder) / name, some_events(), 16, 16, name)
            read_events(Path(folder) / name)
        (Path(folder) / "es").write_bytes(MAGIC_ES + bytes((2, 0, 0, 1, 16, 0, 16, 0)))
        read_events(Path(folder) / "es")
    decode_ecf(np.frombuffer(bytes(12), np.uint8), some_events()[:0])


def encode() -> None:
    """Encode a few events, as for a policy and as in the training of an encoder."""
    from models.encoder.evae import EventVAE
    from models.encoder.event_batch import batch_windows
    from models.encoder.frozen import encoder_of

    evae, events = EventVAE(context=64), some_events()
    evae.ecn(batch_windows([(events, 0, 5000)] * 2, evae.grid)).sum().backward()
    encoder_of(evae.freeze()).encode(events, 0, 5000)


def learn() -> None:
    """Decide by a small policy, and take a gradient step of it."""
    import torch
    from torch import nn

    from models.encoder.products import orthogonal_
    from models.policy.dense_update import Rows, Settings, update_dense
    from models.policy.networks import logits_by, mlp

    networks = [mlp(2, (2,), outputs) for outputs in (3, 1)]
    optimizer = torch.optim.Adam(nn.ModuleList(networks).parameters(), fused=True)
    stacks, none, one = np.zeros((1, 2), np.float32), np.zeros((1, 0), np.float32), np.zeros(1, np.float32)
    rows = Rows(stacks, none, np.zeros(1, np.int64), one, one, one)
    orthogonal_(networks[0][0].weight, 1.0)
    logits_by(nn.Flatten(), networks[0])(stacks)
    settings = Settings(1, 0.2, 1.0, 1.0, 0.0, 1.0, 1e-3, 0.9, 0.999, 1e-8)
    update_dense(networks, optimizer, rows, np.zeros((1, 1), np.int64), settings)


def some_events() -> np.ndarray:
    """A hundred events."""
    from envs.events import EVENT

    events = np.zeros(100, EVENT)
    events["t"], events["p"] = np.arange(100), 1
    return events


if __name__ == "__main__":
    main()
