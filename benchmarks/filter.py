"""Measure the shares of true and false events that pass the neighbour filter, by condition.

Run: python -m benchmarks.filter
Expect: a table in about a minute on one core: in 8 corridors, the shares of true and of false events that
pass the filter with k = 1, 2 and 3 of 8 neighbours within 5 ms.
"""

import numpy as np

from core.neighbour_filter import filter_neighbours, quiet_sensor
from envs.config import EnvConfig
from envs.corridor import CorridorVectorEnv
from jobs.analysis.tables import show_table
from jobs.config.env_keys import env_with

CORRIDORS, TAU_US = 8, 5000
SUPPORTS = (1, 2, 3)
NIGHT: dict[str, object] = {
    "faults.shot_noise_hz": 5.0, "faults.leak_hz": 0.1,
    "faults.hot_pixel_share": 0.005, "faults.hot_pixel_hz": 100.0,
}  # fmt: skip
CONDITIONS: dict[str, dict[str, object]] = {
    "nominal": {},
    "false events 10 %": {"faults.background_activity": 0.1},
    "false events 25 %": {"faults.background_activity": 0.25},
    "night": NIGHT,
    "45 Hz, false events 10 %": {"env.control_hz": 45.0, "faults.background_activity": 0.1},
    "800 Hz, false events 10 %": {"env.control_hz": 800.0, "faults.background_activity": 0.1},
    "threshold 0.05, false events 10 %": {
        "camera.contrast_threshold": 0.05,
        "faults.background_activity": 0.1,
    },
    "threshold 0.4, false events 10 %": {
        "camera.contrast_threshold": 0.4,
        "faults.background_activity": 0.1,
    },
    "half of the pixels dead, false events 10 %": {"faults.sparsity": 0.5, "faults.background_activity": 0.1},
    "other textures, false events 10 %": {
        "env.scene": "texture_change",
        "fidelity.tolerance": 0.2,
        "faults.background_activity": 0.1,
    },
}


def main() -> None:
    """Measure and print the table."""
    head = ["condition", "events a step", "of them false"]
    head += [f"{what} that pass, k={k}" for k in SUPPORTS for what in ("true", "false")]
    rows = [(name, *line(measure(changes))) for name, changes in CONDITIONS.items()]
    show_table("Events that the neighbour filter leaves [%]", head, rows, len(head))


def measure(changes: dict[str, object]) -> np.ndarray:
    """Return counts, float64: steps, true and false events, and both that pass with each of `SUPPORTS`."""
    env = CorridorVectorEnv(CORRIDORS, env_with(EnvConfig(window_capacity=None, split="validation"), changes))
    env.reset(seed=0)
    rng, counts = np.random.default_rng(0), np.zeros(3 + 2 * len(SUPPORTS))
    maps = [[quiet_sensor(64, 64) for _ in SUPPORTS] for _ in env.envs]
    running = np.arange(CORRIDORS)
    while running.size:
        _, _, terminated, truncated, _ = env.step_some(rng.integers(3, size=running.size), running)
        for row in running:
            events, real = env.envs[row].events, set(env.envs[row].true_events.tolist())
            counts[0] += 1
            counts[1:3] += split(events, real)
            for place, support in enumerate(SUPPORTS):
                kept = filter_neighbours(events, maps[row][place], support, TAU_US)
                counts[3 + 2 * place : 5 + 2 * place] += split(kept, real)
        running = running[~(terminated | truncated)]
    return counts


def split(events: np.ndarray, real: set[tuple[int, ...]]) -> tuple[int, int]:
    """Return the numbers of true and of false events."""
    true = sum(event in real for event in events.tolist())
    return true, events.size - true


def line(counts: np.ndarray) -> list[str]:
    """Return the cells of a row."""
    steps, true, false = counts[:3]
    passed = counts[3:].reshape(-1, 2) / np.maximum([true, false], 1)
    cells = [f"{100 * share:.1f}" for pair in passed for share in pair]
    if not false:
        cells[1::2] = ["-"] * len(SUPPORTS)
    return [f"{(true + false) / steps:.0f}", f"{100 * false / (true + false):.0f}", *cells]


if __name__ == "__main__":
    main()
