"""Compare PPO on event images with its gradients on the CPU and on a GPU, in interleaved rounds.

Run: OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python -m benchmarks.gpu
Expect: a table in one to two minutes; without a GPU, a line that says so. An iteration samples 2,048
steps and learns 10 epochs: `ppo` in one process with minibatches of 32, `ppo_fast` with two sampling
processes, two threads of the learner, and minibatches of 256. Wall time, medians over the rounds.
"""

import os
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

from benchmarks.throughput import composed
from jobs.analysis.tables import show_table
from jobs.measure.timing import interleaved
from jobs.run.device import LEARNER_DEVICE
from jobs.run.progress import console
from jobs.run.ray_cluster import start_ray
from jobs.training.algorithms import build_algorithm

ROUNDS = 3
STEPS = 2048  # of an iteration (appendix D.1.2)
ALGORITHMS = ("ppo", "ppo_fast")
DEVICES = ("cpu", "cuda")


def main() -> None:
    """Measure and print the table."""
    if not torch.cuda.is_available():
        console.print("benchmarks.gpu: torch sees no GPU here, nothing is measured", markup=False)
        return
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        seconds = interleaved(trainings(Path(folder)), ROUNDS)
    rows = [
        (algorithm, device, f"{STEPS / value:,.0f}", f"{seconds[algorithm, 'cpu'] / value:.1f}x")
        for (algorithm, device), value in seconds.items()
    ]
    console.print(f"{torch.cuda.get_device_name()}, {os.cpu_count()} cores", markup=False)
    title = f"PPO of event_image: iterations of {STEPS:,} steps that take turns, medians"
    show_table(title, ("algo", "device", "steps/s", "of the processor's"), rows)


def trainings(folder: Path) -> dict[tuple[str, str], Callable[[], object]]:
    """Return a function for one iteration of each algorithm on each device."""
    work: dict[tuple[str, str], Callable[[], object]] = {}
    for algorithm in ALGORITHMS:
        for device in DEVICES:
            config = composed(f"algo={algorithm}", "model=event_image", "algo.lr_schedule=constant")
            # All four exist at once: with only two cores, Ray would let one of them wait forever.
            start_ray(replace(config.cluster, num_cpus=4), folder)
            os.environ[LEARNER_DEVICE] = device  # read when the learner is built, in this process
            work[algorithm, device] = build_algorithm(config).build_algo().train
    return work


if __name__ == "__main__":
    main()
