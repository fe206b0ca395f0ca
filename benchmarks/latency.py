"""Measure the time from the events of a control step to an action, by policy and window size.

Run: OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python -m benchmarks.latency
Expect: a table in about a minute, one thread, wall time: the median and the 99th percentile of
`models.policy.Policy.act`, without Ray, and the median of the same policy as an ONNX file in
onnxruntime. Weights are random, which does not affect the time. At 200 Hz a control step is 5,000 us.
"""

import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch

from benchmarks.throughput import composed
from envs.config import EnvConfig
from envs.events import EVENT
from jobs.analysis.tables import show_table
from jobs.training.policy import policy_spec
from models.encoder.evae import EventVAE
from models.encoder.frozen import encoder_of
from models.kinds import KINDS
from models.policy import Policy
from models.policy.networks import build_networks
from models.policy.onnx import export_onnx

SIZES = (0, 100, 300, 1000, 4000)  # events
CALLS, WARM = 400, 20
WINDOW_US = 5000


def main() -> None:
    """Measure and print the table."""
    torch.set_num_threads(1)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name, kind in KINDS.items():
            if kind.observation == "luminance":
                continue
            policy = random_policy(name)
            session = load(export_onnx(policy, Path(folder) / f"{name}.onnx"))
            rows.append((name, *(latency_text(policy, session, size) for size in SIZES)))
    title = "Events to action in microseconds: p50 / p99 of Policy.act; p50 in onnxruntime"
    show_table(title, ["policy", *(f"{size:,} events" for size in SIZES)], rows)


def random_policy(name: str) -> Policy:
    """Return a policy of a kind with default sizes and random weights."""
    config = composed(f"model={name}")
    spec = policy_spec(config)
    encoder = encoder_of(EventVAE.of(spec.evae).freeze()) if spec.frozen else None
    return Policy(build_networks(spec).requires_grad_(False), spec, encoder)


def load(file: Path) -> Any:
    """Return an onnxruntime session with one thread."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])


def latency_text(policy: Policy, session: Any, size: int) -> str:
    """Return both latencies for windows of `size` events, as text."""
    events = random_events(size)
    rows = np.stack([events[field].astype(np.int64) for field in "txyp"], axis=1)
    inputs = {"events": rows, "window_us": np.array(WINDOW_US), "first": np.array(False)}
    about = next(value for value in session.get_inputs() if value.name == "last_stack")
    kinds = {"tensor(float)": np.float32, "tensor(uint8)": np.uint8, "tensor(int32)": np.int32}
    inputs["last_stack"] = np.zeros(about.shape, kinds[about.type])
    taken = micros(lambda: policy.act(events, 0, WINDOW_US))
    other = np.median(micros(partial(session.run, None, inputs)))
    return f"{np.median(taken):,.0f} / {np.percentile(taken, 99):,.0f}; {other:,.0f}"


def micros(call: Callable[[], object]) -> np.ndarray:
    """Return the wall time of each call [us]."""
    taken = np.empty(CALLS + WARM)
    for k in range(len(taken)):
        start = time.perf_counter()
        call()
        taken[k] = time.perf_counter() - start
    return 1e6 * taken[WARM:]


def random_events(size: int) -> np.ndarray:
    """Return uniform events on the default sensor, sorted by time."""
    rng, camera = np.random.default_rng(0), EnvConfig().camera
    events = np.zeros(size, EVENT)
    events["t"] = np.sort(rng.integers(1, WINDOW_US + 1, size))
    events["x"], events["y"] = rng.integers(0, camera.width, size), rng.integers(0, camera.height, size)
    events["p"] = rng.choice([-1, 1], size)
    return events


if __name__ == "__main__":
    main()
