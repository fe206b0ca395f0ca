"""Fly the policy and its bounds through held-out corridors, and say how well each did.

Run: python -m platform.launch +exp=evaluate
Expect: about 2,000 control steps per second on one core. In the run folder under
`eval/`: every episode (`episodes.csv`), the table with its intervals, ways seen from above
and a film of one flight.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch

from envs.corridor import CorridorEnv
from jobs.config import Config, ConfigError
from jobs.figures import Track, trajectory_figure
from jobs.flights import Advance, Watch, Ways, check_sensor, fly, write_episodes
from jobs.pictures import Film
from jobs.pilots import BOUNDS, PolicyPilot, make_pilot
from jobs.progress import console, progress
from jobs.report import Summary, columns, markdown, metrics, show, summarise, table
from jobs.runs import Run, finish, finished, latest_policy, open_run, write_atomic
from jobs.tracking import Tracker, open_tracker
from models.batch import batch_packed
from models.evae import reconstruct
from models.policy import ENCODER, load_policy
from models.weights import load_encoder

HELD_OUT_SCENE = "poles_eval"
LABELS = ("Pilot", "Scene", "Renderer")
SHOWN_CORRIDORS = range(4)
VIEW_COLUMNS = ("eval/success_rate", "eval/success_rate_low", "eval/success_rate_high", "eval/distance_m")
Renderer = Literal["raycast", "pyrender"]


class Task(NamedTuple):
    """One pilot through the first corridors of one scene, drawn by one renderer."""

    pilot: str
    scene: str
    renderer: Renderer
    episodes: int

    @property
    def label(self) -> tuple[str, str, str]:
        """What was flown, as in `LABELS`."""
        return self.pilot, self.scene, self.renderer


def run(config: Config) -> dict[str, Any]:
    """Evaluate the run's policy, or the newest one; return the figures of the tracker."""
    folder = open_run(config)
    find_policy(config, folder)
    with open_tracker(config, folder) as tracker:
        figures = evaluate(config, folder, tracker)
        console.print(tracker.dashboard())
    return figures


def evaluate(config: Config, folder: Run, tracker: Tracker) -> dict[str, Any]:
    """Fly every task, write what came of it, and return the figures (once per run folder)."""
    done = finished(folder, "evaluate")
    if done is not None:
        console.print((folder.evaluation / "table.md").read_text(), markup=False)
        return done
    path = find_policy(config, folder)
    pilot = PolicyPilot(load_policy(path), config.evaluate.action == "stochastic")
    check_sensor(pilot.policy.manifest, config.env_config())
    plan = tasks(config)
    flown: dict[Task, np.ndarray] = {}
    tracks: list[Track] = []
    with progress("Evaluate", sum(task.episodes for task in plan), "episodes") as advance:
        for task in plan:
            ways = Ways(SHOWN_CORRIDORS if shown(task, plan) else ())
            note = " ".join(task.label)
            episodes = fly_task(task, config, pilot, ways.add, functools.partial(advance, note=note))
            if episodes is not None:
                flown[task] = episodes
                tracks += ways.tracks(task.pilot, episodes)
    rows = [summarise(task.label, episodes) for task, episodes in flown.items()]
    write_episodes(folder.evaluation / "episodes.csv", LABELS, {task.label: flown[task] for task in flown})
    publish(folder, tracker, rows, tracks)
    figures = tracked_figures(rows)
    tracker.log(config.train.env_steps, figures)
    if config.evaluate.video:
        seed = film_seed(flown[plan[0]])
        tracker.artifact(film(config, pilot, path, seed, folder.evaluation / "episode.mp4"), "eval")
    return finish(folder, "evaluate", figures)


def tasks(config: Config) -> list[Task]:
    """The held-out scene and the training scene; all pilots with the first renderer, the policy with all."""
    first, *others = config.evaluate.renderers
    scenes = dict.fromkeys((HELD_OUT_SCENE, config.env_config().scene))
    pairs = [(pilot, scene) for scene in scenes for pilot in ("policy", *BOUNDS)]
    return [
        *(Task(pilot, scene, first, _episodes(config, first)) for pilot, scene in pairs),
        *(Task("policy", HELD_OUT_SCENE, other, _episodes(config, other)) for other in others),
    ]


def _episodes(config: Config, renderer: str) -> int:
    return config.evaluate.pyrender_episodes if renderer == "pyrender" else config.evaluate.episodes


def shown(task: Task, plan: Sequence[Task]) -> bool:
    """Whether the ways of a task are drawn: policy and oracle, in the scene flown first."""
    return task.pilot in ("policy", "oracle") and task.label[1:] == plan[0].label[1:]


def fly_task(
    task: Task, config: Config, policy: PolicyPilot, watch: Watch, advance: Advance
) -> np.ndarray | None:
    """The episodes of a task, or None (and a line that says why) where a second renderer cannot run."""
    pilot = policy if task.pilot == "policy" else make_pilot(task.pilot)
    renderer = dataclasses.replace(config.renderer, name=task.renderer)
    env_config = config.env_config(scene=task.scene, split="eval", renderer=renderer)
    try:
        return fly(pilot, env_config, range(task.episodes), watch=watch, advance=advance)
    except RuntimeError as error:
        if task.renderer == config.evaluate.renderers[0]:
            raise
        console.print(f"Not flown with {task.renderer}: {error}", markup=False)
        return None


def find_policy(config: Config, folder: Run) -> Path:
    """The run's own policy, or the newest of all runs.

    Raises:
        ConfigError: If there is none.
    """
    own = folder.policy if (folder.policy / "policy.json").is_file() else None
    path = own or latest_policy(config.runs_dir)
    if path is None:
        where = str(Path(config.runs_dir).resolve())
        raise ConfigError(f"no trained policy in {where!r}: run python -m platform.launch +exp=bytestream")
    return path


def publish(folder: Run, tracker: Tracker, rows: Sequence[Summary], tracks: Sequence[Track]) -> None:
    """Show, store and track the table and the ways."""
    text = markdown(LABELS, rows)
    show(table("Held-out corridors", LABELS, rows))
    write_atomic(folder.evaluation / "table.md", text)
    tracker.text("eval/table.md", text)
    tracker.table("eval/results", columns(LABELS, rows))
    tracker.describe(f"Held-out corridors, 95 % intervals in brackets.\n\n{text}")
    tracker.save_view("results", "Results", [f"metrics.`{name}`" for name in VIEW_COLUMNS])
    figure = trajectory_figure(tracks)
    figure.savefig(folder.evaluation / "trajectories.png", dpi=120)
    tracker.figure("eval/trajectories.png", figure)


def tracked_figures(rows: Sequence[Summary]) -> dict[str, float]:
    """The policy's figures on the held-out scene under their plain names, the rest with a suffix."""
    figures: dict[str, float] = {}
    first = rows[0]
    for row in rows:
        pilot, scene, renderer = row.label
        if row is first:
            figures |= metrics(row)
        elif pilot == "policy":
            suffix = f"_{scene}" if renderer == first.label[2] else f"_{renderer}"
            figures |= {f"{name}{suffix}": metrics(row)[name] for name in VIEW_COLUMNS}
        elif scene == first.label[1]:
            figures |= {f"{name}_{pilot}": metrics(row)[name] for name in VIEW_COLUMNS[::3]}
    return {name: value for name, value in figures.items() if np.isfinite(value)}


def film_seed(episodes: np.ndarray) -> int:
    """The corridor to film: the first that the policy came through, or where it came farthest."""
    order = np.lexsort((episodes["seed"], -episodes["distance_m"], ~episodes["success"]))
    return int(episodes["seed"][order[0]])


def film(config: Config, pilot: PolicyPilot, policy: Path, seed: int, path: Path) -> Path:
    """Film the policy's flight through one corridor of the held-out scene; return the file."""
    evae, _ = load_encoder(policy / ENCODER)
    env_config = config.env_config(scene=HELD_OUT_SCENE, split="eval")

    @torch.no_grad()
    def decode(window: np.ndarray) -> np.ndarray:
        logits = evae(batch_packed(window[None], evae.grid))[0]
        return reconstruct(logits, evae.target).reshape(evae.grid.height, evae.grid.width).numpy()

    with Film(path, env_config.control_hz, decode) as reel:

        def watch(env: CorridorEnv, seed: int, window: np.ndarray, info: Mapping[str, Any]) -> None:
            caption = f"{HELD_OUT_SCENE} {seed}   {info['t_us'] / 1e6:4.2f} s   {info['y_m']:5.1f} m"
            ending = "   goal" if info["success"] else "   collision" if info["collision"] else ""
            reel.step(env.luminance, env.events, window, f"{caption}{ending}")

        fly(pilot, env_config, [seed], watch=watch)
    return path
