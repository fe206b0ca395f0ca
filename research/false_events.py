"""Measure how each kind of wrong events changes features, latent and action of a policy.

Run: python -m research.false_events copies
Expect: seconds. Writes copies of the ten `bytestream` trainings of ppo_claims to runs/false_events_copies.
They have the same weights, and another rank of the pooling or a neighbour filter. `+exp=false_events`
evaluates them.

Run: python -m research.false_events features
Expect: some minutes on one core; docs/data/false_events_features.csv, and its means as a table.
"""

import csv
import dataclasses
import hashlib
import json
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from envs.config import EnvConfig, settings_hash
from envs.corridor import CorridorEnv
from jobs.analysis.statistics import half_width
from jobs.analysis.tables import markdown_table, write_csv
from jobs.config.env_keys import env_with
from jobs.rollout.agents import make_agent
from jobs.rollout.episodes import roll_out
from jobs.run.progress import console
from jobs.run.provenance import REPOSITORY
from models.encoder.table import EncoderTable
from models.encoder.weights import with_checksum, without_checksum
from models.policy import Policy, load_policy
from models.policy.event_filter import filter_of
from models.policy.features import Step
from models.policy.policy import MANIFEST

POLICIES = REPOSITORY / "docs" / "data" / "ppo_claims_policies"
NAME = "ppo_claims_bytestream"
COPIES = Path("runs") / "false_events_copies"
FILE = REPOSITORY / "docs" / "data" / "false_events_features.csv"
TRAININGS = range(10)
CORRIDORS = (0, 1)  # in which each training flies with nothing changed
ERROR = 0.1  # event error of each kind: share of the events of both streams without a partner in the other
TAU_US = 5000  # of the neighbour filter, as env.filter_tau_us
# Ways to read the same weights: name -> rank of the pooling, and neighbours that the filter requires.
READINGS = {
    "maximum": (1, 0),
    "second": (2, 0),
    "third": (3, 0),
    "filter_1": (1, 1),
    "filter_2": (1, 2),
    "third_filter_1": (3, 1),
}
KINDS = ("invented", "displaced", "lost", "flipped", "one invented")
OTHERWISE = ("invented", "one invented")  # kinds for all readings; the others only for `maximum`
MEASURES = ("changed", "raised", "latent", "action")
SHOWN = ("raised", "latent", "action")  # on the page; the file has all measures
HEAD = ("training", "reading", "kind", *MEASURES)


class Response(NamedTuple):
    """The output of a policy at each step of a flight.

    Attributes:
        features: Features of the context, float32 (N, D).
        latents: float32 (N, latent).
        actions: The most likely actions, int64 (N,).
    """

    features: np.ndarray
    latents: np.ndarray
    actions: np.ndarray


def write_copies(source: Path, target: Path) -> list[Path]:
    """Write a copy of every training of `NAME` for each reading except `maximum`; return the folders."""
    return [
        write_copy(source / f"{NAME}-s{seed}", target / f"{reading}-s{seed}", rank, support)
        for reading, (rank, support) in READINGS.items()
        if (rank, support) != READINGS["maximum"]
        for seed in TRAININGS
    ]


def write_copy(source: Path, target: Path, rank: int, support: int) -> Path:
    """Write a policy with the same weights, pooling rank `rank` and a filter of `support` neighbours."""
    shutil.copytree(source, target, dirs_exist_ok=True)
    encoder = without_checksum(json.loads((source / "encoder.json").read_text()))
    encoder["model"]["pool_rank"] = rank
    text = json.dumps(with_checksum(encoder), indent=2, sort_keys=True)
    (target / "encoder.json").write_text(text)
    manifest = without_checksum(json.loads((source / MANIFEST).read_text()))
    manifest["sha256"]["encoder.json"] = hashlib.sha256(text.encode()).hexdigest()
    manifest["pool_rank"] = rank
    if support:
        manifest["sensor"] |= {"filter_support": support, "filter_tau_us": TAU_US}
        manifest["sensor_hash"] = settings_hash(manifest["sensor"])
    (target / MANIFEST).write_text(json.dumps(with_checksum(manifest), indent=2))
    load_policy(target)  # checks every file
    return target


def fly(folder: Path, seed: int) -> list[Step]:
    """Return the events of each step of a policy's flight through corridor `seed`, with nothing changed."""
    steps: list[Step] = []
    env = env_with(EnvConfig(**load_policy(folder).env_fields), {"env.scene": "poles_eval"})

    def watch(corridor: CorridorEnv, _seed: int, window: np.ndarray) -> None:
        start_us = steps[-1].start_us + steps[-1].window_us if steps else 0
        steps.append(Step(corridor.events.copy(), start_us, int(window[0, 2])))

    roll_out(
        make_agent(str(folder), "stochastic"), dataclasses.replace(env, split="eval"), [seed], watch=watch
    )
    return steps


def wrong(kind: str, step: Step, shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Return the events of a step, changed by one kind of wrong events at an event error of `ERROR`.

    Args:
        kind: One of `KINDS`; "one invented" adds a single event instead.
        step: Its events have a structured dtype with t, x, y, p.
        shape: Shape of the sensor, (height, width).
        rng: Draws the wrong events.
    """
    events = step.events.copy()
    if kind in ("invented", "one invented"):
        more = 1 if kind == "one invented" else rng.binomial(2 * len(events), ERROR / (1 - ERROR))
        added = np.zeros(more, events.dtype)
        added["t"] = step.start_us + rng.integers(1, step.window_us + 1, more)
        added["y"], added["x"] = rng.integers(0, shape[0], more), rng.integers(0, shape[1], more)
        added["p"] = rng.choice([-1, 1], more)
        both = np.concatenate((events, added))
        return both[np.argsort(both["t"], kind="stable")]
    if kind == "lost":
        return events[rng.random(len(events)) >= 2 * ERROR / (1 + ERROR)]
    hit = rng.random(len(events)) < ERROR
    if kind == "flipped":
        events["p"][hit] *= -1
        return events
    ways = np.array([(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dy or dx])
    moves = ways[rng.integers(0, len(ways), hit.sum())]
    for axis, (name, size) in enumerate(zip(("y", "x"), shape, strict=True)):
        events[name][hit] = np.clip(events[name][hit].astype(np.int64) + moves[:, axis], 0, size - 1)
    return events


def respond(policy: Policy, steps: Sequence[Step]) -> Response:
    """Return the outputs of a policy over the steps of one whole flight."""
    table = cast(EncoderTable, policy.encoder)
    policy.reset()
    sieve = filter_of(policy.manifest["sensor"], policy.spec.width, policy.spec.height)
    features, latents, actions = [], [], []
    for step in steps:
        seen = step.events if sieve is None else sieve(step.events)
        context = table.update(table.empty(), seen, step.start_us, step.window_us)
        features.append(context if table.pool_rank == 1 else context[-1])
        latents.append(table.latent(context))
        actions.append(int(np.argmax(policy.event_logits(*step))))
    return Response(np.array(features), np.array(latents), np.array(actions))


def compare(clean: Response, changed: Response) -> dict[str, float]:
    """Return how far wrong events move features, latent and action: shares, latent in standard deviations."""
    spread = np.maximum(clean.latents.std(axis=0), 1e-9)
    away = (changed.latents - clean.latents) / spread
    return {
        "changed": float(np.mean(changed.features != clean.features)),
        "raised": float(np.mean(changed.features > clean.features)),
        "latent": float(np.mean(np.sqrt(np.mean(away**2, axis=1)))),
        "action": float(np.mean(changed.actions != clean.actions)),
    }


def measure(folders: Mapping[str, Path], seed: int) -> Iterator[tuple[str, str, dict[str, float]]]:
    """Yield reading, kind and `compare` of one training over its flights.

    Args:
        folders: Reading -> folder of the training; the first policy flies.
        seed: Seed of the training, which also draws the wrong events.
    """
    first = next(iter(folders.values()))
    flights = [fly(first, corridor) for corridor in CORRIDORS]
    rng = np.random.default_rng([seed, 55])
    spec = load_policy(first).spec
    changed = {
        kind: [
            [step._replace(events=wrong(kind, step, (spec.height, spec.width), rng)) for step in flight]
            for flight in flights
        ]
        for kind in KINDS
    }
    for reading, folder in folders.items():
        policy = load_policy(folder)
        clean = joined([respond(policy, flight) for flight in flights])
        for kind in KINDS if reading == "maximum" else OTHERWISE:
            yield reading, kind, compare(clean, joined([respond(policy, one) for one in changed[kind]]))


def joined(parts: Sequence[Response]) -> Response:
    """Concatenate the responses of several flights."""
    return Response(*(np.concatenate(own) for own in zip(*parts, strict=True)))


def table_of(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return means over trainings as Markdown, from the rows of `FILE`; for actions with an interval.

    `maximum` has a row for every kind of wrong events, the other readings only for "invented".
    """
    places = list(dict.fromkeys((row["reading"], row["kind"]) for row in rows))
    lines = []
    for reading, kind in [one for one in places if one[0] == "maximum" or one[1] == "invented"]:
        own = [row for row in rows if (row["reading"], row["kind"]) == (reading, kind)]
        values = np.array([[float(row[name]) for name in SHOWN] for row in own])
        (raised, latent, action), half = values.mean(axis=0), half_width(values)[-1]
        cells = f"{100 * raised:.0f}", f"{latent:.2f}", f"{100 * action:.0f} ± {100 * half:.0f}"
        lines.append((f"`{reading}`", kind, *cells))
    head = ("Read by", "wrong events", "features raised [%]", "latent moved [SD]", "action changes [%]")
    return markdown_table(head, lines, 2)


def read_rows(file: Path) -> list[dict[str, str]]:
    """Return the rows of a file like `FILE`."""
    with file.open(newline="") as opened:
        return list(csv.DictReader(opened))


def write_features() -> None:
    """Measure every training, write `FILE` and print its means."""
    rows = []
    for seed in TRAININGS:
        folders = {name: COPIES / f"{name}-s{seed}" for name in READINGS}
        folders["maximum"] = POLICIES / f"{NAME}-s{seed}"
        for reading, kind, found in measure(folders, seed):
            rows.append((seed, reading, kind, *(f"{found[name]:.5f}" for name in MEASURES)))
        console.print(f"training {seed}")
    write_csv(FILE, HEAD, rows)
    console.print(table_of(read_rows(FILE)), markup=False, highlight=False, soft_wrap=True)


if __name__ == "__main__":
    {"copies": lambda: write_copies(POLICIES, COPIES), "features": write_features}[sys.argv[1]]()
