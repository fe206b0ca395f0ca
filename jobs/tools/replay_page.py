"""Write one page, which needs no server and no network, to scrub through recorded episodes of policies.

Run: python -m platform.launch +exp=replay_page
Expect: a minute or two. `replay/replay.html` in the run folder and in MLflow; `+exp=report` copies it to
docs/. Each of `replay_page.policies` flies the corridor of `seed` in each scene, at each rate, with each
noise. The same settings give the same bytes.
"""

import base64
import dataclasses
import itertools
import json
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from core.pictures import GREY_ON
from envs.config import STRICT, Positive
from jobs.analysis.ground_plan import ground_plan
from jobs.config.config import Config
from jobs.config.schema import Name, NonNegative
from jobs.rollout.agents import PolicyAgent
from jobs.rollout.episodes import outcome_of
from jobs.rollout.policies import EvaluatedPolicy, find_one_policy, with_own_parts
from jobs.rollout.recorded import Moment, RecordedEpisode, record_episode
from jobs.run.files import write_atomic, write_json
from jobs.run.folder import Run, finish, locate_run, open_run
from jobs.run.progress import console, progress
from jobs.run.provenance import command
from jobs.run.templates import render
from jobs.tracking.tracker import open_tracker
from models.policy import load_policy

TEMPLATE = Path(__file__).with_name("replay.html.j2")
PAGE = "replay.html"
FRAMES_PER_S = 40  # of simulated time: every fifth step at 200 Hz
CM = 100.0
MAX_PIXELS = 1 << 15
CHOICES = ("policy", "scene", "noise", "rate")
Cell = tuple[EvaluatedPolicy, str, float, float]  # policy, scene, noise, rate


@dataclass(frozen=True, config=STRICT)
class Settings:
    """The episodes of the replay page: each policy in each scene, at each rate, with each noise.

    Attributes:
        policies: Each a name in models/pretrained, "newest", or a path.
        scenes: Names of layouts.
        background_activity: False events per true event.
        control_hz: Actions per second [Hz].
    """

    policies: Annotated[list[Name], Field(min_length=1, max_length=4)]
    scenes: Annotated[list[Name], Field(min_length=1, max_length=4)]
    background_activity: Annotated[list[NonNegative], Field(min_length=1, max_length=4)]
    control_hz: Annotated[list[Positive], Field(min_length=1, max_length=4)]


def run(config: Config) -> dict[str, int]:
    """Record the episodes, write the page and track it; return the number of episodes.

    Raises:
        ConfigError: A policy does not exist.
    """
    asked, place = config.own, locate_run(config)
    policies = [find_one_policy("replay_page.policies", name, config, place) for name in asked.policies]
    folder = open_run(config)
    cells = list(itertools.product(policies, asked.scenes, asked.background_activity, asked.control_hz))
    with open_tracker(config, folder, key="replay_page") as tracker:
        with progress("Record", len(cells), "episodes") as advance:
            data = page_data(cells, record(config, cells, advance))
        path = write_page(folder, data)
        tracker.artifact(path, "replay")
        console.print(f"Page: {path} ({path.stat().st_size / 1e6:.1f} MB)")
        console.print(tracker.dashboard())
    return finish(folder, "replay_page", {"episodes": len(cells)})


def record(
    config: Config, cells: Sequence[Cell], advance: Callable[[int], None]
) -> Iterator[RecordedEpisode]:
    """Yield the episode of each policy under its condition, one by one, as each takes tens of MB."""
    stochastic = config.evaluate.action == "stochastic"
    folders = dict.fromkeys(policy.agent for policy, *_ in cells)
    agents = {folder: PolicyAgent(load_policy(folder), stochastic) for folder in folders}
    for policy, scene, noise, control_hz in cells:
        faults = dataclasses.replace(config.env.faults, background_activity=noise)
        env = dataclasses.replace(config.env, scene=scene, control_hz=control_hz, faults=faults, split="eval")
        yield record_episode(agents[policy.agent], with_own_parts(policy, env), config.seed)
        advance(1)


def write_page(folder: Run, data: Mapping[str, object]) -> Path:
    """Write the page with `page_data` into the run folder; return its path."""
    place = folder.path / "replay"
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    page = render(TEMPLATE, data=text.replace("</", r"<\/"), command=command())
    write_atomic(place / PAGE, page)
    write_json(place / "about.json", {"command": command()})  # written last: it marks the page as complete
    return place / PAGE


def page_data(cells: Sequence[Cell], recorded: Iterable[RecordedEpisode]) -> dict[str, object]:
    """Return the data of the page as JSON values; an episode's choices are indices into the lists.

    Args:
        cells: Policy, scene, noise and rate of each episode.
        recorded: The episodes in the same order; consumed once.
    """
    named = [(f"{policy.group}-s{policy.training}", *rest) for policy, *rest in cells]
    columns = dict(zip(CHOICES, zip(*named, strict=True), strict=True))
    choices = {name: list(dict.fromkeys(column)) for name, column in columns.items()}
    plans: dict[str, dict[str, object]] = {}
    episodes = []
    for words, one in zip(named, recorded, strict=True):
        place = {name: choices[name].index(word) for name, word in zip(CHOICES, words, strict=True)}
        episodes.append({**place, **packed_episode(one)})
        plans[one.env.scene] = plan(one)
    return {
        "choices": choices,
        "plans": [plans[str(scene)] for scene in choices["scene"]],
        "episodes": episodes,
    }


def plan(recorded: RecordedEpisode) -> dict[str, object]:
    """Return an episode's corridor from above, rounded to centimetres, and its camera's size in pixels."""
    scene, env = recorded.scene, recorded.env
    circles, corners = (shapes.round(2).tolist() for shapes in ground_plan(scene, env.camera_height_m))
    return {
        **{"length": scene.length_m, "half": 0.5 * scene.width_m, "circles": circles, "corners": corners},
        **{"width": env.camera.width, "height": env.camera.height},
    }


def packed_episode(recorded: RecordedEpisode) -> dict[str, object]:
    """Return the numbers of an episode, and its moments as base64 of the zlib-packed `columns_of`."""
    row, control_hz = recorded.episode, recorded.env.control_hz
    shown = shown_steps(len(recorded.moments), control_hz)
    moments = [recorded.moments[step] for step in shown]
    latents = np.array([[] if one.latent is None else one.latent for one in moments], np.float64)
    scale = float(np.abs(latents).max(initial=0.0)) or 1.0
    packed = b"".join(planes(column) for column in columns_of(shown, moments, latents / scale).values())
    return {
        **{"ends": outcome_of(row), "distance": float(row["distance_m"]), "steps": int(row["steps"])},
        **{"events": float(row["events_per_step"]), "end": [float(row["x_m"]), float(row["distance_m"])]},
        "across": [round(end(one.x_m for one in recorded.moments), 2) for end in (min, max)],
        **{"frames": len(shown), "latent": latents.shape[1], "scale": scale},
        "data": base64.b64encode(zlib.compress(packed, 9)).decode(),
    }


def shown_steps(steps: int, control_hz: float) -> list[int]:
    """Choose the steps of an episode to show: `FRAMES_PER_S` per simulated second, and the last."""
    stride = max(1, round(control_hz / FRAMES_PER_S))
    return sorted({*range(0, steps, stride), steps - 1})


def columns_of(
    shown: Sequence[int], moments: Sequence[Moment], latents: np.ndarray
) -> Mapping[str, np.ndarray]:
    """Return the moments as arrays of small integers, in the byte order that the template reads.

    Args:
        shown: Steps of the moments, (F,).
        moments: What the policy saw and chose at these steps, (F,).
        latents: Scaled to [-1, 1], (F, L).

    Returns:
        uint16 and int16 first, then bytes: step, x and y in centimetres, events of the step, number of pixels
        with events, and these pixels in column order, each as 2 * (distance to the previous one) + (1 if ON);
        latents in 1 / 127, probabilities in 1 / 255 (F, 3), action.
    """
    fired = [pixels(one.events) for one in moments]
    return {
        "step": np.array(shown, "<u2"),
        "x": np.array([round(CM * one.x_m) for one in moments], "<i2"),
        "y": np.array([round(CM * one.y_m) for one in moments], "<i2"),
        "events": np.array([min(one.num_events, 65_535) for one in moments], "<u2"),
        "fired": np.array([len(own) for own in fired], "<u2"),
        "pixels": np.concatenate(fired).astype("<u2"),
        "latents": np.rint(127 * latents).astype("i1"),
        "probabilities": np.rint(255 * np.array([one.probabilities for one in moments])).astype("u1"),
        "action": np.array([one.action for one in moments], "u1"),
    }


def planes(column: np.ndarray) -> bytes:
    """Return the low bytes of all numbers, then any high bytes: zlib compresses this order better."""
    return np.ascontiguousarray(column).view("u1").reshape(-1, column.itemsize).T.tobytes()


def pixels(events: np.ndarray | None) -> np.ndarray:
    """Return the pixels with events of an event image (H, W), coded as in `columns_of`.

    Raises:
        ValueError: The image is too large for 16 bits.
    """
    if events is None:
        return np.empty(0, np.int64)
    if events.size > MAX_PIXELS:
        raise ValueError(f"camera: a replay page holds at most {MAX_PIXELS} pixels, got {events.size}")
    last = events.T.ravel()
    places = np.flatnonzero(last)
    return 2 * np.diff(places, prepend=0) + (last[places] == GREY_ON)
