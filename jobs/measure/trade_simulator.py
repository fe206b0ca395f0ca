"""Measure what exact events cost: time and event error of each simulator setting.

Run: python -m platform.launch +exp=trade_simulator
Expect: about a minute on one core. A table and a plot per scene, which mark the default and the settings that
no other setting beats, and the events of each memory mode at each control rate; in the run folder under
`trade/` and in MLflow. The event error is measured against the converged simulation of the same flights, see
`envs.event_error`. The cost is process time of `CorridorEnv.step`.
"""

import dataclasses
import itertools
import time
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from envs.config import STRICT, EnvConfig, Positive
from envs.corridor import CorridorEnv
from envs.event_error import measure_event_error
from jobs.analysis.tables import publish_plot, publish_table
from jobs.config.conditions import env_with
from jobs.config.config import Config
from jobs.config.schema import Count, Name
from jobs.measure.measured import Measured, columns, pareto
from jobs.measure.plots import plot_costs, plot_memory_modes
from jobs.measure.timing import interleaved
from jobs.run.folder import Run, finish, open_run
from jobs.run.progress import console, progress
from jobs.tracking.tracker import Tracker, open_tracker

Setting = Mapping[str, float | str]  # key of the simulation -> value
MEMORIES = ("reference", "frame", "legacy")
# Knob -> its settings; all other settings are the default's. Renders are per default control step.
KNOBS: dict[str, list[Setting]] = {
    "tolerance": [{"fidelity.tolerance": value} for value in (0.01, 0.02, 0.1, 0.2, 0.5)],  # 0.05: default
    "renders": [{"renders": value} for value in (1, 2, 3, 4, 6, 8, 16)],
    "anti-aliasing": [{"fidelity.samples": value} for value in (1, 2, 4, 8)],
    "pyrender": [{"renderer": "pyrender", "fidelity.samples": value} for value in (1, 2, 4)],
    "encoding": [{"camera.encoding": value} for value in ("linear8", "gamma8")],
    "culling": [{"fidelity.cull_m": value} for value in (20.0, 30.0, 50.0, 70.0)],
    "memory": [{"camera.memory": value} for value in MEMORIES[1:]],
}
NOISE = 0.05  # relative difference between repeated measurements of a cost
HEADINGS = ("Knob", "Setting", "Cost [us/step]", "Event error [%]", "Events/step", "Renders/step", "Best")


@dataclass(frozen=True, config=STRICT)
class Settings:
    """Settings for measuring the simulator's event error and cost.

    Attributes:
        flights: Number of corridors for measuring errors.
        steps: Control steps in each corridor, and in each round of timing.
        rounds: Rounds of timing.
    """

    scenes: Annotated[list[Name], Field(min_length=1)]
    control_hz: Annotated[list[Positive], Field(min_length=1)]
    flights: Count
    steps: Count
    rounds: Count


def run(config: Config) -> dict[str, float]:
    """Measure every setting; return the metrics of the default."""
    folder = open_run(config)
    config = folder.config
    with open_tracker(config, folder) as tracker:
        metrics: dict[str, float] = {}
        for scene in config.own.scenes:
            metrics |= trade_scene(folder, tracker, scene)
        metrics |= trade_memory(folder, tracker)
        tracker.log(0, metrics)
        console.print(tracker.dashboard(), markup=False)
    return finish(folder, "trade_simulator", metrics)


def trade_scene(folder: Run, tracker: Tracker, scene: str) -> dict[str, float]:
    """Measure cost and error of every setting in one scene; return the metrics of the default."""
    config = folder.config
    default = dataclasses.replace(config.env, scene=scene, split="validation", observation="events")
    named = [("default", "", default)]
    for knob, settings in KNOBS.items():
        named += [(knob, setting_text(setting), changed(default, setting)) for setting in settings]
    trade = config.own
    with progress(f"Trade in {scene}", len(named), "settings") as advance:
        accuracies = []
        for knob, _, simulation in named:
            accuracies.append(measure_event_error(simulation, trade.flights, trade.steps))
            advance(1, note=knob)
    costs = step_costs_us([simulation for *_, simulation in named], trade.steps, trade.rounds)
    rows = [
        Measured(knob, setting, cost, found.error, {"events": found.events[0], "renders": found.renders})
        for (knob, setting, _), cost, found in zip(named, costs, accuracies, strict=True)
    ]
    front = pareto([(row.cost_us, row.error) for row in rows], NOISE)
    title = f"Scene {scene}: one setting changed at a time; * no other is better"
    lines = [setting_cells(row, place in front) for place, row in enumerate(rows)]
    publish_table(folder, tracker, f"trade/{scene}", title, HEADINGS, lines, 2)
    tracker.table(f"trade/{scene}", columns(rows))
    plot = plot_costs(scene, rows, front, default.fidelity.tolerance)
    publish_plot(folder, tracker, f"trade/{scene}", plot)
    return {
        f"sim/event_error_{scene}": rows[0].error,
        f"perf/env_step_us_{scene}": rows[0].cost_us,
    }


def trade_memory(folder: Run, tracker: Tracker) -> dict[str, float]:
    """Measure events per second of flight at each control rate for each memory mode; return the metrics."""
    config, trade = folder.config, folder.config.own
    rates_hz = trade.control_hz
    events_hz: dict[str, list[float]] = {memory: [] for memory in MEMORIES}
    with progress("Memory modes", len(rates_hz) * len(MEMORIES), "simulations") as advance:
        for hz in rates_hz:
            # The same distance at every rate: the number of steps is proportional to the rate.
            steps = max(1, round(trade.steps * hz / min(rates_hz) / 4))
            for memory in MEMORIES:
                default = dataclasses.replace(config.env, control_hz=hz, split="validation")
                accuracy = measure_event_error(
                    env_with(default, {"camera.memory": memory}), trade.flights, steps
                )
                events_hz[memory].append(accuracy.events[0] * hz)
                advance(1, note=memory)
    head = ["Memory", *(f"{hz:g} Hz" for hz in rates_hz)]
    lines = [[memory, *(f"{value:,.0f}" for value in values)] for memory, values in events_hz.items()]
    publish_table(folder, tracker, "trade/memory", "Events per second of flight", head, lines)
    publish_plot(folder, tracker, "trade/memory", plot_memory_modes(rates_hz, events_hz))
    return {
        f"sim/events_per_second_{memory}_{hz:g}_hz": value
        for memory, values in events_hz.items()
        for hz, value in zip(rates_hz, values, strict=True)
    }


def step_costs_us(configs: Sequence[EnvConfig], steps: int, rounds: int) -> list[float]:
    """Return the process time of an environment step [us] in each simulation, in interleaved rounds."""
    envs = dict(enumerate(map(CorridorEnv, configs)))
    turns = {place: itertools.count() for place in envs}
    work = {place: partial(_take_steps, env, steps) for place, env in envs.items()}
    before = {place: lambda place=place: envs[place].reset(seed=next(turns[place])) for place in envs}
    seconds = interleaved(work, rounds, time.process_time, before)
    for env in envs.values():
        env.close()
    return [1e6 * seconds[place] / steps for place in envs]


def _take_steps(env: CorridorEnv, steps: int) -> None:
    for _ in range(steps):
        if any(env.step(0)[2:4]):
            env.reset()


def changed(default: EnvConfig, setting: Setting) -> EnvConfig:
    """Return the default with some settings replaced; "renders" is the number of renders per control step."""
    for key, value in setting.items():
        if key == "renders":
            step_m = default.speed_mps / default.control_hz
            fidelity = dataclasses.replace(default.fidelity, max_step_m=step_m / float(value))
            default = dataclasses.replace(default, fidelity=fidelity)
        else:
            default = env_with(default, {key: value})
    return default


def setting_text(setting: Setting) -> str:
    """Return a setting as text, such as "tolerance 0.1"."""
    return ", ".join(f"{key.rpartition('.')[2]} {value}" for key, value in setting.items())


def setting_cells(row: Measured, on_front: bool) -> tuple[str, ...]:
    """Return a text for each of `HEADINGS`."""
    events, renders = row.outcome["events"], row.outcome["renders"]
    numbers = (f"{row.cost_us:,.0f}", f"{100 * row.error:.1f}", f"{events:.0f}", f"{renders:.1f}")
    return (row.knob, row.setting, *numbers, "*" if on_front else "")
