"""Cells: one agent through the corridors of one condition, and what is kept of its flights on the disk."""

import dataclasses
import functools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from envs.config import EnvConfig, FaultsConfig, seen_settings, settings_hash
from jobs.rollout.episodes import EPISODE
from jobs.run.files import RunError, read_json
from jobs.run.progress import console

MAX_FLIGHTS = 10  # of a trial, in lock-step: more would leave other cores with nothing to do


@dataclass(frozen=True)
class Entry:
    """An agent that flies.

    Attributes:
        agent: Path of a policy folder, or a bound's name.
        group: What was trained; policies of one group differ in their training seed alone.
        training: The training seed; None for a bound.
        identity: Hash of its manifest, unique by its SHA-256 sums.
        sensor: Sensor settings that it was trained with; none for a bound.
        observation: What it sees, as `envs.config.EnvConfig` names it.
    """

    agent: str
    group: str
    training: int | None
    identity: str
    sensor: dict[str, Any]
    observation: str


@dataclass(frozen=True)
class Cell:
    """One agent under one condition, through corridors that all share.

    Attributes:
        label: Axis and value; several axes share a cell where they hold the same value.
        key: Hash of all that decides an episode but its seed: what the agent sees of the simulation,
            the policy, the choice of action.
        entry: Who flies.
        action: How a policy chooses.
        env: The simulation.
        seeds: One corridor each.
        table: Settings of `EncoderTable.from_evae` that the policy's encoder is tabulated with; empty:
            as the policy does.
    """

    label: tuple[str, str]
    key: str
    entry: Entry
    action: str
    env: EnvConfig
    seeds: tuple[int, ...]
    table: tuple[tuple[str, Any], ...] = ()

    @functools.cached_property
    def simulation(self) -> str:
        """Hash of what decides how exact its events are: the simulation without its faults."""
        return settings_hash(dataclasses.asdict(dataclasses.replace(self.env, faults=FaultsConfig())))

    @property
    def part(self) -> tuple[str, int]:
        """Which part of a cell this is, if it is split: the key of all and the first seed."""
        return self.key, self.seeds[0]


def make_cell(
    label: tuple[str, str],
    entry: Entry,
    action: str,
    env: EnvConfig,
    trials: int,
    table: Mapping[str, Any] | None = None,
) -> Cell:
    """The cell of the first `trials` corridors, see `Cell`, with its key."""
    seen = seen_settings(env, entry.observation)
    facts = {"env": dataclasses.asdict(seen), "agent": entry.identity, "action": action}
    facts |= {"table": dict(table)} if table else {}  # what was kept before there were tables stays valid
    key = settings_hash({**facts, "kept": list(EPISODE.names or ())})  # other columns, other files
    return Cell(label, key, entry, action, env, tuple(range(trials)), tuple((table or {}).items()))


def split(cell: Cell) -> list[Cell]:
    """A cell in parts of nearly the same size and at most `MAX_FLIGHTS`, one trial each."""
    parts = np.array_split(np.arange(len(cell.seeds)), -(-len(cell.seeds) // MAX_FLIGHTS))
    return [dataclasses.replace(cell, seeds=cell.seeds[part[0] : part[-1] + 1]) for part in parts]


def episodes_folder(place: Path) -> Path:
    """Where flown episodes are kept, one file per cell."""
    return place / "episodes"


def accuracy_file(place: Path, simulation: str) -> Path:
    """Where a folder of flights keeps how exact a simulation is, and how many renders that takes."""
    return place / "accuracy" / f"{simulation}.json"


def unflown(cell: Cell, kept: Path) -> Cell:
    """The cell with only those seeds whose episodes are not kept."""
    flown = {row[0] for row in kept_rows(kept / f"{cell.key}.json")}
    return dataclasses.replace(cell, seeds=tuple(seed for seed in cell.seeds if seed not in flown))


def kept_rows(path: Path) -> list[list[Any]]:
    """The kept episodes of one cell, each a list in the order of EPISODE; none if there is no file.

    A damaged file is put aside, and its cell is flown again.
    """
    if not path.is_file():
        return []
    try:
        return read_json(path)["episodes"]
    except RunError:
        path.replace(path.with_suffix(".damaged"))
        console.print(f"Damaged and put aside, flown again: {path}", markup=False)
        return []


def read_kept(kept: Path, key: str) -> dict[str, Any]:
    """What is kept of a cell beside its episodes.

    Returns:
        `label`; `commits` that flew it; `encoder`, the drift of its policy in the flights of the first
        part; `restarts` of processes that ended meanwhile.
    """
    values = {name: value for name, value in read_json(kept / f"{key}.json").items() if name != "episodes"}
    older = {"commits": [values.pop("commit")]} if "commit" in values else {}
    return values | older


def read_episodes(cell: Cell, kept: Path) -> np.ndarray:
    """The episodes of a cell's seeds, dtype EPISODE."""
    rows = {row[0]: tuple(row) for row in kept_rows(kept / f"{cell.key}.json")}
    return np.array([rows[seed] for seed in cell.seeds], EPISODE)
