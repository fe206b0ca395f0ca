"""Run a policy on a real camera's recording: its action at each control step, and its latency.

Run: python -m platform.launch +exp=replay replay.recording=street.raw replay.policy=bytestream_hold-s0
Expect: seconds. A line of numbers; `replay/choices.csv` and a film of the events and the choices in the run
folder. The policy's choices have no effect on the recording (docs/camera.md).
"""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic.dataclasses import dataclass

from envs.config import STRICT, EnvConfig
from jobs.analysis.tables import show_table, write_csv
from jobs.analysis.video import coloured, frame, last_polarity, open_film
from jobs.config.config import Config, ConfigError
from jobs.config.schema import Name
from jobs.rollout.policies import find_one_policy
from jobs.run.folder import locate_run, open_run
from jobs.run.progress import console, progress
from jobs.run.recordings import refusing
from jobs.training.real_recordings import Recorded, read_whole
from models.policy import Policy, load_policy

HEADINGS, LATENCY = ("Recording", "Policy", "Steps", "Events/step"), ("p50", "p95", "p99")
SHOWN_ACTIONS = 3  # most action columns in the table; the CSV file has all probabilities
FILM_FPS, SLOWEST_FPS = 50.0, 5.0
BARS = (245, 158, 11)  # colour of the bars
FAR = 5.0  # warn if the event rate differs from the training's by more than this factor


@dataclass(frozen=True, config=STRICT)
class Settings:
    """The recording and the policy.

    Attributes:
        recording: An event file in any format that `envs.recordings.read_events` reads.
        policy: A name in models/pretrained, "newest", or a path.
    """

    recording: Name
    policy: Name


class Choice(NamedTuple):
    """A policy's choice at one control step.

    Attributes:
        start_us, end_us: Start and end of the step [us].
        events: Events of the step, EVENT (N,).
        probabilities: Probabilities of the actions, float64 (K,).
        seconds: Wall time of the choice [s].
    """

    start_us: int
    end_us: int
    events: np.ndarray
    probabilities: np.ndarray
    seconds: float


def run(config: Config) -> list[Choice]:
    """Replay `replay.recording` to `replay.policy`; return its choices.

    Raises:
        ConfigError: The policy does not exist, sees no events, or needs the vehicle's velocity; or the
            recording is invalid.
    """
    found = find_one_policy("replay.policy", config.own.policy, config, locate_run(config))
    policy = load_policy(found.agent)
    if policy.feature.from_events is None:
        raise ConfigError(f"replay.policy: must see events, got {config.own.policy!r}")
    if policy.spec.own_velocity:
        rule = "must not read the vehicle's velocity (model.own_velocity), which a recording lacks"
        raise ConfigError(f"replay.policy: {rule}, got {config.own.policy!r}")
    env = EnvConfig(**policy.env_fields)
    with refusing("replay.recording", config.own.recording):
        recorded, fitted = read_whole(config.own.recording, env, config.recording)
    if fitted.gaps:
        console.print(
            f"{fitted.gaps:,} gaps, {fitted.closed_us / 1e6:,.1f} s together, are closed in all times.",
        )
    _tell_rate(recorded, trained_rate(policy))
    choices, name = choose(policy, recorded), f"{found.group}-s{found.training}"
    shown = policy.action_names if len(policy.action_names) <= SHOWN_ACTIONS else ()
    headings = (*HEADINGS, *map(str.capitalize, shown), *LATENCY)
    show_table("A policy looks at a recording", headings, [line(recorded.name, name, choices)], words=2)
    console.print("Latency from events to action [ms]; actions by the likeliest, in % of the steps.")
    folder = open_run(config).path / "replay"
    write_choices(folder / "choices.csv", choices, policy.action_names)
    shape = env.camera.height, env.camera.width
    title, names = f"{recorded.name}   {name}", policy.action_names
    path = write_film(folder / "replay.mp4", choices, shape, (title, names), env.control_hz)
    console.print(f"Film: {path}")
    return choices


def choose(policy: Policy, recorded: Recorded) -> list[Choice]:
    """Return a policy's choice at each control step of a recording; its memory spans earlier steps."""
    policy.reset()
    first_us = int(recorded.events["t"][0]) if recorded.events.size else 1
    policy.event_logits(recorded.events[:1], first_us - 1, 1)  # compile before timing
    policy.reset()
    starts_us = np.concatenate(([0], recorded.ends_us[:-1]))
    cuts = np.searchsorted(recorded.events["t"], np.append(starts_us, recorded.ends_us[-1]), side="right")
    choices = []
    with progress("Replay", len(starts_us), "steps") as advance:
        spans_us = zip(starts_us.tolist(), recorded.ends_us.tolist(), strict=True)
        for step, (start_us, end_us) in enumerate(spans_us):
            events = recorded.events[cuts[step] : cuts[step + 1]]
            begun = time.perf_counter()
            logits = policy.event_logits(events, start_us, end_us - start_us).astype(np.float64)
            seconds = time.perf_counter() - begun
            odds = np.exp(logits - logits.max())
            choices.append(Choice(start_us, end_us, events, odds / odds.sum(), seconds))
            advance(1)
    return choices


def trained_rate(policy: Policy) -> float | None:
    """Return the mean events per control step in a policy's training; None if its manifest lacks them."""
    rate = policy.manifest.get("figures", {}).get("sim/events_per_step")
    return None if rate is None else float(rate)


def _tell_rate(recorded: Recorded, trained: float | None) -> None:
    """Print a warning if a recording's event rate is far from the training's."""
    rate = recorded.events.size / len(recorded.ends_us)
    if trained is not None and not trained / FAR <= rate <= trained * FAR:
        console.print(
            f"The recording has {rate:.1f} events a control step, and the policy was trained with about "
            f"{trained:.0f}: it has not seen such input. Record with another contrast threshold or lens, or "
            "train a policy whose encoder knows such recordings (docs/encoder.md).",
        )


def line(recording: str, policy: str, choices: list[Choice]) -> tuple[str, ...]:
    """Return a text for each heading of the table of numbers."""
    likeliest, count = [choice.probabilities.argmax() for choice in choices], choices[0].probabilities.size
    shares = [f"{100 * np.equal(likeliest, action).mean():.0f}" for action in range(count)]
    shares = shares if count <= SHOWN_ACTIONS else []
    latency = np.percentile([1e3 * choice.seconds for choice in choices], (50, 95, 99))
    per_step = np.mean([choice.events.size for choice in choices])
    return recording, policy, str(len(choices)), f"{per_step:.0f}", *shares, *(f"{ms:.2f}" for ms in latency)


def write_choices(file: Path, choices: list[Choice], names: Sequence[str]) -> None:
    """Write a CSV row for each control step: its end [us], number of events, and action probabilities."""
    rows = [(one.end_us, one.events.size, *(f"{p:.4f}" for p in one.probabilities)) for one in choices]
    write_csv(file, ("end_us", "events", *names), rows)


def write_film(
    path: Path, choices: list[Choice], shape: tuple[int, int], said: tuple[str, Sequence[str]], hz: float
) -> Path:
    """Write an MP4 file with a frame for each control step, events and choice; return its path.

    `said` holds the title and the name of each action.
    """
    title, names = said
    # Three actions are shown from left to right.
    order = (1, 0, 2) if len(names) == SHOWN_ACTIONS else range(len(names))
    with open_film(path, hz, None, float(np.clip(hz / 4, SLOWEST_FPS, FILM_FPS))) as film:
        for choice in choices:
            likeliest = sorted(zip(choice.probabilities, names, strict=True), reverse=True)[:SHOWN_ACTIONS]
            odds = "   ".join(f"{name} {p:.2f}" for p, name in likeliest)
            panel = coloured(last_polarity(choice.events, shape))
            bars = np.zeros((*shape, 3), np.uint8)
            for place, action in enumerate(order):
                height, width = round(choice.probabilities[action] * shape[0]), shape[1] // len(names)
                gap = width > 2
                bars[shape[0] - height :, place * width + gap : (place + 1) * width - gap] = BARS
            panels = [(title, panel), ("actions, from left to right", bars)]
            film.add(frame(panels, f"{choice.end_us / 1e6:.2f} s   {odds}"))
    return path
