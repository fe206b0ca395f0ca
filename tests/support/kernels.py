"""Compiles the kernels, and what only tests use of them: python -m tests.support.kernels."""

import numpy as np

from benchmarks.latency import random_policy
from envs.scene import make_scene
from jobs.run import compile
from tests.support.looks import HEIGHT, WIDTH, Looker
from tests.support.point_samples import sample_luminance


def main() -> None:
    """Ask policies what to do, and call some kernels by themselves, which is compiled apart."""
    compile.main("all")
    for threshold_mismatch in (0.0, 0.1):
        Looker(np.ones((HEIGHT, WIDTH), np.float32), threshold_mismatch=threshold_mismatch).look(
            (np.zeros((HEIGHT, WIDTH), np.float32), 0, WIDTH, 1000)
        )
    sample_luminance(make_scene("poles", np.random.default_rng(0)), (0.0, 0.0, 2.0, 0.0), 8, 8)
    for name in ("bytestream", "event_image", "event_set"):
        random_policy(name).event_logits(compile.some_events(), 0, 5000)


if __name__ == "__main__":
    main()
