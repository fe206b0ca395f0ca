"""Compile the kernels into numba's cache by calling each once: python -m jobs.run.compile [all].

Without `all`, only the kernels of the default commands are compiled: demonstration, training, evaluation.
numba compiles the others at their first call. Nothing is done until a source file changes. A clone reuses
kernels that another clone of the same sources has compiled on this machine. One job compiles, in two
processes; jobs that are started meanwhile wait for it. The packages are imported only if there is something
to compile, because importing them takes seconds.
"""

import contextlib
import hashlib
import os
import re
import subprocess
import sys
import sysconfig
import tempfile
import time
import zipfile
import zlib
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from core import forget_stale_kernels
from core.files import replaced
from jobs.run.files import write_atomic
from jobs.run.locks import locked
from jobs.run.progress import console
from jobs.run.provenance import REPOSITORY

ROOMS = ("core", "envs", "models")
CACHE = REPOSITORY / "envs" / "__pycache__"
ARCHIVES = 8  # most archives of compiled kernels in the user's cache, 10 MB each


def compile_kernels() -> None:
    """Compile the kernels in a separate process, before several processes start that would each compile.

    Do nothing if the source folder is not writable: numba then caches kernels elsewhere.
    """
    if not _is_current("first") and os.access(CACHE.parent, os.W_OK):
        subprocess.run([sys.executable, "-m", "jobs.run.compile"], cwd=REPOSITORY, check=False)


def main(which: str = "first") -> None:
    """Compile what has changed since the last call, and print how long it took.

    Args:
        which: `first` for what the default commands use, `all` for every kernel.
    """
    with locked(CACHE / "compile.lock", "Another process compiles the kernels; waiting for it ..."):
        if _is_current(which):
            return
        now, start = _digest(), time.perf_counter()
        cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        archive = Path(cache, "evade", "kernels", f"{now}-{which}.zip")  # all clones share it
        if unpack(archive):
            console.print("Took the kernels that another clone of the same sources compiled.")
        else:
            console.print("Compiling the kernels (about a minute at the first time) ...")
            for parts in STAGES[which]:
                side_by_side(parts)
            console.print(f"Compiled the kernels in {time.perf_counter() - start:.0f} s.")
            pack(archive)
        write_atomic(CACHE / f"compiled_{which}", now)


def _is_current(which: str) -> bool:
    """Whether these kernels, or all kernels, were compiled from the current sources."""
    now = _digest()
    files = (CACHE / f"compiled_{name}" for name in {which, "all"})
    return any(file.is_file() and file.read_text() == now for file in files)


def _digest() -> str:
    """Return a hash of the kernels' sources, the compiler, the target and the cache folder."""
    files = sorted(path for room in ROOMS for path in (REPOSITORY / room).rglob("*.py"))
    whole = hashlib.sha256(b"".join(path.read_bytes() for path in (Path(__file__), *files)))
    compiler = [version("numba"), version("llvmlite"), sys.version_info[:2], sysconfig.get_platform()]
    places = [os.environ.get(f"NUMBA_{name}") for name in ("CPU_NAME", "CPU_FEATURES", "CACHE_DIR")]
    whole.update(repr([compiler, places]).encode())
    return whole.hexdigest()


def pack(archive: Path) -> None:
    """Archive the compiled kernels for other clones; do nothing if the archive cannot be written."""
    with contextlib.suppress(OSError):
        with (
            replaced(archive) as part,
            zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file,
        ):
            for room in ROOMS:
                for path in sorted((REPOSITORY / room).rglob("__pycache__/*.nb[ci]")):
                    file.write(path, path.relative_to(REPOSITORY))
        archives = sorted(archive.parent.glob("*.zip"), key=lambda path: path.stat().st_mtime)
        for old in archives[:-ARCHIVES]:
            old.unlink(missing_ok=True)


def unpack(archive: Path) -> bool:
    """Unpack the kernels of another clone; return whether there were any."""
    for room in ROOMS:  # later, it would delete the unpacked kernels as stale
        forget_stale_kernels(REPOSITORY / room)
    try:
        with zipfile.ZipFile(archive) as file:
            # The index of a kernel, `.nbi`, names its `.nbc` files, so it is written after them.
            for name in sorted(file.namelist()):
                target = REPOSITORY / name
                index = re.sub(r"(\.\d+\.nbc|\.nbi)$", ".nbi", target.name)
                if target.with_name(index).exists():
                    continue
                target.parent.mkdir(exist_ok=True)
                write_atomic(target, file.read(name))
    except (OSError, zipfile.BadZipFile, zlib.error):
        return False
    return True


def side_by_side(parts: Sequence[Callable[[], None]]) -> None:
    """Call module-level functions in parallel, each in its own process."""
    with ProcessPoolExecutor(len(parts), get_context("spawn")) as pool:
        for done in [pool.submit(part) for part in parts]:
            done.result()


def draw() -> None:
    """Render a scene."""
    from envs.raycast.renderer import RaycastRenderer
    from envs.scene import make_scene

    RaycastRenderer(make_scene("poles", np.random.default_rng(0)), 16, 16).render(0.0, 0.0, 2.0)


def look() -> None:
    """Simulate columns of pixels in changing light, encode events, and update a policy."""
    from envs.config import CameraConfig
    from envs.events.crossings import make_room, named
    from envs.events.emission import Span
    from envs.events.ramps import ColumnCamera, Watch, events_of_ramps, look_at, make_ramps
    from envs.events.windows import event_image

    columns = ColumnCamera(CameraConfig(width=16, height=16))
    columns.reset(np.ones((16, 16), np.float32))
    state, ramps, (model, memory) = columns.state, make_ramps(1000), named(*columns.state[:2])
    watch = Watch(model, memory, np.zeros(16, np.int64), state[2], ramps, make_room(), columns.bandwidth)
    _, kept, _ = look_at(np.full((16, 16), 0.5, np.float32), 0, 16, 1000, watch, 0)
    events_of_ramps(watch, kept, Span(0, 1000))
    event_image(some_events(), 16, 16)
    encode()
    learn()


def act_alone() -> None:
    """Step one corridor, and measure its event error."""
    from envs.config import CameraConfig, EnvConfig
    from envs.corridor import CorridorEnv
    from envs.event_error import measure_event_error

    config = EnvConfig(camera=CameraConfig(width=16, height=16))
    env = CorridorEnv(config)
    env.reset(seed=0)
    env.step(1)
    measure_event_error(config, flights=1, steps=1)


def act_together() -> None:
    """Step several corridors as a vector, and plan a path."""
    from envs.config import CameraConfig
    from envs.corridor import CorridorVectorEnv
    from envs.scene.planning import cost_to_go

    camera = CameraConfig(width=16, height=16)
    several = CorridorVectorEnv(2, camera=camera, window_capacity=None, filter_support=1)
    several.reset(seed=0)
    several.step(np.zeros(2, np.int64))
    cost_to_go(several.envs[0].scene, 0.3).of_actions(0.0, 0.0)


def respond() -> None:
    """Simulate the pixels of whole images, and write and read recordings."""
    from envs.config import CameraConfig
    from envs.events import EventCamera

    light, config = np.ones((16, 16), np.float32), CameraConfig(width=16, height=16)
    for changed in ({"memory": "frame"}, {"refractory_us": 100}, {"cutoff_hz": 100.0, "readout_hz": 1e6}):
        camera = EventCamera(replace(config, **changed))
        camera.reset(light, 0)
        camera.step(0.5 * light, 1000)
    record()


def simulate() -> None:
    """Step corridors with other sensors, scenes and observations."""
    from envs.config import CameraConfig, EnvConfig, FaultsConfig
    from envs.corridor import CorridorEnv

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


def record() -> None:
    """Write and read recordings."""
    from envs.recordings import read_events, write_events
    from envs.recordings.clocks import unwrap
    from envs.recordings.ecf import decode_ecf
    from envs.recordings.event_packets import decode_libcaer_cmp
    from envs.recordings.event_stream import MAGIC_ES

    with tempfile.TemporaryDirectory() as folder:
        for name in ("dat", "evt2", "evt3"):
            write_events(Path(folder) / name, some_events(), 16, 16, name)
            read_events(Path(folder) / name)
        (Path(folder) / "es").write_bytes(MAGIC_ES + bytes((2, 0, 0, 1, 16, 0, 16, 0)) + bytes(5))
        (Path(folder) / "evt21").write_bytes(b"% evt 2.1\n" + bytes((0, 0, 0, 0, 0, 0, 0, 128)))
        for name in ("es", "evt21"):
            read_events(Path(folder) / name)
    unwrap(np.zeros(1, np.uint32), 32, -1)
    decode_libcaer_cmp(np.zeros(1, np.uint16), 0, np.empty((4, 8), np.int64))
    decode_ecf(np.frombuffer(bytes(12), np.uint8), some_events()[:0])


def encode() -> None:
    """Encode a few events, both for a policy and for the training of an encoder."""
    from models.encoder.evae import EventVAE
    from models.encoder.event_batch import batch_packed, batch_windows
    from models.encoder.event_images import last_polarity
    from models.encoder.frozen import encoder_of

    evae, events = EventVAE(context=64), some_events()
    evae.ecn(batch_windows([(events, 0, 5000)] * 2, evae.grid)).sum().backward()
    encoder_of(evae.freeze()).encode(events, 0, 5000)
    last_polarity(batch_packed(np.zeros((2, 1, 4), np.int32), evae.grid))


def learn() -> None:
    """Compute the outputs of a small policy, and update it once."""
    import torch
    from torch import nn

    from models.encoder.products import orthogonal_
    from models.policy.dense_update import Rows, Settings, update_dense
    from models.policy.networks import by_dense_layers, mlp

    networks = [mlp(2, (2,), outputs) for outputs in (3, 1)]
    optimizer = torch.optim.Adam(nn.ModuleList(networks).parameters(), fused=True)
    stacks, none, one = np.zeros((1, 2), np.float32), np.zeros((1, 0), np.float32), np.zeros(1, np.float32)
    rows = Rows(stacks, none, np.zeros(1, np.int64), one, one, one)
    orthogonal_(networks[0][0].weight, 1.0)
    by_dense_layers(nn.Flatten(), networks[0])(stacks, none)
    settings = Settings(1, 0.2, 1.0, 1.0, 0.0, 1.0, 1e-3, 0.9, 0.999, 1e-8)
    update_dense(networks, optimizer, rows, np.zeros((1, 1), np.int64), settings)


def some_events() -> np.ndarray:
    """Return a hundred events."""
    from envs.events import EVENT

    events = np.zeros(100, EVENT)
    events["t"], events["p"] = np.arange(100), 1
    return events


FIRST = (draw, look), (act_alone, act_together)  # the kernels of a step include those of `draw` and `look`
STAGES = {"first": FIRST, "all": (*FIRST, (respond, simulate))}

if __name__ == "__main__":
    main(*sys.argv[1:])
