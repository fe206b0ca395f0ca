"""What exactness costs from end to end: for each setting of simulator and encoder, cost, errors and success.

Run: python -m platform.launch +exp=trade
Expect: by estimate a quarter of an hour on two idle cores. In the run folder under `trade/`, and in
MLflow, a table, a plot, and the page that says what to choose, which `+exp=report` puts into docs/.
One policy, `trade.policy`, is evaluated in the same corridors under every setting. A stopped job
continues when the same command is given again: no episode is evaluated twice; costs and errors are
measured anew.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

import numpy as np
import pydantic
import torch

from envs.config import EnvConfig, settings_hash
from envs.corridor import CorridorEnv
from envs.event_error import converged
from jobs.analysis.statistics import paired_rate_difference
from jobs.analysis.tables import publish_plot, publish_table, summarise, write_csv
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
from jobs.studies.replays import Measured, measure_settings
from jobs.studies.simulator import KNOBS, Setting, changed, setting_text
from jobs.studies.trade.page import (
    DEFAULT,
    EXACT,
    HEADINGS,
    SETTING_FIELDS,
    TradedSetting,
    TradeFacts,
    draw_settings,
    setting_values,
    trade_lines,
    trade_metrics,
    trade_page,
)
from jobs.tracking.child_runs import ChildRun, write_child_runs
from jobs.tracking.tracker import Tracker, open_tracker
from models.encoder.evae import EventVAE
from models.encoder.table import PRECISIONS
from models.encoder.weights import load_encoder
from models.policy.policy import ENCODER

# Knob of the simulator's trade -> which of its settings are evaluated: the whole of its span.
SPANS = {
    "tolerance": slice(1, None),
    "renders": slice(2),
    "anti-aliasing": slice(1, None, 2),
    "pyrender": slice(2),
    "encoding": slice(None),
    "culling": slice(None, None, 2),
    "memory": slice(None),
}
# Several at once, of the simulation and of the table; the paper's camera sees one 8-bit frame a step.
TOGETHER: dict[str, tuple[Setting, Setting]] = {
    "coarse": ({"fidelity.tolerance": 0.5}, {"precision": PRECISIONS[-1]}),
    "the paper's camera": ({"camera.memory": "frame", "camera.encoding": "gamma8"}, {}),
}


def run(config: Config, executor: Executor | None = None) -> dict[str, float]:
    """Evaluate and measure every setting, and say what to choose; return the default's metrics.

    Args:
        config: The experiment.
        executor: Computes the missing episodes; None: on all cores.

    Raises:
        ConfigError: The policy has no frozen encoder of single events.
        RuntimeError: The default or the most exact setting could not be evaluated.
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
        measured = replay_all(config, able, evae)
        default = results[every[0].key].episodes
        rows = [
            traded_setting(task, own, results[task.key].episodes, default)
            for task, own in zip(able, measured, strict=True)
        ]
        reasons = {" ".join(task.condition): failed[task.key] for task in every if task.key in failed}
        write_trade(folder, tracker, rows, facts_of(config, folder, policy, every[0].env, reasons))
        tracker.log(0, trade_metrics(rows[0]))
        console.print(tracker.dashboard(), markup=False)
    return finish(folder, "trade", trade_metrics(rows[0]))


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
        if evae.settings.variant in EVENT_ENCODERS and evae.ecn.coding != "eventnet":
            return policy, evae
    rule = f"must be one policy with a frozen encoder of {' or '.join(EVENT_ENCODERS)}, not EventNet's"
    raise ConfigError(f"trade.policy: {rule}, got {name!r}")


def plan(config: Config, policy: EvaluatedPolicy, evae: EventVAE) -> list[EvaluationTask]:
    """The settings as cells, the default first and the most exact last; none twice.

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


def changes(timed: bool) -> list[tuple[str, str, Setting, Setting]]:
    """What is changed: nothing, each setting of the simulator, each of the encoder, and several at once.

    Args:
        timed: Whether the encoder sees time.

    Returns:
        Knob, setting, what changes in the simulation, what in the encoder's table.
    """
    found: list[tuple[str, str, Setting, Setting]] = [(DEFAULT, "", {}, {})]
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
    config: Config, policy: EvaluatedPolicy, condition: tuple[str, str], env: EnvConfig, table: Setting
) -> EvaluationTask:
    trade = config.trade
    trials = min(trade.trials, trade.pyrender_trials) if env.renderer == "pyrender" else trade.trials
    return make_task(condition, policy, config.evaluate.action, env, trials, tuple(table.items()))


def replay_all(config: Config, every: Sequence[EvaluationTask], evae: EventVAE) -> list[Measured]:
    """Measure cost and errors of each task's setting on recorded episodes."""
    torch.set_num_threads(1)
    agents = [make_agent(task.policy.agent, task.action, task.table) for task in every]
    settings = [(task.env, cast(PolicyAgent, agent)) for task, agent in zip(every, agents, strict=True)]
    seeds = range(config.trade.replays)
    with progress("Replay", len(seeds) * len(settings), "episodes") as advance:
        return measure_settings(settings, evae, seeds, advance)


def traded_setting(
    task: EvaluationTask, measured: Measured, episodes: np.ndarray, default: np.ndarray
) -> TradedSetting:
    """The row of a task, compared with the default's episodes in the same corridors."""
    difference = paired_rate_difference(episodes["success"], default["success"][: len(episodes)])
    return TradedSetting(*task.condition, measured, summarise(task.condition, episodes), difference)


def facts_of(
    config: Config, folder: Run, policy: EvaluatedPolicy, env: EnvConfig, failed: Mapping[str, str]
) -> TradeFacts:
    """What made the numbers."""
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


def write_trade(folder: Run, tracker: Tracker, rows: Sequence[TradedSetting], facts: TradeFacts) -> None:
    """Print the table; write table, plot and page into run folder and tracker, and a child run per row."""
    place = folder.path / "trade"
    (place / "images").mkdir(parents=True, exist_ok=True)
    title = "What each setting costs and gives"
    publish_table(folder, tracker, "trade/table", title, HEADINGS, trade_lines(rows))
    settings = setting_values(rows)
    write_csv(place / "settings.csv", SETTING_FIELDS, [list(one.values()) for one in settings])
    publish_plot(folder, tracker, "trade/images/trade", draw_settings(settings))
    text = trade_page(facts, rows)
    write_atomic(place / "trade.md", text)
    tracker.text("trade/trade.md", text)
    children = [
        ChildRun(
            row.name, {"knob": row.knob, "setting": row.setting}, {"verdict": row.verdict}, trade_metrics(row)
        )
        for row in rows
    ]
    write_child_runs(tracker, "setting", children)
    write_json(place / "about.json", facts)  # the last: it says that the rest is there
