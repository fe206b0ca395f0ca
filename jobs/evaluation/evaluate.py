"""Fly the policy and its bounds through held-out corridors, and say how well each did.

Run: python -m platform.launch +exp=evaluate
Expect: about 2,000 control steps per second on each core. In the run folder under
`eval/`: every episode (`episodes.csv`), the table with its intervals, ways seen from above
and a film of one flight. A stopped evaluation continues, and one that asks for more flies what is new.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch

from envs.config import WITHOUT_EVENTS, EnvConfig, settings_hash
from envs.corridor import CorridorEnv
from jobs.analysis.plots import plot_trajectories
from jobs.analysis.tables import (
    CAPTION,
    SUMMARY_HEADINGS,
    Summary,
    markdown_table,
    publish_plot,
    show_table,
    summarise,
    summary_cells,
    summary_columns,
    summary_metrics,
)
from jobs.analysis.video import Decode, open_film
from jobs.config.config import HELD_OUT_SCENE, Config, ConfigError, as_dict
from jobs.rollout.accuracy import achieved
from jobs.rollout.agents import BOUNDS, make_agent
from jobs.rollout.episodes import Trajectory, Ways, check_sensor, fly, write_episodes
from jobs.rollout.scheduler import fly_cells
from jobs.rollout.tasks import Cell, Entry, episodes_folder, make_cell, read_kept
from jobs.run.files import write_atomic
from jobs.run.folder import Run, finish, finished, latest_policies, locate_run, open_run
from jobs.run.progress import console
from jobs.tracking.tracker import Tracker, open_tracker
from models.encoder.evae import pictures, reconstruct
from models.encoder.event_batch import batch_packed
from models.encoder.weights import load_encoder
from models.kinds import find_kind
from models.policy import load_policy
from models.policy.policy import ENCODER

LABELS = ("Agent", "Scene", "Renderer")
SHOWN_CORRIDORS = range(4)
VIEW_COLUMNS = ("eval/success_rate", "eval/success_rate_low", "eval/success_rate_high", "eval/distance_m")
Renderer = Literal["raycast", "pyrender"]
ACTIONS = ("deterministic", "stochastic")  # the likeliest action, or one drawn as in training


class Task(NamedTuple):
    """One agent through the first corridors of one scene, drawn by one renderer.

    The agent is a bound, or the policy with its choice of action: "policy deterministic".
    """

    agent: str
    scene: str
    renderer: Renderer
    episodes: int

    @property
    def label(self) -> tuple[str, str, str]:
        """What was flown, as in `LABELS`."""
        return self.agent, self.scene, self.renderer

    @property
    def of_policy(self) -> bool:
        """Whether the policy flies."""
        return self.agent.startswith("policy")


def run(config: Config) -> dict[str, Any]:
    """Evaluate the run's policy, or the newest one; return the figures of the tracker."""
    find_policy(config, locate_run(config))
    folder = open_run(config)
    config = folder.config
    with open_tracker(config, folder) as tracker:
        figures = evaluate(config, folder, tracker)
        console.print(tracker.dashboard())
    return figures


def evaluate(config: Config, folder: Run, tracker: Tracker) -> dict[str, Any]:
    """Fly every task, write what came of it, and return the figures.

    What was asked before, of the same policy, is not flown again; what could not be drawn then is tried.

    Raises:
        RuntimeError: A task of the first renderer could not be flown.
    """
    path = find_policy(config, folder)
    manifest = load_policy(path).manifest
    check_sensor(manifest, config.env)
    asked = {"evaluate": as_dict(config)["evaluate"], "policy": manifest["sha256"]}
    done = finished(folder, "evaluate")
    if done is not None and done["asked"] == asked and not done.get("missing"):
        console.print((folder.evaluation / "table.md").read_text(), markup=False)
        return done["figures"]
    announce(config, folder, path)
    tracker.tags({"policy": manifest["name"]})
    plan = tasks(config)
    of_policy = settings_hash(dict(manifest)), find_kind(manifest["name"]).observation
    cells = {task: cell_of(task, config, path, of_policy) for task in plan}
    flown = fly_tasks(cells, config, folder)
    tracks = [track for task in plan if shown(task, plan) for track in tracks_of(task, cells[task])]
    kept = episodes_folder(folder.evaluation)
    notes = {task: read_kept(kept, cells[task].key) for task in flown}
    rows = [summarise(task.label, episodes) for task, episodes in flown.items()]
    write_episodes(folder.evaluation / "episodes.csv", LABELS, {task.label: flown[task] for task in flown})
    publish(folder, tracker, rows, tracks)
    figures = tracked_figures(rows) | drift_metrics({task: note["encoder"] for task, note in notes.items()})
    figures |= achieved(dataclasses.replace(config.env, scene=HELD_OUT_SCENE))
    tracker.log(config.train.env_steps, figures)
    if config.evaluate.video:
        seed = film_seed(flown[plan[0]])
        env_config = dataclasses.replace(config.env, scene=HELD_OUT_SCENE, split="eval")
        file = folder.evaluation / "episode.mp4"
        tracker.artifact(film(str(path), config.evaluate.action, env_config, seed, file), "eval")
    missing = [" ".join(task.label) for task in plan if task not in flown]
    flown_at = sorted({commit for note in notes.values() for commit in note["commits"]})
    marker = {"asked": asked, "figures": figures, "missing": missing, "flown_at": flown_at}
    finish(folder, "evaluate", marker)
    return figures


def cell_of(task: Task, config: Config, path: Path, of_policy: tuple[str, str]) -> Cell:
    """A task as a cell of flights; `path` is the policy's, `of_policy` its identity and observation."""
    env_config = dataclasses.replace(config.env, scene=task.scene, split="eval", renderer=task.renderer)
    if task.renderer == "pyrender":  # to see another picture, not to see it as exactly as the tolerance asks
        fidelity = dataclasses.replace(env_config.fidelity, samples=2)
        env_config = dataclasses.replace(env_config, fidelity=fidelity)
    agent, what, sees = (str(path), *of_policy) if task.of_policy else (task.agent, task.agent, "none")
    entry = Entry(agent, task.agent, None, what, {}, sees)
    action = task.agent.removeprefix("policy ")
    return make_cell((task.scene, task.renderer), entry, action, env_config, task.episodes)


def fly_tasks(cells: Mapping[Task, Cell], config: Config, folder: Run) -> dict[Task, np.ndarray]:
    """The episodes of each task, but of those that a second renderer cannot draw.

    Raises:
        RuntimeError: A task of the first renderer could not be flown.
    """
    slowest_first = [*cells.values()][::-1]
    flown, failed = fly_cells(config, folder.evaluation, slowest_first, "Evaluate", measuring=False)
    for task, cell in cells.items():
        if cell.key in failed and task.renderer == config.evaluate.renderers[0]:
            reason = failed[cell.key]
            raise RuntimeError(f"{' '.join(task.label)}: not flown: {reason}; the same command tries again")
    return {task: flown[cell.key] for task, cell in cells.items() if cell.key in flown}


def tracks_of(task: Task, cell: Cell) -> list[Trajectory]:
    """The ways of a task's flights through the corridors that are drawn; flown again, to the same end."""
    seeds = [seed for seed in SHOWN_CORRIDORS if seed in cell.seeds]
    ways = Ways(seeds)
    episodes = fly(make_agent(cell.entry.agent, cell.action), cell.env, seeds, watch=ways.add)
    return ways.tracks(task.agent.partition(" ")[0], episodes)


def tasks(config: Config) -> list[Task]:
    """The held-out scene and the training scene; all agents with the first renderer, the policy with all.

    The policy flies with both choices of action, because they can differ by tens of points;
    the configured one comes first and is the one that figures without a suffix belong to.
    """
    first, *others = config.evaluate.renderers
    scenes = dict.fromkeys((HELD_OUT_SCENE, config.env.scene))
    actions = sorted(ACTIONS, key=lambda action: action != config.evaluate.action)
    policies = [f"policy {action}" for action in actions]
    pairs = [(agent, scene) for scene in scenes for agent in (*policies, *BOUNDS)]
    return [
        *(Task(agent, scene, first, _episodes(config, first)) for agent, scene in pairs),
        *(Task(policies[0], HELD_OUT_SCENE, other, _episodes(config, other)) for other in others),
    ]


def _episodes(config: Config, renderer: str) -> int:
    return config.evaluate.pyrender_episodes if renderer == "pyrender" else config.evaluate.episodes


def shown(task: Task, plan: Sequence[Task]) -> bool:
    """Whether the ways of a task are drawn: policy and oracle, in the scene flown first."""
    return task.agent in (plan[0].agent, "oracle") and task.label[1:] == plan[0].label[1:]


def find_policy(config: Config, folder: Run) -> Path:
    """The run's own policy, or the newest one of its model.

    Raises:
        ConfigError: If there is none; the message names the models that have one.
    """
    if (folder.policy / "policy.json").is_file():
        return folder.policy
    name, there = folder.config.model.name, latest_policies(config.runs_dir)
    if name not in there:
        where = f"no trained policy of {name} in {str(Path(config.runs_dir).resolve())!r}"
        others = f" (there is one of {', '.join(sorted(there))}: take model=)" if there else ""
        train = "run python -m platform.launch +exp=bytestream"
        raise ConfigError(f"{where}{others}: {train} model={name}")
    return there[name]


def announce(config: Config, folder: Run, path: Path) -> None:
    """Say which policy is flown."""
    newest = f"the newest of {folder.config.model.name} in {config.runs_dir}"
    which = "this run's own" if path == folder.policy else newest
    console.print(f"Policy: {path}, {which}", markup=False)


def publish(folder: Run, tracker: Tracker, rows: Sequence[Summary], tracks: Sequence[Trajectory]) -> None:
    """Show, store and track the table and the ways."""
    head, lines = (*LABELS, *SUMMARY_HEADINGS), [summary_cells(row) for row in rows]
    text = markdown_table(head, lines, len(LABELS))
    show_table("Held-out corridors", head, lines, len(LABELS), CAPTION)
    write_atomic(folder.evaluation / "table.md", text)
    tracker.text("eval/table.md", text)
    tracker.table("eval/results", summary_columns(LABELS, rows))
    publish_plot(folder, tracker, "eval/trajectories", plot_trajectories(tracks))


def tracked_figures(rows: Sequence[Summary]) -> dict[str, float]:
    """The figures of the first row under their plain names; those of others say what differs."""
    figures: dict[str, float] = {}
    first = rows[0].label
    for row in rows:
        ending = suffix(row.label, first)
        if not ending:
            figures |= summary_metrics(row)
        elif row.label[0] == first[0] or row.label[1] == first[1]:
            figures |= {f"{name}{ending}": summary_metrics(row)[name] for name in VIEW_COLUMNS[::3]}
    return {name: value for name, value in figures.items() if np.isfinite(value)}


def drift_metrics(drifts: Mapping[Task, Mapping[str, float]]) -> dict[str, float]:
    """What the encoder made of the first task, under plain names; of the policy's others, the drift alone."""
    figures: dict[str, float] = {}
    first = next(iter(drifts)).label
    for task, values in drifts.items():
        ending = suffix(task.label, first)
        names = [name for name in values if not ending or name == "drift"]
        figures |= {f"evae/{name}{ending}": values[name] for name in names}
    return figures


def suffix(label: Sequence[str], first: Sequence[str]) -> str:
    """What a metric's name says of its row: the words in which it differs from the first, or nothing."""
    words = [word for word, usual in zip(label, first, strict=True) if word != usual]
    return "".join(f"_{word.removeprefix('policy ')}" for word in words)


def film_seed(episodes: np.ndarray) -> int:
    """The corridor to film: the first that the policy came through, or where it came farthest."""
    order = np.lexsort((episodes["seed"], -episodes["distance_m"], ~episodes["success"]))
    return int(episodes["seed"][order[0]])


def film(source: str, action: str, env_config: EnvConfig, seed: int, path: Path) -> Path:
    """Film a flight of a policy's folder, or of a bound, through one corridor; return the file."""
    decode = decoder(Path(source)) if (Path(source) / ENCODER).is_file() else None
    agent = make_agent(source, action)
    with open_film(path, env_config.control_hz, decode) as reel:

        def watch(env: CorridorEnv, seed: int, observation: np.ndarray, info: Mapping[str, Any]) -> None:
            caption = f"{env_config.scene} {seed}   {info['t_us'] / 1e6:4.2f} s   {info['y_m']:5.1f} m"
            ending = "   goal" if info["success"] else "   collision" if info["collision"] else ""
            events = None if agent.observation in WITHOUT_EVENTS else env.events
            reel.step(env.luminance, events, observation, f"{caption}{ending}")

        fly(agent, env_config, [seed], watch=watch)
    return path


def decoder(source: Path) -> Decode | None:
    """What draws, from an event window, the picture that a policy's latents hold.

    None for a lean policy, which has no decoder.
    """
    evae, _ = load_encoder(source / ENCODER)
    if evae.decoder is None:
        return None

    @torch.no_grad()
    def decode(window: np.ndarray) -> np.ndarray:
        logits = evae(batch_packed(window[None], evae.grid))[0]
        return pictures(reconstruct(logits, evae.target), evae.target, evae.grid)[0].numpy()

    return decode
