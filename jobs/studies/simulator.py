"""What exact events cost: every knob of the simulator, its cost against its event error.

Run: python -m platform.launch +exp=trade_simulator
Expect: about four minutes on one core. A table and a figure per scene with the Pareto front and the
default marked, and the events of each memory mode at each control rate, in the run folder
under `trade/` and in MLflow. An event error is measured against the converged simulation of
the same flights, see `envs.event_error`; a cost is process time of `CorridorEnv.step`.
"""

import dataclasses
import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from rich.table import Table

from envs.config import EnvConfig
from envs.corridor import CorridorEnv
from envs.event_error import Accuracy, measure_event_error
from jobs.analysis.tables import show
from jobs.config.conditions import env_with
from jobs.config.config import Config
from jobs.run.files import write_atomic
from jobs.run.folder import Run, finish, open_run
from jobs.run.progress import console, progress
from jobs.studies.front_plots import memory_figure, pareto, trade_figure
from jobs.tracking.tracker import Tracker, open_tracker

MEMORIES = ("reference", "frame", "legacy")
# Knob -> settings of it; every other setting is the default's. Renders are per default control step.
KNOBS: dict[str, list[dict[str, Any]]] = {
    "tolerance": [{"fidelity.tolerance": value} for value in (0.01, 0.02, 0.05, 0.1, 0.2, 0.5)],
    "renders": [{"renders": value} for value in (1, 2, 3, 4, 6, 8, 16)],
    "anti-aliasing": [{"fidelity.samples": value} for value in (1, 2, 4, 8)],
    "pyrender": [{"renderer": "pyrender", "fidelity.samples": value} for value in (1, 2, 4)],
    "encoding": [{"camera.encoding": value} for value in ("linear8", "gamma8")],
    "culling": [{"fidelity.cull_m": value} for value in (20.0, 30.0, 50.0, 70.0)],
    "memory": [{"camera.memory": value} for value in MEMORIES[1:]],
}


class Row(NamedTuple):
    """One setting in one scene.

    Attributes:
        knob: What is varied; "default" for the unchanged simulation.
        setting: To what.
        cost_us: Process time of an environment step [us].
        accuracy: What it achieves.
    """

    knob: str
    setting: str
    cost_us: float
    accuracy: Accuracy


def run(config: Config) -> dict[str, Any]:
    """Measure every setting, and show what it comes to."""
    folder = open_run(config)
    config = folder.config
    with open_tracker(config, folder) as tracker:
        figures: dict[str, float] = {}
        for scene in config.trade_simulator.scenes:
            figures |= trade_scene(config, folder, tracker, scene)
        figures |= trade_memory(config, folder, tracker)
        tracker.log(0, figures)
        console.print(tracker.dashboard(), markup=False)
    return finish(folder, "trade_simulator", figures)


def trade_scene(config: Config, folder: Run, tracker: Tracker, scene: str) -> dict[str, float]:
    """Cost against error in one scene; the figures of the default."""
    default = config.env_config(scene=scene, split="validation", observation="events")
    named = [("default", "", default)]
    for knob, settings in KNOBS.items():
        named += [(knob, setting_text(setting), changed(default, setting)) for setting in settings]
    trade = config.trade_simulator
    with progress(f"Trade in {scene}", len(named), "settings") as advance:
        accuracies = []
        for knob, _, simulation in named:
            accuracies.append(measure_event_error(simulation, trade.flights, trade.steps))
            advance(1, note=knob)
    costs = step_costs_us([simulation for *_, simulation in named], trade.steps, trade.rounds)
    rows = [
        Row(knob, setting, cost, accuracy)
        for (knob, setting, _), cost, accuracy in zip(named, costs, accuracies, strict=True)
    ]
    front = pareto([(row.cost_us, row.accuracy.error) for row in rows])
    text = markdown(rows, front)
    show(as_table(scene, rows, front))
    write_atomic(folder.path / "trade" / f"{scene}.md", text)
    tracker.text(f"trade/{scene}.md", text)
    tracker.table(f"trade/{scene}", columns(rows))
    figure = trade_figure(
        scene, [(*row[:3], row.accuracy.error) for row in rows], front, default.fidelity.tolerance
    )
    figure.savefig(folder.path / "trade" / f"{scene}.png", dpi=120)
    tracker.figure(f"trade/{scene}.png", figure)
    first = rows[0]
    return {f"sim/event_error_{scene}": first.accuracy.error, f"perf/env_step_us_{scene}": first.cost_us}


def trade_memory(config: Config, folder: Run, tracker: Tracker) -> dict[str, float]:
    """Events per second of flight at each control rate, for each memory mode; those at 200 Hz as figures."""
    trade = config.trade_simulator
    rates_hz = trade.control_hz
    events_hz: dict[str, list[float]] = {memory: [] for memory in MEMORIES}
    with progress("Memory modes", len(rates_hz) * len(MEMORIES), "simulations") as advance:
        for hz in rates_hz:
            # The same way at every rate: as many steps as fit into the time of the slowest.
            steps = max(1, round(trade.steps * hz / min(rates_hz) / 4))
            for memory in MEMORIES:
                default = config.env_config(control_hz=hz, split="validation")
                accuracy = measure_event_error(
                    env_with(default, {"camera.memory": memory}), trade.flights, steps
                )
                events_hz[memory].append(accuracy.events[0] * hz)
                advance(1, note=memory)
    figure = memory_figure(rates_hz, events_hz)
    figure.savefig(folder.path / "trade" / "memory.png", dpi=120)
    tracker.figure("trade/memory.png", figure)
    head = ["Memory", *(f"{hz:g} Hz" for hz in rates_hz)]
    lines = [[memory, *(f"{value:,.0f}" for value in values)] for memory, values in events_hz.items()]
    text = _markdown(head, lines)
    console.print(f"Events per second of flight\n{text}", markup=False)
    write_atomic(folder.path / "trade" / "memory.md", text)
    tracker.text("trade/memory.md", text)
    return {
        f"sim/events_per_second_{memory}_{hz:g}_hz": value
        for memory, values in events_hz.items()
        for hz, value in zip(rates_hz, values, strict=True)
    }


def step_costs_us(configs: Sequence[EnvConfig], steps: int, rounds: int) -> list[float]:
    """Process time of an environment step [us] in each simulation: medians of interleaved rounds."""
    envs = [CorridorEnv(config) for config in configs]
    costs = np.empty((rounds + 1, len(envs)))  # the first round compiles
    for turn in range(rounds + 1):
        for place, env in enumerate(envs):
            env.reset(seed=turn)
            count = max(1, steps if turn else 2)
            start = time.process_time()
            for _ in range(count):
                if any(env.step(0)[2:4]):
                    env.reset()
            costs[turn, place] = (time.process_time() - start) / count
    for env in envs:
        env.close()
    return (1e6 * np.median(costs[1:], axis=0)).tolist()


def changed(default: EnvConfig, setting: Mapping[str, Any]) -> EnvConfig:
    """The default with the settings of a knob replaced; "renders" is a number per control step."""
    for key, value in setting.items():
        if key == "renders":
            step_m = default.speed_mps / default.control_hz
            fidelity = dataclasses.replace(default.fidelity, max_step_m=step_m / value)
            default = dataclasses.replace(default, fidelity=fidelity)
        else:
            default = env_with(default, {key: value})
    return default


def setting_text(setting: Mapping[str, Any]) -> str:
    """The settings of a knob as text, such as "tolerance 0.1"."""
    return ", ".join(f"{key.rpartition('.')[2]} {value}" for key, value in setting.items())


def as_table(scene: str, rows: Sequence[Row], front: Sequence[int]) -> Table:
    """The rows for a terminal; * marks the Pareto front."""
    table = Table(title=f"Scene {scene}: one setting changed at a time", title_justify="left")
    for place, heading in enumerate(HEADINGS):
        table.add_column(heading, justify="left" if place < 2 else "right")
    for place, row in enumerate(rows):
        table.add_row(*_cells(row, place in front))
    return table


HEADINGS = ("Knob", "Setting", "Cost [us/step]", "Event error [%]", "Events/step", "Renders/step", "Front")


def _cells(row: Row, on_front: bool) -> tuple[str, ...]:
    accuracy = row.accuracy
    numbers = (f"{row.cost_us:,.0f}", f"{100 * accuracy.error:.1f}", f"{accuracy.events[0]:.0f}")
    return (row.knob, row.setting, *numbers, f"{accuracy.renders:.0f}", "*" if on_front else "")


def markdown(rows: Sequence[Row], front: Sequence[int]) -> str:
    """The rows as a Markdown table."""
    return _markdown(HEADINGS, [_cells(row, place in front) for place, row in enumerate(rows)])


def _markdown(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    rule = ["---:" if place else "---" for place in range(len(head))]
    return "\n".join("| " + " | ".join(line) + " |" for line in (head, rule, *lines)) + "\n"


def columns(rows: Sequence[Row]) -> dict[str, list[str | float]]:
    """The rows as columns for a tracker; the first is unique."""
    return {
        "setting": [f"{row.knob} {row.setting}".strip() for row in rows],
        "cost_us": [row.cost_us for row in rows],
        "event_error": [row.accuracy.error for row in rows],
        "events_per_step": [row.accuracy.events[0] for row in rows],
        "renders_per_step": [row.accuracy.renders for row in rows],
    }
