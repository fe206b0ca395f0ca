"""Measure the cost of a control step under each condition of the sweep, and its share of the whole sweep.

Run: OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python -m benchmarks.conditions
Expect: a table in about five minutes on one core: CPU time per control step and corridor with its
events, without a policy, in 7 parallel corridors with random actions; medians of interleaved rounds.
The share assumes the same simulated time for each condition. Conditions with the same simulation
are listed once.
"""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from benchmarks.throughput import composed
from envs.config import EnvConfig
from envs.corridor import CorridorVectorEnv
from jobs.analysis.tables import show_table
from jobs.config.conditions import axis_points
from jobs.config.env_keys import env_with
from jobs.measure.timing import interleaved
from jobs.rollout.tasks import text_of

CORRIDORS = 7  # per training and condition of the sweep
SIMULATED_S = 0.5  # of each round
ROUNDS = 3


def main() -> None:
    """Measure and print the table, the costliest first."""
    conditions = conditions_of_sweep()
    work = {name: stepping(env) for name, env in conditions.items()}
    seconds = interleaved(work, ROUNDS, time.process_time)
    steps = {name: CORRIDORS * round(SIMULATED_S * env.control_hz) for name, env in conditions.items()}
    whole = sum(seconds.values())
    rows = [
        (name, f"{1e6 * seconds[name] / steps[name]:,.0f}", f"{seconds[name] / whole:.1%}")
        for name in sorted(seconds, key=lambda name: -seconds[name])
    ]
    show_table(f"{len(rows)} conditions, one core", ("condition", "us/step", "of the simulation"), rows)


def conditions_of_sweep() -> dict[str, EnvConfig]:
    """Return name -> environment of each condition of conf/exp/robustness.yaml, each simulation once."""
    config = composed("+exp=robustness")
    nominal = replace(config.env, scene=config.own.scene, split="eval", window_capacity=None)
    found = {"nothing changed": nominal}
    for axis, settings in config.own.axes.items():
        for point in axis_points(settings):
            env = env_with(nominal, point)
            if env not in found.values():
                found[f"{axis} {text_of(next(iter(point.values())))}"] = env
    return found


def stepping(config: EnvConfig) -> Callable[[], object]:
    """Return a function that steps the same corridors from the start, with the same actions at each call."""
    env = CorridorVectorEnv(CORRIDORS, config)

    def run() -> None:
        rng = np.random.default_rng(0)
        env.reset(seed=0)
        for _ in range(round(SIMULATED_S * config.control_hz)):
            env.step(rng.integers(3, size=CORRIDORS))

    return run


if __name__ == "__main__":
    main()
