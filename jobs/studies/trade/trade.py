"""What exactness costs from end to end: for each setting of simulator and encoder, cost, errors and success.

Run: python -m platform.launch +exp=trade
Expect: by estimate a quarter of an hour on two idle cores. In the run folder under `trade/`, and in
MLflow, a table, a figure, and the page that says what to choose, which `+exp=report` puts into docs/.
One policy, `trade.policy`, flies the same corridors under every setting. A stopped job continues when
the same command is given again: what was flown is never flown twice; costs and errors are measured
anew.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import pydantic
import torch

from envs.config import EnvConfig, settings_hash
from envs.corridor import CorridorEnv
from envs.event_error import converged
from jobs.analysis.statistics import paired_rate_difference
from jobs.analysis.tables import draw_figure, publish_table, summarise
from jobs.config.config import HELD_OUT_SCENE, Config, ConfigError
from jobs.rollout.agents import PolicyAgent, make_agent
from jobs.rollout.executors import Executor
from jobs.rollout.policies import EvaluatedPolicy, find_policies, with_sensor
from jobs.rollout.scheduler import default_executor, evaluate_tasks
from jobs.rollout.store import EpisodeStore
from jobs.rollout.tasks import EvaluationTask, make_task
from jobs.run.files import write_atomic, write_json
from jobs.run.folder import Run, finish, locate_run, open_run
from jobs.run.progress import console, progress
from jobs.run.provenance import command, provenance, today
from jobs.studies.encoder.costs import CAPS, TIME_BINS
from jobs.studies.encoder.trade import EVENT_ENCODERS
from jobs.studies.front_plots import choice_figure
from jobs.studies.replays import Measured, measure
from jobs.studies.simulator import KNOBS, changed, setting_text
from jobs.studies.trade.page import DEFAULT, EXACT, HEADINGS, Row, lines, metrics, page, panels, verdict
from jobs.tracking.child_runs import Child, write_children
from jobs.tracking.tracker import Tracker, open_tracker
from models.encoder.evae import EventVAE
from models.encoder.table import PRECISIONS
from models.encoder.weights import load_encoder
from models.policy.policy import ENCODER

# Knob of the simulator's trade -> which of its settings fly: the whole of its span.
SPANS = {
    "tolerance": slice(1, None),
    "renders": slice(2),
    "anti-aliasing": slice(1, None, 2),
    "pyrender": slice(2),
    "encoding": slice(None),
    "culling": slice(None, None, 2),
    "memory": slice(None),
}
Changes = dict[str, Any]
# Several at once, of the simulation and of the table; the paper's camera sees one 8-bit frame a step.
TOGETHER: dict[str, tuple[Changes, Changes]] = {
    "coarse": ({"fidelity.tolerance": 0.5}, {"precision": PRECISIONS[-1]}),
    "the paper's camera": ({"camera.memory": "frame", "camera.encoding": "gamma8"}, {}),
}


def run(config: Config, executor: Executor | None = None) -> dict[str, Any]:
    """Evaluate and measure every setting, and say what to choose; return the default's metrics.

    Args:
        config: The experiment.
        executor: Computes the missing episodes; None: on all cores.

    Raises:
        ConfigError: The policy has no frozen encoder of single events.
        RuntimeError: The default or the most exact setting failed.
    """
    policy, evae = find_encoder_policy(config)
    folder = open_run(config)
    config = folder.config
    every = plan(config, policy, evae)
    place = folder.path / "trade"
    store, executor = EpisodeStore(place), executor or default_executor(config.cluster, place)
    identity = settings_hash({"cells": [[task.key, len(task.seeds)] for task in every]})
    with open_tracker(config, folder, key=f"trade {identity[:8]}") as tracker:
        tracker.tags({"kind": "trade", "policy": policy.group})
        results, failed = evaluate_tasks(every, store, executor, "Trade", measure_accuracy=False)
        for task in (every[0], every[-1]):
            if task.key in failed:
                what, reason = task.condition[0], failed[task.key]
                raise RuntimeError(f"{what}: not evaluated: {reason}; the same command tries again")
        able = [task for task in every if task.key in results]
        usual = results[every[0].key].episodes
        rows = [
            row_of(task, measured, results[task.key].episodes, usual)
            for task, measured in zip(able, replay_all(config, able, evae), strict=True)
        ]
        reasons = {" ".join(task.condition): failed[task.key] for task in every if task.key in failed}
        publish(folder, tracker, rows, about(config, folder, policy, every[0].env, reasons))
        tracker.log(0, metrics(rows[0]))
        console.print(tracker.dashboard(), markup=False)
    return finish(folder, "trade", metrics(rows[0]))


def find_encoder_policy(config: Config) -> tuple[EvaluatedPolicy, EventVAE]:
    """The policy that is evaluated, and its encoder.

    Raises:
        ConfigError: If `trade.policy` names none, several, or one that has no such encoder.
    """
    name = config.trade.policy
    policy, *others = find_policies("trade.policy", name, config, locate_run(config))
    file = Path(policy.agent) / ENCODER
    if not others and file.is_file():
        evae, _ = load_encoder(file)
        if evae.settings["variant"] in EVENT_ENCODERS and evae.ecn.coding != "eventnet":
            return policy, evae
    rule = f"must be one policy with a frozen encoder of {' or '.join(EVENT_ENCODERS)}, not EventNet's"
    raise ConfigError(f"trade.policy: {rule}, got {name!r}")


def plan(config: Config, policy: EvaluatedPolicy, evae: EventVAE) -> list[EvaluationTask]:
    """The settings as tasks, the default first and the most exact last; none twice.

    Raises:
        ConfigError: If the policy's own sensor and a setting exclude each other.
    """
    own = with_sensor(dataclasses.replace(config.env, scene=HELD_OUT_SCENE, split="eval"), policy.sensor)
    timed = evae.ecn.coding != "none"
    found: dict[str, EvaluationTask] = {}
    for knob, text, simulation, table in changes(timed):
        try:
            env = changed(own, simulation)
        except pydantic.ValidationError as error:
            reason = error.errors()[0]["msg"]
            raise ConfigError(f"trade.policy: {simulation} with its own sensor: {reason}") from None
        task = _task(config, policy, (knob, text), env, table)
        found.setdefault(task.key, task)
    table = {"time_bins": TIME_BINS[-1]} if timed else {}
    return [*found.values(), _task(config, policy, (EXACT, ""), exact_env(own), table)]


def changes(timed: bool) -> list[tuple[str, str, Changes, Changes]]:
    """What is changed: nothing, each setting of the simulator, each of the encoder, and several at once.

    Args:
        timed: Whether the encoder sees time.

    Returns:
        Knob, setting, what changes of the simulation, what of the encoder's table.
    """
    found: list[tuple[str, str, Changes, Changes]] = [(DEFAULT, "", {}, {})]
    for knob, span in SPANS.items():
        found += [(knob, setting_text(setting), setting, {}) for setting in KNOBS[knob][span]]
    found += [("precision", name, {}, {"precision": name}) for name in PRECISIONS[1:]]
    if timed:
        found += [
            ("time bins", str(bins), {}, {"time_bins": bins}) for bins in (*TIME_BINS[:2], TIME_BINS[-1])
        ]
    found += [("newest events", str(most), {"env.window_capacity": most}, {}) for most in CAPS[:2]]
    return found + [("together", name, *both) for name, both in TOGETHER.items()]


def exact_env(env: EnvConfig) -> EnvConfig:
    """The converged simulation, see `envs.event_error`."""
    corridor = CorridorEnv(env, observation="none")
    corridor.reset(seed=0)
    return converged(env, corridor.scene)


def _task(
    config: Config,
    policy: EvaluatedPolicy,
    condition: tuple[str, str],
    env: EnvConfig,
    table: Mapping[str, Any],
) -> EvaluationTask:
    trade = config.trade
    trials = min(trade.trials, trade.pyrender_trials) if env.renderer == "pyrender" else trade.trials
    return make_task(condition, policy, config.evaluate.action, env, trials, tuple(table.items()))


def replay_all(config: Config, every: Sequence[EvaluationTask], evae: EventVAE) -> list[Measured]:
    """Cost and errors of each task's setting on the recorded flights."""
    torch.set_num_threads(1)
    agents = [make_agent(task.policy.agent, task.action, task.table) for task in every]
    settings = [(task.env, cast(PolicyAgent, agent)) for task, agent in zip(every, agents, strict=True)]
    seeds = range(config.trade.replays)
    with progress("Replay", len(seeds) * len(settings), "flights") as advance:
        return measure(settings, evae, seeds, advance)


def row_of(task: EvaluationTask, measured: Measured, episodes: np.ndarray, usual: np.ndarray) -> Row:
    """The row of a task, beside the default's episodes."""
    difference = paired_rate_difference(episodes["success"], usual["success"][: len(episodes)])
    return Row(*task.condition, measured, summarise(task.condition, episodes), difference)


def about(
    config: Config, folder: Run, policy: EvaluatedPolicy, env: EnvConfig, failed: Mapping[str, str]
) -> dict[str, Any]:
    """What made the figures: command, commit, machine and date, policy and corridors."""
    return {
        "run": folder.path.name,
        "command": command(),
        "date": today(),
        **provenance(),
        "policy": f"{policy.group}-s{policy.training}",
        "scene": env.scene,
        "action": config.evaluate.action,
        "trials": config.trade.trials,
        "replays": config.trade.replays,
        "failed": dict(failed),
    }


def publish(folder: Run, tracker: Tracker, rows: Sequence[Row], facts: Mapping[str, Any]) -> None:
    """Print the table; write it, the figure and the page into run folder and tracker, a child run a row."""
    place = folder.path / "trade"
    (place / "images").mkdir(parents=True, exist_ok=True)
    publish_table(folder, tracker, "trade/table", "What each setting costs and gives", HEADINGS, lines(rows))
    named = [(row.knob, row.setting, row.steps_per_s) for row in rows]
    draw_figure(folder, tracker, "trade/images/trade", choice_figure(named, panels(rows)))
    text = page(facts, rows)
    write_atomic(place / "trade.md", text)
    tracker.text("trade/trade.md", text)
    children = [
        Child(row.name, {"knob": row.knob, "setting": row.setting}, {"verdict": verdict(row)}, metrics(row))
        for row in rows
    ]
    write_children(tracker, "setting", children)
    write_json(place / "about.json", dict(facts))  # the last: it says that the rest is there
