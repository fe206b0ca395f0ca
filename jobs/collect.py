"""Fly at random through training corridors and record every event.

Run: python -m platform.launch +exp=collect
Expect: about 3,000 control steps per second on one core; `data/train.h5` and
`data/validation.h5` in the run folder, each of whole flights that no other file shares.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from envs.config import EnvConfig, sensor_settings, settings_hash
from envs.corridor import CorridorEnv
from envs.events import EVENT
from envs.recordings import Recording, write_recording
from jobs.accuracy import achieved
from jobs.config import Config
from jobs.progress import progress
from jobs.runs import Run, finish, finished, open_run
from jobs.tracking import Tracker, open_tracker

FLIGHT_GAP_US = 1_000_000
MEAN_HOLD_M = 2.0


def run(config: Config) -> dict[str, Any]:
    """Collect the data sets of a run; return its folder."""
    folder = open_run(config)
    with open_tracker(folder.config, folder) as tracker:
        return collect(folder.config, folder, tracker)


def collect(config: Config, folder: Run, tracker: Tracker) -> dict[str, Any]:
    """Write the training and validation recordings of a run, unless they are there already."""
    done = finished(folder, "collect")
    if done is not None:
        return done
    sizes = {"train": config.collect.num_steps, "validation": config.collect.num_validation_steps}
    figures: dict[str, Any] = {}
    with progress("Collect flights", sum(sizes.values()), "steps") as advance:
        for split, num_steps in sizes.items():
            scenes = config.collect.scenes
            shares = [len(part) for part in np.array_split(np.arange(num_steps), len(scenes))]
            flights = [
                (config.env_config(scene=scene, split=split, observation="events"), share)
                for scene, share in zip(scenes, shares, strict=True)
            ]
            recording = record(flights, config.seed, advance)
            write_recording(data_file(folder, split), recording)
            figures[f"collect/{split}_events"] = len(recording.events)
            figures[f"collect/{split}_flights"] = recording.about["flights"]
    figures |= achieved(config.env_config(scene=config.collect.scenes[0]))
    tracker.log(0, figures)
    return finish(folder, "collect", figures)


def data_file(folder: Run, split: str) -> Path:
    """Where the recording of a split lives in a run folder."""
    return folder.data / f"{split}.h5"


def record(flights: list[tuple[EnvConfig, int]], seed: int, advance: Callable[[int], None]) -> Recording:
    """Fly each environment for a number of control steps; join all flights on one clock.

    Args:
        flights: Environment and number of control steps [-], one pair per scene.
        seed: Seed of corridors and actions.
        advance: Told the number of steps after each flight.

    Returns:
        Events of all flights, `FLIGHT_GAP_US` apart. `index` holds `step_t_us`, `step_end_us`
        and `step_flight` (start and end [us] and flight number of each step).
    """
    parts: list[np.ndarray] = []
    steps: list[tuple[int, int, int]] = []
    clock_us, flight = 0, 0
    for config, num_steps in flights:
        env = CorridorEnv(config)
        rng = np.random.default_rng(np.random.SeedSequence([seed, len(parts), 1]))
        flown = 0
        env.reset(seed=seed)
        while flown < num_steps:
            flight_events, ends_us = fly_at_random(env, rng, num_steps - flown)
            for events in flight_events:
                shifted = events.copy()
                shifted["t"] += clock_us
                parts.append(shifted)
            steps += [
                (clock_us + start, clock_us + end, flight)
                for start, end in zip([0, *ends_us], ends_us, strict=False)
            ]
            flown += len(ends_us)
            flight += 1
            clock_us += ends_us[-1] + FLIGHT_GAP_US
            advance(len(ends_us))
            env.reset()
    start, end, number = np.array(steps, dtype=np.int64).T
    settings = sensor_settings(flights[0][0])
    about = {
        "sensor": settings,
        "sensor_hash": settings_hash(settings),
        "scenes": [config.scene for config, _ in flights],
        "faults": [dataclasses.asdict(config.faults) for config, _ in flights],
        "seed": seed,
        "flights": flight,
    }
    index = {"step_t_us": start, "step_end_us": end, "step_flight": number}
    return Recording(np.concatenate([np.empty(0, EVENT), *parts]), index, about)


def fly_at_random(
    env: CorridorEnv, rng: np.random.Generator, most_steps: int
) -> tuple[list[np.ndarray], list[int]]:
    """One flight of a freshly reset environment: each action is held for 2 m on average.

    Returns:
        The events of each step, and the time at which each step ended [us since take-off].
    """
    hold_steps = max(1.0, MEAN_HOLD_M * env.config.control_hz / env.config.speed_mps)
    events, ends_us = [], []
    action = int(rng.integers(3))
    for _ in range(most_steps):
        if rng.random() < 1.0 / hold_steps:
            action = int(rng.integers(3))
        _, _, terminated, truncated, info = env.step(action)
        events.append(env.events)
        ends_us.append(int(info["t_us"]))
        if terminated or truncated:
            break
    return events, ends_us
