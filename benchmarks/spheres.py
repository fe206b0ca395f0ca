"""Measure a control step among hundreds of spheres, with `renderer=raycast` and with `renderer=spheres`.

Run: python -m benchmarks.spheres
Expect: a table in about a minute on one core. All rows fly the same point mass at 10 m/s, 5 m above the
ground, in the same worlds, in interleaved rounds. Which of two overlapping spheres `raycast` draws depends
on the column in which its strip begins, so it also produces false events.
"""

from functools import partial

import numpy as np

from envs.config import EnvConfig, FidelityConfig
from envs.corridor import CorridorVectorEnv
from jobs.analysis.tables import show_table
from jobs.measure.timing import interleaved

WORLDS, STEPS = 4, 20
RENDERED = {
    "tolerance 0.5, within 12 m": FidelityConfig(tolerance=0.5, samples=1, cull_m=12.0),
    "tolerance 0.5, within 20 m": FidelityConfig(tolerance=0.5, samples=1, cull_m=20.0),
    "tolerance 0.05": FidelityConfig(),
}


def main() -> None:
    """Measure and print the table."""
    worlds = {
        (name, renderer): EnvConfig(
            scene="spheres",
            layout={"passable": False},
            renderer=renderer,
            fidelity=fidelity,
            vehicle="point_mass",
            body={"primitives": 15},
            speed_mps=10.0,
            control_hz=100.0,
            camera_height_m=5.0,
            window_capacity=4096,
        )
        for name, fidelity in RENDERED.items()
        for renderer in ("raycast", "spheres")
    }
    counts: dict[tuple[str, str], float] = {}

    def fly(key: tuple[str, str]) -> None:
        envs = CorridorVectorEnv(WORLDS, worlds[key])
        envs.reset(seed=0)
        rng, events = np.random.default_rng(0), 0
        for _ in range(STEPS):
            events += int(np.sum(envs.step(rng.integers(15, size=WORLDS))[4]["num_events"]))
        counts[key] = events / STEPS / WORLDS

    seconds = interleaved({key: partial(fly, key) for key in worlds})
    rows = []
    for name in RENDERED:
        strips, discs = (seconds[name, renderer] / STEPS / WORLDS for renderer in ("raycast", "spheres"))
        seen = [f"{counts[name, renderer]:,.0f}" for renderer in ("raycast", "spheres")]
        rows.append((name, f"{1e3 * strips:.1f}", f"{1e3 * discs:.2f}", f"{strips / discs:.1f}", *seen))
    head = ("rendered", "ms, raycast", "ms, spheres", "ratio", "events, raycast", "events, spheres")
    show_table("A control step in the worlds of the DodgeDrone generator", head, rows)


if __name__ == "__main__":
    main()
