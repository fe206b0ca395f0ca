"""Evaluate the policy and the baselines in held-out corridors, and report the results.

Run: python -m platform.launch +exp=evaluate
Expect: about 2,000 control steps per second on each core. In the run folder under
`eval/`: every episode (`episodes.csv`), the table with its intervals, trajectories seen from above
and a video of one episode. A stopped evaluation resumes; one with more episodes adds the new ones.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from envs.config import WITHOUT_EVENTS, EnvConfig
from envs.corridor import CorridorEnv
from jobs.analysis.plots import plot_trajectories
from jobs.analysis.tables import (
    CAPTION,
    SUMMARY_HEADINGS,
    Summary,
    publish_plot,
    publish_table,
    summarise,
    summary_cells,
    summary_columns,
    summary_metrics,
)
from jobs.analysis.video import latent_decoder, open_film
from jobs.config.config import HELD_OUT_SCENE, TRAINED_SCENE, Config, ConfigError, as_dict
from jobs.rollout.agents import BASELINES, make_agent
from jobs.rollout.diagnostics import report_event_error
from jobs.rollout.episodes import Trajectory, TrajectoryRecorder, roll_out
from jobs.rollout.executors import Executor
from jobs.rollout.policies import (
    PRETRAINED,
    EvaluatedPolicy,
    check_sensor,
    find_policy,
    read_policy,
    with_sensor,
)
from jobs.rollout.scheduler import default_executor, evaluate_tasks
from jobs.rollout.store import EpisodeStore, TaskResult
from jobs.rollout.table import write_episodes
from jobs.rollout.tasks import EvaluationTask, make_task
from jobs.run.folder import Run, finish, finished, locate_run, open_run
from jobs.run.progress import console
from jobs.tracking.tracker import Tracker, open_tracker
from models.policy import load_policy
from models.policy.policy import ENCODER, MANIFEST

LABELS = ("Agent", "Scene", "Renderer")
Label = tuple[str, str, str]  # what was evaluated, as in `LABELS`
SHOWN_CORRIDORS = range(4)
VIEW_COLUMNS = ("eval/success_rate", "eval/success_rate_low", "eval/success_rate_high", "eval/distance_m")
Renderer = Literal["raycast", "pyrender"]
ACTIONS = ("deterministic", "stochastic")  # the likeliest action, or one drawn as in training


def run(config: Config) -> dict[str, float]:
    """Evaluate the run's policy, or the newest one; return the metrics of the tracker."""
    find_policy(config, locate_run(config))
    folder = open_run(config)
    with open_tracker(folder.config, folder) as tracker:
        found = evaluate(folder, tracker)
        console.print(tracker.dashboard())
    return found


def evaluate(folder: Run, tracker: Tracker) -> dict[str, float]:
    """Evaluate every task, write tables, plots and a video, and return the metrics.

    If the same policy was evaluated with the same settings, return those metrics, unless tasks failed then.

    Args:
        folder: The run folder.
        tracker: Its MLflow run.

    Raises:
        RuntimeError: A task of the first renderer failed.
    """
    config = folder.config
    policy = find_policy(config, folder)
    manifest = load_policy(policy.agent).manifest
    check_sensor(manifest["sensor"], config.env)
    asked = {"evaluate": as_dict(config)["evaluate"], "policy": manifest["sha256"]}
    done = finished(folder, "evaluate")
    if done is not None and done["asked"] == asked and not done.get("missing"):
        console.print((folder.evaluation / "table.md").read_text(), markup=False)
        return done["figures"]
    announce(folder, policy)
    tracker.tags({"policy": manifest["name"]})
    tasks = plan_evaluation(config, policy)
    executor = default_executor(config.cluster, folder.evaluation)
    results = evaluate_all(tasks, EpisodeStore(folder.evaluation), executor)
    episodes = {label: result.episodes for label, result in results.items()}
    summaries = [summarise(label, rows) for label, rows in episodes.items()]
    write_episodes(folder.evaluation / "episodes.csv", LABELS, episodes)
    tracker.artifact(folder.evaluation / "episodes.csv", "eval")
    publish(folder, tracker, summaries, trajectories(tasks))
    found = evaluation_metrics(summaries) | drift_by_label(results)
    found |= report_event_error(dataclasses.replace(config.env, scene=HELD_OUT_SCENE))
    tracker.log(config.train.env_steps, found)
    if config.evaluate.video:
        task, file = tasks[0], folder.evaluation / "episode.mp4"
        seed = seed_to_film(results[label_of(task)].episodes)
        tracker.artifact(film_episode(task.policy.agent, task.action, task.env, seed, file), "eval")
    missing = [" ".join(label) for label in map(label_of, tasks) if label not in results]
    commits = sorted({commit for result in results.values() for commit in result.commits})
    finish(
        folder, "evaluate", {"asked": asked, "figures": found, "missing": missing, "evaluated_at": commits}
    )
    return found


def plan_evaluation(config: Config, policy: EvaluatedPolicy) -> list[EvaluationTask]:
    """Return the tasks: all agents in the held-out scene with the first renderer, the policy with the others.

    A policy trained in another scene than `poles` is evaluated in that scene too, because `poles_eval` says
    nothing about it. The policy is evaluated with both choices of action, because they can differ by tens of
    points. The configured choice comes first, and metrics without a suffix belong to it.
    """
    first, *others = config.evaluate.renderers
    scenes = [HELD_OUT_SCENE, *{config.env.scene} - {HELD_OUT_SCENE, TRAINED_SCENE}]
    actions = sorted(ACTIONS, key=lambda action: action != config.evaluate.action)
    agents = [(policy, action) for action in actions]
    agents += [(published(name), "stochastic") for name in config.evaluate.beside]
    agents += [(read_policy(name), name) for name in BASELINES]
    return [
        *(_task(config, *agent, scene, first) for scene in scenes for agent in agents),
        *(_task(config, *agents[0], HELD_OUT_SCENE, renderer) for renderer in others),
    ]


def published(name: str) -> EvaluatedPolicy:
    """Return a policy of models/pretrained.

    Raises:
        ConfigError: There is no policy of this name.
    """
    if not (PRETRAINED / name / MANIFEST).is_file():
        raise ConfigError(f"evaluate.beside: must be names in models/pretrained, got {name!r}")
    return read_policy(str(PRETRAINED / name))


def _task(
    config: Config, policy: EvaluatedPolicy, action: str, scene: str, renderer: Renderer
) -> EvaluationTask:
    own = with_sensor(config.env, policy.sensor)  # a published policy's own sensor, else the configured
    env = dataclasses.replace(own, scene=scene, split="eval", renderer=renderer)
    episodes = config.evaluate.episodes
    if renderer == "pyrender":  # a check with other pictures, which need not meet the tolerance
        env = dataclasses.replace(env, fidelity=dataclasses.replace(env.fidelity, samples=2))
        episodes = config.evaluate.pyrender_episodes
    return make_task((scene, renderer), policy, action, env, episodes)


def label_of(task: EvaluationTask) -> Label:
    """Return agent, scene and renderer of a task; the run's policy is named by its choice of action."""
    agent = task.policy.agent
    if Path(agent).parent == PRETRAINED:
        return task.policy.name, *task.condition
    return (agent if agent in BASELINES else f"policy {task.action}", *task.condition)


def evaluate_all(
    tasks: Sequence[EvaluationTask], store: EpisodeStore, executor: Executor
) -> dict[Label, TaskResult]:
    """Evaluate the tasks; return their results, without tasks that failed with another renderer.

    Raises:
        RuntimeError: A task of the first renderer failed.
    """
    slowest_first = tasks[::-1]
    results, failed = evaluate_tasks(slowest_first, store, executor, measure_accuracy=False)
    for task in tasks:
        if task.key in failed and task.condition[1] == tasks[0].condition[1]:
            what, reason = " ".join(label_of(task)), failed[task.key]
            raise RuntimeError(f"{what}: not evaluated: {reason}; the same command tries again")
    return {label_of(task): results[task.key] for task in tasks if task.key in results}


def trajectories(tasks: Sequence[EvaluationTask]) -> list[Trajectory]:
    """Return trajectories of policy and oracle under the first condition, from episodes rolled out again."""
    found = []
    shown = (tasks[0].policy.agent, tasks[0].action), ("oracle", "oracle")
    for task in tasks:
        if (task.policy.agent, task.action) in shown and task.condition == tasks[0].condition:
            seeds = [seed for seed in SHOWN_CORRIDORS if seed in task.seeds]
            recorder = TrajectoryRecorder(seeds)
            agent = make_agent(task.policy.agent, task.action)
            episodes = roll_out(agent, task.env, seeds, watch=recorder.add)
            found += recorder.trajectories(label_of(task)[0].partition(" ")[0], episodes)
    return found


def announce(folder: Run, policy: EvaluatedPolicy) -> None:
    """Print which policy is evaluated."""
    newest = f"the newest of {folder.config.model.name} in {folder.config.runs_dir}"
    which = "this run's own" if Path(policy.agent) == folder.policy else newest
    console.print(f"Policy: {policy.agent}, {which}", markup=False)


def publish(folder: Run, tracker: Tracker, summaries: Sequence[Summary], shown: Sequence[Trajectory]) -> None:
    """Print, write and track the table and the trajectories."""
    head, lines = (*LABELS, *SUMMARY_HEADINGS), [summary_cells(summary) for summary in summaries]
    publish_table(folder, tracker, "eval/table", "Held-out corridors", head, lines, len(LABELS), CAPTION)
    tracker.table("eval/results", summary_columns(LABELS, summaries))
    publish_plot(folder, tracker, "eval/trajectories", plot_trajectories(shown))


def evaluation_metrics(summaries: Sequence[Summary]) -> dict[str, float]:
    """Return all metrics of the first summary under their plain names, and two of others with a suffix.

    The others are the summaries of the same agent or the same scene.
    """
    found: dict[str, float] = {}
    first = summaries[0].label
    for summary in summaries:
        suffix = metric_suffix(summary.label, first)
        if not suffix:
            found |= summary_metrics(summary)
        elif summary.label[0] == first[0] or summary.label[1] == first[1]:
            found |= {f"{name}{suffix}": summary_metrics(summary)[name] for name in VIEW_COLUMNS[::3]}
    return {name: value for name, value in found.items() if np.isfinite(value)}


def drift_by_label(results: Mapping[Label, TaskResult]) -> dict[str, float]:
    """Return all drift metrics of the first task under plain names, and `drift` of others with a suffix."""
    found: dict[str, float] = {}
    first = next(iter(results))
    for label, result in results.items():
        suffix = metric_suffix(label, first)
        names = [name for name in result.drift if not suffix or name == "drift"]
        found |= {f"evae/{name}{suffix}": result.drift[name] for name in names}
    return found


def metric_suffix(label: Sequence[str], first: Sequence[str]) -> str:
    """Return the suffix of a label's metrics, "_poles": the words in which it differs from the first one."""
    words = [word for word, usual in zip(label, first, strict=True) if word != usual]
    return "".join(f"_{word.removeprefix('policy ')}" for word in words)


def seed_to_film(episodes: np.ndarray) -> int:
    """Choose the corridor to film: the one where the policy got farthest, successes before failures."""
    order = np.lexsort((episodes["seed"], -episodes["distance_m"], ~episodes["success"]))
    return int(episodes["seed"][order[0]])


def film_episode(name: str, action: str, env_config: EnvConfig, seed: int, path: Path) -> Path:
    """Film one episode of a policy folder or a baseline; return the file."""
    decode = latent_decoder(Path(name)) if (Path(name) / ENCODER).is_file() else None
    agent = make_agent(name, action)
    with open_film(path, env_config.control_hz, decode) as film:

        def watch(env: CorridorEnv, seed: int, observation: np.ndarray) -> None:
            info = env.info()
            caption = f"{env_config.scene} {seed}   {info['t_us'] / 1e6:4.2f} s   {info['y_m']:5.1f} m"
            ending = "   goal" if info["success"] else "   collision" if info["collision"] else ""
            events = None if agent.observation in WITHOUT_EVENTS else env.events
            film.step(env.luminance, events, observation, f"{caption}{ending}")

        roll_out(agent, env_config, [seed], watch=watch)
    return path
