"""Compare training steps of the event VAE: fused or plain context network, and one thread or two.

Run `OMP_NUM_THREADS=1 OMP_WAIT_POLICY=PASSIVE python -m benchmarks.context [repeats]` from the repository
root; it prints as JSON the CPU seconds per training step of both forms, interleaved in one process, and their
ratio; then seconds per step with one thread and with two, interleaved, which need two idle cores. The system
maps the plain form's tensors of 400 MB page by page in every step, which doubles its time. To reuse memory,
also set `MALLOC_MMAP_MAX_=0 MALLOC_TRIM_THRESHOLD_=100000000000 MALLOC_TOP_PAD_=1000000000` (glibc).
"""

import json
import sys
import time
from collections.abc import Callable

import numpy as np
import torch

from models.encoder.evae import EventVAE, event_targets, train_step
from models.encoder.event_batch import EventBatch


def random_batch(evae: EventVAE, windows: int, events: int, rng: np.random.Generator) -> EventBatch:
    """Return `windows` windows of `events` uniform events each, sorted by time."""
    grid, total = evae.grid, windows * events
    code = rng.integers(0, 2 * grid.width * grid.height, total, dtype=np.int32)
    bins = np.sort(rng.integers(0, grid.time_bins, (windows, events), dtype=np.int32)).ravel()
    return EventBatch(grid, code, bins, np.arange(windows + 1, dtype=np.int64) * events)


def compare(variant: str, windows: int = 50, events: int = 2000, repeats: int = 3) -> dict[str, float]:
    """Return CPU seconds of one update of both forms, at the appendix's batch (B.2: 50 x 2000), one thread.

    Args:
        variant: "bytestream" or "bytestream_xy".
        windows: Windows per batch.
        events: Events per window.
        repeats: Timed updates of the plain form; the fused form gets five times as many.

    Returns:
        plain_s, fused_s (medians), ratio of the medians, ratio_of_minima.
    """
    torch.set_num_threads(1)
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    evae = EventVAE(variant)
    optimizer = torch.optim.Adam(evae.parameters(), lr=1e-3, fused=True)
    batch = random_batch(evae, windows, events, rng)
    targets = event_targets(batch, evae.target)

    def step() -> None:
        train_step(evae, optimizer, batch, targets, 1e-5, rng)

    step()
    fused, plain = [], []
    for _ in range(repeats):
        fused += [seconds(step) for _ in range(5)]
        evae.ecn.forward = evae.ecn.plain
        plain.append(seconds(step))
        del evae.ecn.forward
    return {
        "plain_s": float(np.median(plain)),
        "fused_s": float(np.median(fused)),
        "ratio": float(np.median(plain) / np.median(fused)),
        "ratio_of_minima": min(plain) / min(fused),
    }


def compare_threads(windows: int = 50, events: int = 2000, repeats: int = 20) -> dict[str, float]:
    """Return seconds of one update of the fused form, with one and two threads; arguments as in `compare`.

    Returns:
        one_s, two_s (medians), ratio of the medians.
    """
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    evae = EventVAE(context=256, latent=32, target="occupancy")
    optimizer = torch.optim.Adam(evae.parameters(), lr=1e-3, fused=True)
    batch = random_batch(evae, windows, events, rng)
    targets = event_targets(batch, evae.target)
    found: dict[int, list[float]] = {1: [], 2: []}
    for _ in range(repeats + 1):  # the first round warms up
        for threads, times in found.items():
            torch.set_num_threads(threads)
            start = time.perf_counter()
            train_step(evae, optimizer, batch, targets, 1e-5, rng)
            times.append(time.perf_counter() - start)
    one, two = (float(np.median(times[1:])) for times in found.values())
    return {"one_s": one, "two_s": two, "ratio": one / two}


def seconds(call: Callable[[], None]) -> float:
    """Return the CPU time of one call [s] (user and system), which other processes disturb least."""
    start = time.process_time()
    call()
    return time.process_time() - start


if __name__ == "__main__":
    repeats = int(sys.argv[1]) if len(sys.argv) > 1 else 3
    found = {variant: compare(variant, repeats=repeats) for variant in ("bytestream", "bytestream_xy")}
    found["threads"] = compare_threads()
    sys.stdout.write(json.dumps(found, indent=2) + "\n")
