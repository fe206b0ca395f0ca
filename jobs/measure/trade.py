"""Measure what accuracy costs: time, errors and success for each setting of simulator and encoder.

Run: python -m platform.launch +exp=trade
Expect: an estimated hour on two idle cores. In the run folder under `trade/`, and in MLflow: tables, a plot,
and a page of recommendations, which `+exp=report` copies into docs/. All trainings of `trade.policies` are
evaluated in the same corridors of each scene under every setting. To resume a stopped job, run the same
command again: no episode is evaluated twice, but costs and errors are measured again.
"""

import dataclasses
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple, cast

import numpy as np
import pydantic
from pydantic import Field
from pydantic.dataclasses import dataclass

from envs.config import STRICT, EnvConfig, settings_hash
from envs.corridor import CorridorEnv
from envs.event_error import converged
from jobs.analysis.statistics import Estimate, crossed_mean, half_width, rate_estimate
from jobs.analysis.tables import publish_plot, publish_table, write_csv
from jobs.config.config import Config, ConfigError
from jobs.config.schema import Count, Name
from jobs.measure.encodings import CAPS, TIME_BINS
from jobs.measure.plots import draw_settings
from jobs.measure.replays import Measured, measure_settings
from jobs.measure.trade_encoder import EVENT_ENCODERS
from jobs.measure.trade_page import (
    ALL,
    DEFAULT,
    EXACT,
    SETTING_FIELDS,
    Outcome,
    TradedSetting,
    TradeFacts,
    headings,
    setting_values,
    trade_lines,
    trade_metrics,
    trade_page,
    verdicts,
)
from jobs.measure.trade_simulator import KNOBS, Setting, changed, setting_text
from jobs.rollout.agents import PolicyAgent, make_agent
from jobs.rollout.executors import Executor
from jobs.rollout.policies import EvaluatedPolicy, find_policies, with_sensor
from jobs.rollout.scheduler import default_executor, evaluate_tasks
from jobs.rollout.store import EpisodeStore, TaskResult
from jobs.rollout.tasks import EvaluationTask, make_task
from jobs.run.files import write_atomic, write_json
from jobs.run.folder import Run, finish, locate_run, open_run
from jobs.run.progress import console, progress
from jobs.run.provenance import command, provenance, today
from jobs.run.torch_threads import torch_threads
from jobs.tracking.child_runs import ChildRun, write_child_runs
from jobs.tracking.tracker import Tracker, open_tracker
from models.encoder.evae import EventVAE
from models.encoder.table import PRECISIONS
from models.encoder.weights import load_encoder
from models.policy.policy import ENCODER

Condition = tuple[str, str]  # knob and setting

# Knob of the simulator's trade -> the settings to evaluate, which span its range.
SPANS = {
    "tolerance": slice(1, None),
    "renders": slice(2),
    "anti-aliasing": slice(1, None, 2),
    "pyrender": slice(2),
    "encoding": slice(None),
    "culling": slice(None, None, 2),
    "memory": slice(None),
}
# Combined changes of simulation and table. The paper's camera compares one 8-bit frame per step.
TOGETHER: dict[str, tuple[Setting, Setting]] = {
    "coarse": ({"fidelity.tolerance": 0.5}, {"precision": PRECISIONS[-1]}),
    "the paper's camera": ({"camera.memory": "frame", "camera.encoding": "gamma8"}, {}),
}


@dataclass(frozen=True, config=STRICT)
class Settings:
    """Policies to evaluate under every setting of simulator and encoder, and the number of corridors.

    Attributes:
        policies: Groups and names in models/pretrained, "newest", or paths.
        scenes: Scenes to evaluate in.
        trials: Corridors of each training under each setting.
        pyrender_trials: Corridors under settings that render with pyrender.
        replays: Episodes of each training for measuring costs and errors.
    """

    policies: Annotated[list[Name], Field(min_length=1)]
    scenes: Annotated[list[Name], Field(min_length=1)]
    trials: Count
    pyrender_trials: Count
    replays: Count


def run(config: Config, executor: Executor | None = None) -> dict[str, float]:
    """Evaluate and measure every setting, and write the page; return the first default's metrics.

    Args:
        config: The experiment.
        executor: Computes the missing episodes; None: on all cores.

    Raises:
        ConfigError: A policy has no frozen encoder of single events.
        RuntimeError: A default or a most exact setting could not be evaluated.
    """
    policies = find_encoder_policies(config)
    folder = open_run(config)
    config = folder.config
    plans = [plan(config, policy, scene) for scene in dict.fromkeys(config.own.scenes) for policy in policies]
    every = [task for own in plans for task in own.tasks]
    place = folder.path / "trade"
    store, executor = EpisodeStore(place), executor or default_executor(config.cluster, place)
    identity = settings_hash({"cells": [[task.key, len(task.seeds)] for task in every]})
    with open_tracker(config, folder, key=f"trade {identity[:8]}") as tracker:
        tracker.tags({"kind": "trade", "policy": ", ".join(config.own.policies)})
        slowest_first = sorted(every, key=lambda task: task.condition[0] not in (EXACT, "pyrender"))
        results, failed = evaluate_tasks(slowest_first, store, executor, "Trade", measure_accuracy=False)
        reasons = {
            f"{' '.join(task.condition)} of {task.policy.name} in {own.scene}": failed[task.key]
            for own in plans
            for task in own.tasks
            if task.key in failed
        }
        for own in plans:
            for task in (own.tasks[0], own.tasks[-1]):
                if task.key in failed:
                    what = f"{task.condition[0]} of {task.policy.name} in {own.scene}"
                    raise RuntimeError(
                        f"{what}: not evaluated: {failed[task.key]}; the same command tries again"
                    )
        traded = [row for rows in measure_plans(config, plans, results) for row in rows]
        write_trade(folder, tracker, traded, facts_of(folder, policies, reasons))
        tracker.log(0, trade_metrics(traded[0]))
        console.print(tracker.dashboard(), markup=False)
    return finish(folder, "trade", trade_metrics(traded[0]))


class Plan(NamedTuple):
    """Evaluation tasks of a policy in a scene.

    Attributes:
        policy: The policy.
        evae: Its encoder.
        scene: The scene.
        tasks: One for each setting: the default first, the most exact last, without duplicates.
    """

    policy: EvaluatedPolicy
    evae: EventVAE
    scene: str
    tasks: Sequence[EvaluationTask]


def find_encoder_policies(config: Config) -> list[EvaluatedPolicy]:
    """Return the policies to evaluate, each once.

    Raises:
        ConfigError: If `trade.policies` names none, or one without a frozen encoder of single events.
    """
    found: dict[str, EvaluatedPolicy] = {}
    for name in config.own.policies:
        for policy in find_policies("trade.policies", name, config, locate_run(config)):
            file = Path(policy.agent) / ENCODER
            evae = load_encoder(file)[0] if file.is_file() else None
            if evae is None or evae.settings.variant not in EVENT_ENCODERS or evae.ecn.coding == "eventnet":
                rule = f"must have a frozen encoder of {' or '.join(EVENT_ENCODERS)}, not EventNet's"
                raise ConfigError(f"trade.policies: {rule}, got {name!r}")
            found.setdefault(policy.identity, policy)
    return list(found.values())


def plan(config: Config, policy: EvaluatedPolicy, scene: str) -> Plan:
    """Return the evaluation tasks of a policy in a scene, one for each setting.

    Raises:
        ConfigError: If the policy's own sensor and a setting exclude each other.
    """
    own = with_sensor(dataclasses.replace(config.env, scene=scene, split="eval"), policy.sensor)
    evae, _ = load_encoder(Path(policy.agent) / ENCODER)
    timed = evae.ecn.coding != "none"
    found: dict[str, EvaluationTask] = {}
    for knob, text, simulation, table in changes(timed):
        try:
            env = changed(own, simulation)
        except pydantic.ValidationError as error:
            reason = error.errors()[0]["msg"]
            raise ConfigError(f"trade.policies: {simulation} with its own sensor: {reason}") from None
        task = _task(config, policy, (knob, text), env, table)
        found.setdefault(task.key, task)
    table = {"time_bins": TIME_BINS[-1]} if timed else {}
    tasks = [*found.values(), _task(config, policy, (EXACT, ""), exact_env(own), table)]
    return Plan(policy, evae, scene, tasks)


def changes(timed: bool) -> list[tuple[str, str, Setting, Setting]]:
    """Return the changes to evaluate: none, each setting of simulator and encoder, and combinations.

    Args:
        timed: Whether the encoder uses event times.

    Returns:
        Knob, setting, changes of the simulation, changes of the encoder's table.
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
    """Return the converged simulation, see `envs.event_error`."""
    corridor = CorridorEnv(env, observation="none")
    corridor.reset(seed=0)
    return converged(env, corridor.scene)


def _task(
    config: Config, policy: EvaluatedPolicy, condition: tuple[str, str], env: EnvConfig, table: Setting
) -> EvaluationTask:
    trade = config.own
    trials = min(trade.trials, trade.pyrender_trials) if env.renderer == "pyrender" else trade.trials
    return make_task(condition, policy, config.evaluate.action, env, trials, tuple(table.items()))


def measure_plans(
    config: Config, plans: Sequence[Plan], results: Mapping[str, TaskResult]
) -> list[list[TradedSetting]]:
    """Return the rows of each scene: evaluated success, and measured cost and errors on recorded episodes."""
    able = [own._replace(tasks=[task for task in own.tasks if task.key in results]) for own in plans]
    seeds = range(config.own.replays)
    total = len(seeds) * sum(len(own.tasks) for own in able)
    with torch_threads(1), progress("Replay", total, "episodes") as advance:
        measured = [_measured(own, seeds, advance) for own in able]
    found = []
    for scene in dict.fromkeys(config.own.scenes):
        here = [(own, costs) for own, costs in zip(able, measured, strict=True) if own.scene == scene]
        conditions = dict.fromkeys(task.condition for own, _ in here for task in own.tasks)
        order = sorted(conditions, key=lambda condition: condition[0] == EXACT)  # the most exact last
        found.append([traded_setting(condition, here, results) for condition in order])
    return found


def _measured(own: Plan, seeds: Sequence[int], advance: Callable[[int], None]) -> dict[Condition, Measured]:
    """Measure cost and errors of each setting of a plan."""
    agents = [make_agent(task.policy.agent, task.action, task.table) for task in own.tasks]
    settings = [(task.env, cast(PolicyAgent, agent)) for task, agent in zip(own.tasks, agents, strict=True)]
    measured = measure_settings(settings, own.evae, seeds, advance)
    return {task.condition: one for task, one in zip(own.tasks, measured, strict=True)}


def traded_setting(
    condition: Condition,
    plans: Sequence[tuple[Plan, Mapping[Condition, Measured]]],
    results: Mapping[str, TaskResult],
) -> TradedSetting:
    """Return the row of a setting in a scene, compared with the default setting of the same trainings.

    Args:
        condition: Knob and setting.
        plans: Plans of all policies in the scene, with cost and errors of their settings.
        results: Key of a task -> its result.
    """
    ratios: list[float] = []
    costs: list[Measured] = []
    success: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    others: dict[str, list[float]] = {}
    for own, measured in plans:
        tasks = {task.condition: task for task in own.tasks}
        if condition not in tasks:
            continue
        cost, usual = measured[condition], measured[own.tasks[0].condition]
        ratios += [before / after for before, after in zip(usual.steps_us, cost.steps_us, strict=True)]
        costs.append(cost)
        reached = results[tasks[condition].key].episodes["success"]
        default = results[own.tasks[0].key].episodes["success"][: len(reached)]
        success.setdefault(own.policy.group, []).append((reached, default))
        others.setdefault(own.policy.group, []).append(cost.other_action)
    groups = {group: _outcome(pairs, others[group]) for group, pairs in success.items()}
    together = _outcome(
        [pair for own in success.values() for pair in own], [one.other_action for one in costs]
    )
    return TradedSetting(
        plans[0][0].scene,
        *condition,
        step_us=float(np.median([cost.step_us for cost in costs])),
        speed=speed_ratio(ratios),
        event_error=float(np.mean([cost.event_error for cost in costs])),
        latent_error=float(np.mean([cost.latent_error for cost in costs])),
        outcomes={**groups, ALL: together},
    )


def _outcome(pairs: Sequence[tuple[np.ndarray, np.ndarray]], other_action: Sequence[float]) -> Outcome:
    """Compare the success of each training with its default in the same corridors."""
    reached, usual = (np.stack(part).astype(np.float64) for part in zip(*pairs, strict=True))
    difference = crossed_mean(reached - usual, (-1.0, 1.0))
    return Outcome(len(pairs), reached.size, rate_estimate(reached), difference, float(np.mean(other_action)))


def speed_ratio(ratios: Sequence[float]) -> Estimate:
    """Return the geometric mean of repeated time ratios, with Student's interval of their logarithms."""
    logs = np.log(ratios)
    if len(logs) < 2:
        return Estimate(float(np.exp(logs[0])), None)
    centre, half = float(logs.mean()), float(half_width(logs[:, None])[0])
    return Estimate(float(np.exp(centre)), (float(np.exp(centre - half)), float(np.exp(centre + half))))


def facts_of(folder: Run, policies: Sequence[EvaluatedPolicy], failed: Mapping[str, str]) -> TradeFacts:
    """Return the provenance of the numbers."""
    trade = folder.config.own
    return {
        "run": folder.path.name,
        "command": command(),
        "date": today(),
        **provenance(),
        "policies": dict(Counter(policy.group for policy in policies)),
        "scenes": list(dict.fromkeys(trade.scenes)),
        "met": met_fidelity(policies),
        "action": folder.config.evaluate.action,
        "trials": trade.trials,
        "pyrender_trials": min(trade.trials, trade.pyrender_trials),
        "replays": trade.replays,
        "failed": dict(failed),
    }


def met_fidelity(policies: Sequence[EvaluatedPolicy]) -> dict[str, list[str]]:
    """Return group -> settings of `fidelity` that its trainings drew in addition to the default."""
    found: dict[str, dict[str, None]] = {}
    for policy in policies:
        for condition in policy.conditions:
            for key in (key for key in condition if key.startswith("fidelity.")):
                name = f"{key.removeprefix('fidelity.')} {condition[key]}"
                found.setdefault(policy.group, {})[name] = None
    return {group: list(names) for group, names in found.items()}


def write_trade(folder: Run, tracker: Tracker, rows: Sequence[TradedSetting], facts: TradeFacts) -> None:
    """Print the tables; write tables, plot and page into run folder and tracker, and child runs."""
    place, groups = folder.path / "trade", list(facts["policies"])
    lines = [(row.scene, *line) for row, line in zip(rows, trade_lines(rows, groups), strict=True)]
    title = "What each setting costs and gives"
    publish_table(folder, tracker, "trade/table", title, ("Scene", *headings(groups)), lines)
    settings = setting_values(rows)
    write_csv(place / "settings.csv", SETTING_FIELDS, [list(one.values()) for one in settings])
    publish_plot(folder, tracker, "trade/images/trade", draw_settings(settings))
    text = trade_page(facts, rows)
    write_atomic(place / "trade.md", text)
    tracker.text("trade/trade.md", text)
    children = [
        ChildRun(
            f"{row.scene} {row.name} {group}",
            {"scene": row.scene, "knob": row.knob, "setting": row.setting, "group": group},
            {"verdict": verdict},
            trade_metrics(row, group),
        )
        for row, verdict in zip(rows, verdicts(rows), strict=True)
        for group in row.outcomes
    ]
    write_child_runs(tracker, "setting", children)
    write_json(place / "about.json", facts)  # written last: it marks the trade as complete
